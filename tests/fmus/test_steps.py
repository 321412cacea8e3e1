"""Co-Simulation at several communication steps agrees with a tight Model Exchange solution.

With constant inputs the only error left is that of the internal RK4 steps: 1e-8 at 1 ms is far above it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.fmus.driver import CS, ME, Driver
from tests.fmus.inputs import START, messages, record
from tests.fmus.theory import solve_tightly

OpenFmu = Callable[[str, str], Driver]
STEPS = [0.001, 0.007, 0.03, 0.25]  # 7 ms does not divide T = 100 ms; 250 ms spans ticks


def co_simulate(fmu: Driver, stop: float, step: float) -> None:
    for k in range(1, math.ceil(stop / step - 1e-9) + 1):
        fmu.step_to(min(k * step, stop))


@pytest.mark.parametrize("version", ["fmi2", "fmi3"])
@pytest.mark.parametrize("step", STEPS)
def test_arm(open_fmu: OpenFmu, version: str, step: float) -> None:
    start: dict[str, Any] = {"p": [0.4, -0.7], "v": [0.3, 0.6], "u": [3.0, 0.5]}
    exact = open_fmu(f"TwoLinkArm.{version}", ME).initialize(**start)
    exact.integrate(1.0, solve_tightly)
    stepped = open_fmu(f"TwoLinkArm.{version}", CS).initialize(solver_step=0.001, **start)
    co_simulate(stepped, 1.0, step)
    for name in ("p", "v"):
        np.testing.assert_allclose(stepped.get(name), exact.get(name), rtol=0, atol=1e-8)


@pytest.mark.parametrize("extrapolation", [1, 2, 3, 4])
@pytest.mark.parametrize("step", STEPS)
def test_controller(open_fmu: OpenFmu, extrapolation: int, step: float) -> None:
    start = {**START, **messages(3), "extrapolation": extrapolation}
    start["neighbour_stamp"] = [0, 0, -1]
    start["neighbour_time"] = 0.0
    exact = open_fmu("ArmSyncController.fmi3", ME).initialize(**start)
    exact.integrate(1.0, solve_tightly)
    stepped = open_fmu("ArmSyncController.fmi3", CS).initialize(solver_step=0.001, **start)
    co_simulate(stepped, 1.0, step)
    np.testing.assert_allclose(record(stepped), record(exact), rtol=1e-8, atol=1e-8)


def test_solver_step_is_one_internal_step(open_fmu: OpenFmu) -> None:
    """A communication step as long as `solver_step` is one RK4 step, whatever the rounding of its ends."""
    start: dict[str, Any] = {"p": [0.4, -0.7], "v": [0.3, 0.6], "u": [3.0, 0.5]}
    fine = open_fmu("TwoLinkArm.fmi3", CS).initialize(solver_step=0.1, **start)
    limit = open_fmu("TwoLinkArm.fmi3", CS).initialize(solver_step=1.0, **start)
    for k in range(1, 31):
        fine.step_to(k * 0.1)
        limit.step_to(k * 0.1)
    assert fine.get("p").tobytes() == limit.get("p").tobytes()
