"""Every wrong call returns an error and logs one line that says which variable, and when."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from tests.fmus.driver import CS, ME, Driver
from tests.fmus.inputs import START

OpenFmu = Callable[[str, str], Driver]
VERSIONS = pytest.mark.parametrize("version", ["fmi2", "fmi3"])


def refuse(fmu: Driver, call: Callable[..., Any], *arguments: Any, **keywords: Any) -> str:
    """Call it, and return the one line that it logs."""
    fmu.log.clear()
    with pytest.raises(FMICallException, match=r"status 3 \(error\)"):
        call(*arguments, **keywords)
    assert len(fmu.log) == 1
    return fmu.log[0]


# --- non-finite values ----------------------------------------------------------------------------------------------
@VERSIONS
def test_state_that_is_not_finite(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", ME).initialize(**START)
    fmu.fmu.setTime(14.32)
    x = fmu.states
    x[10] = np.nan
    assert refuse(fmu, fmu.derivatives, 14.32, x) == "state theta_hat[3] is not finite at t = 14.32 s"


@VERSIONS
def test_derivative_that_is_not_finite(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"TwoLinkArm.{version}", ME).initialize()
    line = refuse(fmu, fmu.derivatives, 0.5, np.array([0.0, 0.0, 1e200, 1e200]))
    assert line == "derivative der(v)[1] is not finite at t = 0.5 s"


@VERSIONS
def test_output_that_is_not_finite(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", CS).initialize(k_e=100.0)
    fmu.set(v=[0.0, 1e307])
    assert refuse(fmu, fmu.get, "u") == "variable u[2] is not finite at t = 0 s"


@VERSIONS
def test_step_that_blows_up(open_fmu: OpenFmu, version: str) -> None:
    """A stiff loop gain and a coarse internal step: RK4 leaves its region of stability and overflows."""
    fmu = open_fmu(f"ArmSyncController.{version}", CS).initialize(k_d=1e9, solver_step=0.1)
    fmu.set(neighbour_stamp=[0], neighbour_v_hat=[5.0, 5.0])

    def many_steps() -> None:
        for _ in range(200):
            fmu.step(0.1)

    line = refuse(fmu, many_steps)
    assert re.fullmatch(r"(state|derivative|variable) \S+\[\d\] is not finite at t = 0\.\d+ s", line)
    assert 0.1 < fmu.time < 2.0


@VERSIONS
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_input_that_is_not_finite(open_fmu: OpenFmu, version: str, value: float) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", CS).initialize(**START)
    fmu.step(0.25)
    line = refuse(fmu, fmu.set, neighbour_p=[[0, 0], [0, value], [0, 0]])
    assert line == "neighbour_p[2,2] was set to a value that is not finite at t = 0.25 s"


# --- parameters -----------------------------------------------------------------------------------------------------
@VERSIONS
@pytest.mark.parametrize(
    ("model", "start", "message"),
    [
        ("ArmSyncController", {"T": 0.0}, "T must be more than 0 s, not 0 s"),
        ("ArmSyncController", {"solver_step": -0.1}, "solver_step must be more than 0 s, not -0.1 s"),
        ("ArmSyncController", {"adaptation_sign": 0.5}, "adaptation_sign must be -1 or +1, not 0.5"),
        ("AxisSyncController", {"T": 0.0}, "T must be more than 0 s, not 0 s"),
        ("DoubleIntegrator", {"solver_step": 0.0}, "solver_step must be more than 0 s, not 0 s"),
        ("MassSpringDamper", {"m": [1.0, 0.0]}, "m[2] must be more than 0 kg, not 0 kg"),
        ("Pendulum", {"m": -1.0}, "m[1] must be more than 0 kg, not -1 kg"),
        ("Pendulum", {"l": [0.5, 0.0]}, "l[2] must be more than 0 m, not 0 m"),
        ("TwoLinkArm", {"solver_step": 0.0}, "solver_step must be more than 0 s, not 0 s"),
        ("TwoLinkArm", {"m2": 0.0}, "the masses m1 and m2 must be more than 0 kg"),
        ("TwoLinkArm", {"I1": -0.1}, "the inertias I1 and I2 must not be negative"),
        (
            "TwoLinkArm",
            {"I1": 0.0, "lc1": 0.0, "I2": 0.0},
            "the inertia matrix of these parameters is not positive definite",
        ),
    ],
)
def test_parameter_out_of_range(open_fmu: OpenFmu, version: str, model: str, start: Any, message: str) -> None:
    fmu = open_fmu(f"{model}.{version}", CS)
    assert refuse(fmu, fmu.initialize, **start) == message


@VERSIONS
def test_enumeration_has_no_such_item(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", CS)
    assert refuse(fmu, fmu.set, role=4) == "role was set to 4, which is not from 1 to 3"
    assert refuse(fmu, fmu.set, neighbour_stamp=-2).startswith("neighbour_stamp[1] was set to -2, which is not from -1")


def test_rows_in_fmi2_are_limited(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi2", CS)
    assert refuse(fmu, fmu.resize, "n_neighbours", 17) == "n_neighbours was set to 17, which is not from 0 to 16"


def test_rows_in_fmi3_are_limited_by_memory(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", CS)
    line = refuse(fmu, fmu.resize, "n_neighbours", 2**62)
    assert line == "n_neighbours = 4611686018427387904: more than there is memory for"
    fmu = open_fmu("AxisSyncController.fmi3", CS)
    fmu.resize("n_axes", 2000)
    line = refuse(fmu, fmu.resize, "n_neighbours", 2**62)
    assert line == "n_axes = 2000 and n_neighbours = 4611686018427387904: more than there is memory for"


def test_axes_that_are_no_longer_finite_are_named(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("AxisSyncController.fmi3", ME).initialize(n_axes=3)
    states = fmu.states
    states[-1] = np.nan  # v_bar_integral is the last state, theta_hat of 3 x 5 numbers comes before it
    line = refuse(fmu, setattr, fmu, "states", states)
    assert line == "state v_bar_integral[3] is not finite at t = 0 s"
    states[-1], states[-5] = 0.0, np.inf
    assert refuse(fmu, setattr, fmu, "states", states) == "state theta_hat[3,4] is not finite at t = 0 s"


# --- wrong calls ----------------------------------------------------------------------------------------------------
@VERSIONS
def test_order_of_calls(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", CS)
    assert refuse(fmu, fmu.step, 0.1) == f"{version}DoStep must not be called in the state 'Instantiated'"
    assert refuse(fmu, fmu.get, "u") == "u is computed: it can be read from Initialization Mode on"
    fmu.initialize(stop_time=1.0)
    assert refuse(fmu, fmu.set, u=0.0) == "u must not be set in the state 'Step Mode'"
    assert refuse(fmu, fmu.set, k_e=1.0) == "k_e must not be set in the state 'Step Mode'"
    line = refuse(fmu, fmu.fmu.enterEventMode if version == "fmi3" else fmu.fmu.enterInitializationMode)
    assert line.endswith("must not be called in the state 'Step Mode'")
    fmu.fmu.terminate()
    assert refuse(fmu, fmu.step, 0.1).endswith("in the state 'Terminated'")


def test_discrete_inputs_are_for_event_mode(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", ME).initialize(**START)
    line = refuse(fmu, fmu.set, neighbour_p=np.zeros(6))
    assert line == "neighbour_p must not be set in the state 'Continuous-Time Mode'"


def test_structural_parameter_is_for_configuration_mode(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", CS)
    assert refuse(fmu, fmu.set, n_neighbours=2) == "n_neighbours must not be set in the state 'Instantiated'"


@VERSIONS
def test_communication_points(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"TwoLinkArm.{version}", CS).initialize(stop_time=1.0)
    fmu.step(0.5)
    do_step = fmu.fmu.doStep
    assert refuse(fmu, do_step, 0.4, 0.1) == "a step from t = 0.4 s was asked for, but this instance is at t = 0.5 s"
    assert refuse(fmu, do_step, 0.5, -0.1) == "the communication step size -0.1 s is negative"
    assert refuse(fmu, do_step, 0.5, 0.6) == "a step to t = 1.1 s would pass the stop time 1 s"
    assert refuse(fmu, do_step, 0.5, np.nan) == "the communication point or step size is not finite"
    do_step(0.5, 0.5)


@VERSIONS
def test_start_and_stop_time(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"TwoLinkArm.{version}", CS)
    line = refuse(fmu, fmu.initialize, start_time=1.0, stop_time=0.5)
    assert line == "the stop time 0.5 s is not after the start time 1 s"


@VERSIONS
def test_value_references(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"TwoLinkArm.{version}", CS).initialize()
    real = fmu.fmu.getReal if version == "fmi2" else fmu.fmu.getFloat64
    integer = fmu.fmu.getInteger if version == "fmi2" else fmu.fmu.getInt64
    assert refuse(fmu, real, [99999]) == "there is no variable with value reference 99999"
    u = fmu.references("u")[0][0]
    assert refuse(fmu, integer, [u]) == "the variable u is of another type"
    assert refuse(fmu, fmu.fmu.getString, [u]) == "this FMU has no variable of type String"
    if version == "fmi2":
        assert refuse(fmu, real, [u + 2]) == f"there is no variable with value reference {u + 2}"


def test_number_of_values(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", CS).initialize(**START)
    p, weight = (fmu.references(name)[0][0] for name in ("neighbour_p", "weight"))
    assert refuse(fmu, fmu.fmu.setFloat64, [p], [0.0] * 5) == "neighbour_p: 6 values expected, but nValues is 5"
    assert refuse(fmu, fmu.fmu.getFloat64, [p], 7) == "neighbour_p: 6 values expected, but nValues is 7"
    line = refuse(fmu, fmu.fmu.setFloat64, [p, weight], [0.0] * 6)
    assert line == "neighbour_p and others: 9 values expected, but nValues is 6"
    np.testing.assert_array_equal(fmu.get("weight"), START["weight"])


@VERSIONS
def test_number_of_states(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"TwoLinkArm.{version}", ME).initialize()
    fmu.n_states = 3
    assert refuse(fmu, lambda: fmu.states) == "there are 4 continuous states, not 3"


@VERSIONS
def test_what_is_not_offered(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"TwoLinkArm.{version}", ME).initialize()
    p, u = fmu.references("p")[0][:1], fmu.references("u")[0][:1]
    line = refuse(fmu, fmu.fmu.getDirectionalDerivative, p, u, [1.0])
    assert line == f"{version}GetDirectionalDerivative is not offered by this FMU"


@VERSIONS
def test_binary_of_another_build(built: dict[str, Path], version: str) -> None:
    fmu = Driver(built[f"TwoLinkArm.{version}"], CS, guid="{another}")
    with pytest.raises(Exception, match=r"[Ii]nstantiate"):
        fmu.instantiate()
    assert "modelDescription.xml belongs to another build" in fmu.log[0]
    fmu.close()


def test_event_mode_in_co_simulation_is_not_offered(built: dict[str, Path]) -> None:
    fmu = Driver(built["TwoLinkArm.fmi3"], CS)
    with pytest.raises(Exception, match=r"[Ii]nstantiate"):
        fmu.fmu.instantiate(eventModeUsed=True, logMessage=fmu._log3)
    assert fmu.log == ["this FMU has no Event Mode in Co-Simulation (hasEventMode = false)"]
    fmu.close()
