"""Live FMUs of FMI 2.0 and 3.0, Co-Simulation and Model Exchange."""

from __future__ import annotations

import contextlib
import ctypes
import functools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.components.component import Component, Description, Floats, Interface, Value, Variable
from cosim.components.fmu.library import (
    File,
    FMICallException,
    Log,
    open_library,
    status_name,
)
from cosim.components.fmu.values import FMI2_TYPES, FMI3_TYPES, Buffer
from cosim.components.start_values import start_values
from cosim.errors import ComponentError, ConfigError, DiscardedStepError, EndRequestedError
from cosim.logs import Sink, discard

DISCRETE_STATE_ITERATIONS = 100
"""How often an FMU may ask for another update of its discrete states at one instant."""

EVENTS_PER_STEP = 100
"""How often a Co-Simulation FMU may return early within one step, to have its events handled."""

SHORTEST = 1e-9
"""What an early return may leave of a step, as a part of it: nothing, but for rounding."""

WARNING, DISCARD, FATAL, PENDING = 1, 2, 4, 5


@dataclass(frozen=True)
class Native:
    """What the native loop needs of an instance.

    Attributes:
        fmi: 2 or 3.
        library: the loaded library, to be compared by identity.
        instance: the FMU's instance pointer.
        address: of an FMI function of its library, by the function's name in the standard.
    """

    fmi: int
    library: object
    instance: int
    address: Callable[[str], int]


