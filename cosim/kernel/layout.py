"""The library and its memory layout: the enumerations and structs of `kernel.h`, in its order."""

from __future__ import annotations

import ctypes
import functools
import sys
from ctypes import c_double, c_int32, c_int64, c_uint64, c_void_p
from enum import IntEnum
from pathlib import Path

from cosim.errors import ConfigError, Problem
from cosim.plan import Integrator, Method

STAGES = 7
"""Rows of scratch that the integrators need."""

INTEGRATORS = (Integrator.RK4, Integrator.DORMAND_PRINCE, Integrator.EULER)
METHODS = (Method.JOINT, Method.MIDPOINT, Method.GAUSS_SEIDEL, Method.JACOBI)

TYPES = (
    *("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean"),
    "Fmi2Boolean",
)
FMI2_TYPES = {"Float64": "Real", "Int32": "Integer", "Fmi2Boolean": "Boolean"}
"""What FMI 2.0 calls those types that it has."""

MODEL_EXCHANGE_CALLS = {
    2: (
        *("fmi2SetTime", "fmi2SetContinuousStates", "fmi2GetContinuousStates", "fmi2GetDerivatives"),
        "fmi2GetEventIndicators",
        *("fmi2CompletedIntegratorStep", "fmi2EnterEventMode", "fmi2NewDiscreteStates"),
        "fmi2EnterContinuousTimeMode",
    ),
    3: (
        *("fmi3SetTime", "fmi3SetContinuousStates", "fmi3GetContinuousStates", "fmi3GetContinuousStateDerivatives"),
        "fmi3GetEventIndicators",
        *("fmi3CompletedIntegratorStep", "fmi3EnterEventMode", "fmi3UpdateDiscreteStates"),
        "fmi3EnterContinuousTimeMode",
    ),
}
"""By FMI version, from call number 0 on."""
CO_SIMULATION_EVENT_CALLS = {6: "fmi3EnterEventMode", 7: "fmi3UpdateDiscreteStates", 9: "fmi3EnterStepMode"}
"""By call number, for FMUs that have an Event Mode."""
DO_STEP = 10
GET_VALUES = 11
SET_VALUES = GET_VALUES + len(TYPES)
N_CALLS = SET_VALUES + len(TYPES)


class Reason(IntEnum):
    """Why the kernel gave up."""

    CALL_FAILED = 1
    STOP_REQUESTED = 2
    EARLY_RETURN = 3
    OUTPUT_NOT_FINITE = 4
    STATE_NOT_FINITE = 5
    EVENTS_UNSETTLED = 6
    DISCRETE_STATES_UNSETTLED = 7
    STEP_TOO_SMALL = 8
    INDICATOR_NAN = 9
    CHATTERING = 10
    TOO_MANY_EVENTS = 11


class Component(ctypes.Structure):
    """An FMU instance and its functions."""

    _fields_ = (
        ("fmi", c_int32),
        ("n_states", c_int32),
        ("first_state", c_int32),
        ("reads_earlier", c_int32),
        ("n_indicators", c_int32),
        ("first_indicator", c_int32),
        ("uses_events", c_int32),
        ("discrete", c_int32),
        ("parts", c_int32 * 2),
        ("instance", c_void_p),
        ("functions", c_void_p),
    )


class Transfer(ctypes.Structure):
    """Values of one type that move between a component and the signals."""

    _fields_ = (
        ("component", c_int32),
        ("to_component", c_int32),
        ("type", c_int32),
        ("n_references", c_int32),
        ("n_values", c_int32),
        ("begin", c_int32),
        ("references", c_void_p),
        ("positions", c_void_p),
        ("buffer", c_void_p),
        ("gains", c_void_p),
        ("offsets", c_void_p),
    )


class Transfers(ctypes.Structure):
    """A range of rows of the table of transfers."""

    _fields_ = (("first", c_int32), ("last", c_int32))


class Failure(ctypes.Structure):
    """What went wrong, and in which component."""

    _fields_ = (
        ("reason", c_int32),
        ("component", c_int32),
        ("call", c_int32),
        ("status", c_int32),
        ("transfer", c_int32),
        ("index", c_int32),
        ("value", c_double),
    )


class Mail(ctypes.Structure):
    """`network.messages.Mail`."""

    _fields_ = tuple((name, c_void_p) for name in ("ends", "arrival_ns", "slot", "stamp", "values"))


class Agent(ctypes.Structure):
    """The agent at hand."""

    _fields_ = (
        *((name, c_int32) for name in ("n_components", "n_states", "n_signals", "n_indicators", "width", "grid")),
        *((name, c_void_p) for name in ("components", "transfers", "outputs", "inputs")),
        *((name, Transfers) for name in ("propagate", "follow", "listen", "sample")),
        *((name, c_void_p) for name in ("owner", "continuous", "mailbox_values", "mailbox_stamp", "mailbox_time")),
        ("method", c_int32),
        ("integrator", c_int32),
        ("step_ns", c_int64),
        ("refinement", c_int64),
        ("relative_tolerance", c_double),
        ("absolute_tolerance", c_double),
        *((name, c_void_p) for name in ("signals", "previous", "steps", "next_event", "time")),
        *((name, c_void_p) for name in ("before", "middle", "source", "states", "new_states", "stages", "indicators")),
        ("called", c_void_p),
        ("failure", Failure),
    )


class Member(ctypes.Structure):
    """One agent of a block."""

    _fields_ = (
        *((name, c_void_p) for name in ("agent", "components", "signals", "previous", "steps", "next_event", "time")),
        ("place", c_int64),
    )


class Selection(ctypes.Structure):
    """Some of the signals."""

    _fields_ = (("n", c_int64), ("places", c_void_p))


class Block(ctypes.Structure):
    """Agents that are advanced by one call."""

    _fields_ = (
        *((name, c_int64) for name in ("n_members", "n_receivers", "period_ns")),
        *((name, c_void_p) for name in ("members", "attended", "signals")),
        *((name, Selection) for name in ("samples", "row")),
        ("failed", c_int64),
    )


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled kernel beside this file.

    Raises:
        ConfigError: it is not there, or was built from other sources.
    """
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    try:
        loaded = ctypes.CDLL(str(Path(__file__).with_name(f"_kernel{suffix}")))
        loaded.cosim_kernel_advance.restype = c_int64
        loaded.cosim_kernel_sizes.restype = c_uint64
        loaded.cosim_watch_crashes.restype = loaded.cosim_ignore_crashes.restype = None
    except (OSError, AttributeError) as error:
        raise _unusable(f"cannot be loaded ({error})") from error
    loaded.cosim_kernel_advance.argtypes = (c_void_p, c_int64, c_int64, c_void_p, c_void_p, c_void_p)
    loaded.cosim_watch_crashes.argtypes = (c_int32, c_int32, c_int32)
    agent, component, transfer, *others = (
        ctypes.sizeof(struct) for struct in (Agent, Component, Transfer, Failure, Mail, Member, Block)
    )
    if loaded.cosim_kernel_sizes() != agent << 48 | component << 32 | transfer << 16 | sum(others):
        raise _unusable("was built from other sources")
    return loaded


def _unusable(why: str) -> ConfigError:
    advice = "build it with `python -m fmus.build`, or do without it: `coupling: {loop: python}`"
    return ConfigError([Problem(f"the native loop {why}; {advice}")])
