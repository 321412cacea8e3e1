"""Events of Model Exchange against exact solutions, with both loops: the same bits, and the right ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.plan import AgentPlan, CouplingPlan, Integrator, Method
from network.messages import MessageLayout
from tests.components.probe import TYPES
from tests.kernel.agents import T_NS, LiveAgent
from tests.kernel.test_bits import probe_pair

JOINT = CouplingPlan(Method.JOINT, 7_000_000)


def played(plan: AgentPlan, ticks: int) -> float:
    """The second probe's `x` at the end, with both loops."""
    traces, found = [], 0.0
    for native in (True, False):
        agent = LiveAgent(plan, native=native, layout=MessageLayout((), ()))
        agent.python.initialise(0, ticks * T_NS)
        traces.append([agent.snapshot()])
        for tick in range(ticks):
            agent.advance(tick)
            traces[-1].append(agent.snapshot())
        found = agent.value(1, "x").item()
        agent.end()
    assert traces[0] == traces[1]
    return found


@pytest.mark.parametrize("interval", [0.03, 1 / 3, 1 / 60, 0.1, 0.1 + 2e-10], ids=lambda x: f"{x:.10g}")
@pytest.mark.parametrize("integrator", list(Integrator))
@pytest.mark.parametrize("versions", [(2, 2), (3, 3), (2, 3)], ids=str)
def test_time_events_and_a_discrete_input_that_they_change(
    probes: dict[int, Path], versions: tuple[int, int], integrator: Integrator, interval: float
) -> None:
    """The first counts the multiples of an interval, and none before it is due to the last bit; the second integrates
    that number, and refuses a whole number that it is given between events. An event is at most 1 ns late.
    """
    plan = probe_pair(
        [probes[v] for v in versions],
        [("count", "Int32_in")],
        replace(JOINT, integrator=integrator),
        ("ticks", "ticks"),
        (0.0, interval),
    )
    events = interval * np.arange(1, 100)
    exact = 1.0 + np.maximum(0.5 - events, 0.0).sum()
    assert exact - 1.1e-9 * len(events[events < 0.5]) < played(plan, ticks=5) < exact + 1e-13


@pytest.mark.parametrize("name", TYPES[1:])
def test_no_discrete_input_is_set_between_events(probes: dict[int, Path], name: str) -> None:
    played(probe_pair([probes[3]] * 2, [("x", f"{name}_in")], JOINT), ticks=2)


@pytest.mark.parametrize("delay", [0.0211, 1 / 300, 0.131], ids=lambda x: f"{x:.4g}")
@pytest.mark.parametrize("integrator", list(Integrator))
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_time_event_that_a_step_event_schedules(
    probes: dict[int, Path], fmi: int, integrator: Integrator, delay: float
) -> None:
    """x' = 10; where a step ends beyond 1.25 the probe asks for an event, begins at 1 again and stands still from
    `delay` later on.
    """
    plan = probe_pair([probes[fmi]] * 2, [], replace(JOINT, integrator=integrator), ("nothing", "arms"), (0.0, delay))
    assert played(plan, ticks=3) == pytest.approx(1.0 + 10.0 * delay, abs=1.1e-8)