class FmuComponent(Component):
    """An FMU instance. After status Error it is only freed, after Fatal it is never touched again."""

    def __init__(
        self, name: str, file: File, interface: Interface, description: Description, log: Sink = discard
    ) -> None:
        self.name = name
        self.interface = interface
        self.description = description
        self.log = Log(log)
        self._usable = True
        self._initialised = False
        self._failed = False
        self._fmi = file.fmi
        self._types = FMI2_TYPES if file.fmi == 2 else FMI3_TYPES
        self._buffers: dict[tuple[Any, ...], Buffer] = file.buffers
        try:
            self._fmu = open_library(file, interface)
            self._fmu.instanceName = name
            self._instantiate()
        except ConfigError:  # the file is at fault, and the message names it
            raise
        except Exception as error:  # FMPy raises bare exceptions
            reason = str(error)
            if reason.startswith("Failed to instantiate"):  # FMPy's words for an FMU that gives NULL
                reason = "its library gives no instance; `cosim check` shows what it prints, such as a missing licence"
            raise ComponentError(name, f"cannot be opened: {reason}", self.log.last) from error
        self._instance = self._fmu.component

    @property
    def last_log(self) -> str | None:
        return self.log.last

    @abstractmethod
    def _instantiate(self) -> None: ...

    def _tolerance(self) -> tuple[bool, float]:
        """Whether the FMU's own solver is told a tolerance, and which."""
        told = self.description.tolerance if self.interface is Interface.CO_SIMULATION else None
        return told is not None, told or 0.0

    def native(self) -> Native:
        """For `cosim.kernel`; valid until `terminate`."""
        dll = self._fmu.dll
        return Native(
            fmi=self._fmi,
            library=dll,
            instance=self._instance,
            address=lambda name: ctypes.cast(getattr(dll, name), ctypes.c_void_p).value or 0,
        )

    def require_usable(self) -> None:
        """Before every call. Raise `ComponentError` if the instance has failed or ended."""
        self._called()
        if not self._usable or self._failed:
            raise ComponentError(self.name, "has failed or ended and cannot be called any more", self.log.last)

    def failure(self, function: str, status: int) -> ComponentError:
        """The error for an FMI call that returned `status`; remembers what may still be called (FMI 3.0, 2.2.3)."""
        self._failed = self._failed or status > DISCARD
        if status == FATAL:
            self._usable = False
        message = f"{function} returned {status_name(status)}"
        if status == DISCARD and function.endswith("DoStep"):
            return DiscardedStepError(self.name, message + self._how_far(), self.log.last)
        return ComponentError(self.name, message, self.log.last)

    def _how_far(self) -> str:
        """What can be said of a step that was discarded."""
        return ""

    def stop_requested(self) -> EndRequestedError:
        """What an FMU that sets `terminateSimulation` raises."""
        return EndRequestedError(self.name, "asks to end the simulation (terminateSimulation)", self.log.last)

    def early_return(self, reached: float) -> ComponentError:
        """The error for an FMI 3.0 step cut short, which `earlyReturnAllowed = false` forbids."""
        return ComponentError(self.name, f"fmi3DoStep returned early, at t = {reached:.9g} s", self.log.last)

    def too_many_events(self) -> ComponentError:
        """The error for an FMU that returns early again and again."""
        times = f"more than {EVENTS_PER_STEP} times within one step"
        return ComponentError(self.name, f"fmi3DoStep returned early {times}, for its events", self.log.last)

    def unsettled(self) -> ComponentError:
        """The error for an FMU whose discrete states never settle."""
        rounds = DISCRETE_STATE_ITERATIONS
        return ComponentError(
            self.name, f"its discrete states did not settle within {rounds} updates at one instant", self.log.last
        )

    def _call(self, function: str, *arguments: Any) -> None:
        self.require_usable()
        try:
            getattr(self._fmu, function)(self._instance, *arguments)
        except FMICallException as error:
            raise self.failure(function, error.status) from None

    # --- values -----------------------------------------------------------------------------------------------------
    def _buffer(self, variable: Variable) -> Buffer:
        key = (variable.name, variable.shape, variable.references)
        buffer = self._buffers.get(key)
        if buffer is None:
            if variable.dtype not in self._types:
                raise ComponentError(self.name, f"{variable.name} is of type {variable.dtype}: it holds no numbers")
            buffer = self._buffers[key] = Buffer(self._fmi, self._types[variable.dtype], variable)
        return buffer

    def get(self, variable: Variable) -> Floats:
        buffer = self._buffer(variable)
        if variable.size:
            self._call(buffer.getter, *buffer.arguments)
        return buffer.values.astype(np.float64)

    def set(self, variable: Variable, values: Floats) -> None:
        buffer = self._buffer(variable)
        buffer.store(values)
        if variable.size:
            self._call(buffer.setter, *buffer.arguments)

    def start(self, variable: Variable, values: Sequence[Value]) -> None:
        try:
            converted = start_values(variable, values)
        except ValueError as error:
            raise ComponentError(self.name, f"{variable.name} {error}", self.log.last) from None
        if not converted:
            return
        try:
            self._start(variable, converted)
        except ComponentError as error:
            raise ComponentError(
                self.name, f"the start value of {variable.name} is refused: {error.message}", error.log
            ) from None

    def _start(self, variable: Variable, values: list[Any]) -> None:
        if variable.dtype == "String":
            self._set_strings(variable, (ctypes.c_char_p * len(values))(*(value.encode() for value in values)))
            return
        if variable.dtype == "Binary":
            self._set_binaries(variable, values)
            return
        buffer = self._buffer(variable)
        try:
            buffer.values[:] = values
        except OverflowError:
            raise ComponentError(self.name, f"it does not fit into {variable.dtype}") from None
        self._call(buffer.setter, *buffer.arguments)

    @abstractmethod
    def _set_strings(self, variable: Variable, values: ctypes.Array[ctypes.c_char_p]) -> None: ...

    def _set_binaries(self, variable: Variable, values: Sequence[bytes]) -> None:
        raise NotImplementedError

    # --- life cycle -------------------------------------------------------------------------------------------------
    def exit_initialization(self) -> None:
        self._call(f"fmi{self._fmi}ExitInitializationMode")
        self._initialised = True

    def _end(self, *, running: bool) -> None:
        """Terminate if running, then free the instance."""
        try:
            if running:
                getattr(self._fmu, f"fmi{self._fmi}Terminate")(self._instance)
        finally:
            getattr(self._fmu, f"fmi{self._fmi}FreeInstance")(self._instance)

    def terminate(self) -> None:
        if self._usable:
            self._usable = False
            with contextlib.suppress(FMICallException):  # it ends either way
                self._end(running=self._initialised and not self._failed)

    # --- saved states -----------------------------------------------------------------------------------------------
    def reset(self) -> None:
        self._call(f"fmi{self._fmi}Reset")
        self._initialised = False

    def save(self) -> object:
        return self._state_call("getFMUState")

    def restore(self, saved: object) -> None:
        self._state_call("setFMUState", saved)

    def forget(self, saved: object) -> None:
        if self._usable and not self._failed:
            self._state_call("freeFMUState", saved)

    def _state_call(self, function: str, *arguments: Any) -> Any:
        self.require_usable()
        try:
            return getattr(self._fmu, function)(*arguments)
        except FMICallException as error:
            raise self.failure(error.function, error.status) from None

    # --- Model Exchange ---------------------------------------------------------------------------------------------
    def _resize(self, n_states: int, n_indicators: int) -> None:
        self.n_states = n_states
        self.n_indicators = n_indicators
        self.__dict__.pop("_vector", None)

    @functools.cached_property
    def _vector(self) -> tuple[Floats, Any]:
        """Memory for the states, and a pointer to it; the native loop does without."""
        return _memory(self.n_states)

    def _get_vector(self, function: str) -> Floats:
        vector, pointer = self._vector
        if self.n_states:
            self._call(function, pointer, self.n_states)
        return vector.copy()

    def _set_vector(self, function: str, values: Floats) -> None:
        vector, pointer = self._vector
        if self.n_states:
            vector[:] = values
            self._call(function, pointer, self.n_states)

    def set_time(self, time: float) -> None:
        self._call(f"fmi{self._fmi}SetTime", time)

    def get_states(self) -> Floats:
        return self._get_vector(f"fmi{self._fmi}GetContinuousStates")

    def set_states(self, states: Floats) -> None:
        self._set_vector(f"fmi{self._fmi}SetContinuousStates", states)

    def enter_event_mode(self) -> None:
        self._call(f"fmi{self._fmi}EnterEventMode")

    def enter_continuous_time_mode(self) -> None:
        self._call(f"fmi{self._fmi}EnterContinuousTimeMode")

    def update_discrete_states(self) -> float | None:
        for _ in range(DISCRETE_STATE_ITERATIONS):
            again, stop, _, _, defined, time = self._update_once()
            if stop:
                raise self.stop_requested()
            if not again:
                return time if defined else None
        raise self.unsettled()

    def _update_once(self) -> tuple[bool, bool, bool, bool, bool, float]:
        """Need another update, terminate, nominals changed, states changed, next time event defined, its time."""
        self.require_usable()
        try:
            return self._update_discrete_states()
        except FMICallException as error:
            raise self.failure(error.function, error.status) from None

    @abstractmethod
    def _update_discrete_states(self) -> tuple[bool, bool, bool, bool, bool, float]: ...

    def nominals(self) -> Floats:
        return self._get_vector(f"fmi{self._fmi}GetNominalsOfContinuousStates")

    def event_indicators(self) -> Floats:
        vector, pointer = _memory(self.n_indicators)
        self._call(f"fmi{self._fmi}GetEventIndicators", pointer, self.n_indicators)
        return vector

    def completed_step(self) -> bool:
        self.require_usable()
        try:
            wants_event, stop = self._fmu.completedIntegratorStep()
        except FMICallException as error:
            raise self.failure(error.function, error.status) from None
        if stop:
            raise self.stop_requested()
        return bool(wants_event)


def _memory(size: int) -> tuple[Floats, Any]:
    """Numbers, and a pointer to them."""
    vector = np.zeros(size)
    return vector, vector.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
