"""The four extrapolations against closed forms, read from psi' = -psi + v_bar + p_j + epsilon (one neighbour)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.fmus.driver import ME, Driver, Floats
from tests.fmus.theory import solve_tightly

OpenFmu = Callable[[str, str], Driver]
T = 0.1
P_J = np.array([0.7, -0.2])
C = np.array([0.3, 0.6])  # the estimate, constant because every message carries it
A = np.array([0.5, -0.4])  # initial distance of v_bar from it
RECEIVED, OWN, FILTERED, FILTERED_AT_STAMP = 1, 2, 3, 4


def epsilon(fmu: Driver) -> Floats:
    return np.asarray(fmu.get("der(psi)") + fmu.get("psi") - fmu.get("v_bar") - P_J)


def v_bar(t: float) -> Floats:
    """Solution of v_bar'' = -2 v_bar' - 2 (v_bar - C) with v_bar(0) = C + A, v_bar'(0) = 0."""
    return np.asarray(C + A * np.exp(-t) * (np.cos(t) + np.sin(t)))


def v_bar_integral(t: float) -> Floats:
    return np.asarray(C * t - A * np.exp(-t) * np.cos(t))


def message(stamp: int, v_hat: Floats = C) -> dict[str, Any]:
    return {
        "neighbour_stamp": [stamp],
        "neighbour_time": [stamp * T],
        "neighbour_p": [P_J],
        "neighbour_v_hat": [v_hat],
    }


@pytest.mark.parametrize("model", ["ArmSyncController", "AxisSyncController"])
@pytest.mark.parametrize("version", ["fmi2", "fmi3"])
@pytest.mark.parametrize("choice", [RECEIVED, OWN, FILTERED, FILTERED_AT_STAMP])
def test_closed_forms(open_fmu: OpenFmu, model: str, version: str, choice: int) -> None:
    fmu = open_fmu(f"{model}.{version}", ME)
    fmu.initialize(
        n_neighbours=1, extrapolation=choice, v_hat_start=C, v_bar_from_estimate=0, v_bar_start=C + A, k_p=2, k_d=2
    )
    for stamp, arrival, until in [(0, 0.0, 0.17), (0, 0.17, 0.43), (3, 0.43, 0.5), (5, 0.5, 0.77), (6, 0.85, 1.234)]:
        fmu.integrate(arrival, solve_tightly)
        fmu.event(**message(stamp))
        fmu.integrate(until, solve_tightly)
        sampled, now = stamp * T, until
        expected = {
            RECEIVED: C * (now - sampled),
            OWN: C * (now - sampled),
            FILTERED: v_bar_integral(now) - v_bar_integral(sampled),
            FILTERED_AT_STAMP: v_bar(sampled) * (now - sampled),
        }[choice]
        np.testing.assert_allclose(epsilon(fmu), expected, rtol=0, atol=1e-10)


def test_own_estimate_is_integrated_piece_by_piece(open_fmu: OpenFmu) -> None:
    """The estimate jumps at ticks 1 and 5; the integral starts at the sample, inside the second piece."""
    fmu = open_fmu("ArmSyncController.fmi3", ME).initialize(n_neighbours=1, extrapolation=OWN, v_hat_start=[1.0, 0.0])
    fmu.event(**message(0, np.array([0.0, 1.0])))
    fmu.integrate(0.4, solve_tightly)
    fmu.event(**message(3, np.array([2.0, 2.0])))
    fmu.integrate(0.72, solve_tightly)
    first, second = np.array([0.5, 0.5]), np.array([1.25, 1.25])
    np.testing.assert_allclose(epsilon(fmu), first * 0.2 + second * 0.22, atol=1e-12)
    np.testing.assert_array_equal(fmu.get("v_hat"), second)


def test_received_estimate_is_the_message_s(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", ME).initialize(n_neighbours=1, v_hat_start=[9.0, 9.0])
    fmu.integrate(0.3, solve_tightly)
    fmu.event(**message(1, np.array([2.0, -1.0])))
    fmu.integrate(0.55, solve_tightly)
    np.testing.assert_allclose(epsilon(fmu), np.array([2.0, -1.0]) * 0.45, atol=1e-12)


@pytest.mark.parametrize("choice", [RECEIVED, OWN, FILTERED, FILTERED_AT_STAMP])
def test_known_velocity_uses_it(open_fmu: OpenFmu, choice: int) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", ME)
    fmu.initialize(n_neighbours=1, role=3, extrapolation=choice, v_d=[0.2, -0.3])
    fmu.integrate(0.3, solve_tightly)
    fmu.event(**message(1, np.array([7.0, 7.0])))
    fmu.integrate(0.55, solve_tightly)
    np.testing.assert_allclose(epsilon(fmu), np.array([0.2, -0.3]) * 0.45, atol=1e-12)


@pytest.mark.parametrize("choice", [OWN, FILTERED, FILTERED_AT_STAMP])
def test_sample_of_this_very_tick(open_fmu: OpenFmu, choice: int) -> None:
    """A message without delay: nothing to extrapolate yet, before the tick's event update and after it."""
    fmu = open_fmu("ArmSyncController.fmi3", ME).initialize(n_neighbours=1, extrapolation=choice, v_hat_start=C)
    fmu.integrate(0.15, solve_tightly)
    x = solve_tightly(fmu.derivatives, 0.15, 0.2, fmu.states)
    fmu.fmu.setTime(0.2)
    fmu.states = x
    fmu.fmu.enterEventMode()
    fmu.set(**message(2))
    np.testing.assert_allclose(epsilon(fmu), 0.0, atol=1e-15)
    fmu.update()
    np.testing.assert_allclose(epsilon(fmu), 0.0, atol=1e-15)


def test_sample_times_must_be_those_of_the_ticks(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", ME).initialize(n_neighbours=1, extrapolation=FILTERED)
    with pytest.raises(Exception, match="fmi3UpdateDiscreteStates failed"):
        fmu.event(**{**message(3), "neighbour_time": [0.6]})
    assert fmu.log == [
        "neighbour_time[1] is 0.6 s, but a sample of tick 3 was taken at 0.3 s: T must be the period of the messages"
    ]
