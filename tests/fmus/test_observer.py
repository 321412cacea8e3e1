"""The discrete observer against an independent model of it, in both interfaces and versions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fmus.driver import CS, ME, Driver
from tests.fmus.theory import Arrival, observer, runge_kutta

N, T, TICKS = 3, 0.1, 12
START = np.array([0.2, -0.4])
OpenFmu = Callable[[str, str], Driver]
KINDS = [(version, interface) for version in ("fmi2", "fmi3") for interface in (ME, CS)]


class Mailbox:
    """Keeps the freshest message of every neighbour: an older stamp that arrives later is not shown to the FMU."""

    def __init__(self) -> None:
        self.stamp = np.full(N, -1)
        self.v_hat = np.zeros((N, 2))

    def put(self, arrival: Arrival) -> None:
        if arrival.stamp > self.stamp[arrival.neighbour]:
            self.stamp[arrival.neighbour] = arrival.stamp
            self.v_hat[arrival.neighbour] = arrival.v_hat

    def inputs(self) -> dict[str, Any]:
        return {
            "neighbour_stamp": self.stamp,
            "neighbour_time": np.maximum(self.stamp, 0) * T,
            "neighbour_v_hat": self.v_hat,
        }


def estimates(fmu: Driver, arrivals: list[Arrival]) -> np.ndarray:
    """v_hat at every tick, with every message given to the FMU at its arrival."""
    fmu.initialize(n_neighbours=N, v_hat_start=START, solver_step=0.05)
    mailbox, result = Mailbox(), []
    times = sorted({a.time for a in arrivals} | {k * T for k in range(TICKS + 1)})
    for time in times:
        if fmu.interface == CS and time > fmu.time:
            fmu.step_to(time)
        elif fmu.interface == ME:
            fmu.integrate(time, runge_kutta(0.05))
        if any(abs(time - k * T) < 1e-9 for k in range(TICKS + 1)):
            result.append(fmu.get("v_hat"))
        for arrival in (a for a in arrivals if a.time == time):
            mailbox.put(arrival)
        if fmu.interface == CS:
            fmu.set(**mailbox.inputs())
        else:
            fmu.event(**mailbox.inputs())
    return np.array(result)


@st.composite
def schedules(draw: st.DrawFn) -> list[Arrival]:
    """Messages with delays that are multiples of a quarter period, zero included, in and out of order."""
    arrivals = []
    for neighbour in range(N):
        for stamp in draw(st.lists(st.integers(0, TICKS - 1), unique=True, max_size=6)):
            quarters = draw(st.integers(0, 14))
            time = stamp * T if quarters == 0 else stamp * T + quarters * T / 4
            time = round(time / T) * T if quarters % 4 == 0 else time
            value = (draw(st.floats(-1, 1, width=32)), draw(st.floats(-1, 1, width=32)))
            arrivals.append(Arrival(time, neighbour, stamp, value))
    return sorted((a for a in arrivals if a.time <= TICKS * T + 1e-9), key=lambda a: (a.time, a.neighbour, a.stamp))


@pytest.mark.parametrize(("version", "interface"), KINDS)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arrivals=schedules())
def test_observer_is_the_papers(open_fmu: OpenFmu, version: str, interface: str, arrivals: list[Arrival]) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", interface)
    np.testing.assert_array_equal(estimates(fmu, arrivals), observer(arrivals, START, N, T, TICKS))


@pytest.mark.parametrize(("version", "interface"), KINDS)
def test_message_without_delay_counts_at_its_own_tick(open_fmu: OpenFmu, version: str, interface: str) -> None:
    arrivals = [Arrival(2 * T, 0, 2, (1.0, 1.0)), Arrival(2 * T, 1, 2, (0.5, 0.0))]
    result = estimates(open_fmu(f"ArmSyncController.{version}", interface), arrivals)
    np.testing.assert_array_equal(result[:3], [START] * 3)
    np.testing.assert_array_equal(result[3], ((START + 1.0) + np.array([0.5, 0.0])) / 3)
    np.testing.assert_array_equal(result[4], result[3])


def test_last_evaluation_at_a_tick_wins(open_fmu: OpenFmu) -> None:
    """Super-dense time: the same instant is evaluated again when another message arrives at it."""
    fmu = open_fmu("ArmSyncController.fmi3", ME).initialize(n_neighbours=N, v_hat_start=START)
    fmu.event(neighbour_stamp=[0, -1, -1], neighbour_v_hat=[[1, 1], [0, 0], [0, 0]])
    fmu.event(neighbour_stamp=[0, 0, -1], neighbour_v_hat=[[1, 1], [3, 5], [0, 0]])
    fmu.event()
    fmu.integrate(T, runge_kutta(0.05))
    np.testing.assert_array_equal(fmu.get("v_hat"), ((START + 1.0) + np.array([3.0, 5.0])) / 3)


@pytest.mark.parametrize("version", ["fmi2", "fmi3"])
def test_one_step_over_several_ticks_updates_at_each(open_fmu: OpenFmu, version: str) -> None:
    """Inputs are held, so the message counts at its first tick only."""
    fmu = open_fmu(f"ArmSyncController.{version}", CS).initialize(n_neighbours=N, v_hat_start=START)
    fmu.set(neighbour_stamp=[0, -1, -1], neighbour_v_hat=[[1, 1], [9, 9], [9, 9]])
    fmu.step_to(0.57)
    np.testing.assert_array_equal(fmu.get("v_hat"), (START + 1.0) / 2)


def test_start_between_two_ticks(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", CS).initialize(start_time=0.25, n_neighbours=N, v_hat_start=START)
    fmu.set(neighbour_stamp=[1, -1, -1], neighbour_time=[0.1, 0, 0], neighbour_v_hat=[[1, 1], [0, 0], [0, 0]])
    fmu.step_to(0.35)
    np.testing.assert_array_equal(fmu.get("v_hat"), START)
    fmu.step_to(0.45)
    np.testing.assert_array_equal(fmu.get("v_hat"), (START + 1.0) / 2)
