"""Co-Simulation FMUs of FMI 3.0 that have an Event Mode and return early: both loops give the same bits.

The probe returns Error if a step begins in Event Mode, or a discrete input is set outside of it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cosim.plan import CouplingPlan, MailboxPlan, Method, Port
from network.messages import MessageLayout
from tests.components.probe import TYPES, description3, with_event_mode, write_fmu
from tests.kernel.agents import T_NS, LiveAgent
from tests.kernel.test_bits import probe_pair, probe_trace
from tests.kernel.test_failures import failure

METHODS = (Method.JACOBI, Method.GAUSS_SEIDEL, Method.MIDPOINT)


@pytest.fixture(scope="module")
def eventful(probe_library: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The probe with an Event Mode."""
    folder = tmp_path_factory.mktemp("eventful")
    return write_fmu(folder / "probe.fmu", probe_library, with_event_mode(description3()))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("names", [TYPES, ("Float32",)], ids=["discrete inputs", "a continuous input"])
def test_both_loops_give_the_same_bits(eventful: Path, method: Method, names: tuple[str, ...]) -> None:
    plan = probe_pair([eventful] * 2, [(f"{t}_out", f"{t}_in") for t in names], CouplingPlan(method, 10_000_000))
    assert probe_trace(plan, native=True)[0] == probe_trace(plan, native=False)[0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("native", [True, False])
def test_events_inside_a_step(eventful: Path, method: Method, *, native: bool) -> None:
    """x' = 10, and at an event every 0.03 s x loses 1 if it has reached 2: no event waits for the end of a step."""
    plan = probe_pair([eventful] * 2, [], CouplingPlan(method, 25_000_000), vector=(0.0, 0.0))
    agent = LiveAgent(plan, native=native, layout=MessageLayout((), ()))
    agent.python.initialise(0, 2 * T_NS)
    for tick, (lost, events) in enumerate([(0, 3), (1, 6)]):  # x reaches 2 at 0.1 s and loses 1 at 0.12 s
        agent.advance(tick)
        assert agent.value(1, "x")[0] == pytest.approx(1.0 + 10.0 * 0.1 * (tick + 1) - lost)
        assert agent.value(1, "events")[0] == 1 + events  # the first is that of the start
    agent.end()


@pytest.mark.parametrize("native", [True, False])
def test_arrivals_are_input_events(eventful: Path, *, native: bool) -> None:
    plan = probe_pair([eventful] * 2, [], CouplingPlan(Method.JACOBI, 10_000_000))
    heard = Port(1, plan.components[1].description.variables["Int8_in"])
    plan = replace(plan, mailbox=MailboxPlan({"n": heard}, None, None, None), neighbours=(7,), weights=(1.0,))
    agent = LiveAgent(plan, native=native, layout=MessageLayout(("n",), (1,)))
    agent.python.initialise(0, T_NS)
    agent.advance(0, [(12_345_678, 0, 0, [5.0])])
    assert agent.value(1, "Int8_out")[0] == 5.0
    agent.end()


@pytest.mark.parametrize("mode", ["early_forever", "step_error", "step_stops"])
def test_the_same_failure(eventful: Path, mode: str) -> None:
    plan = probe_pair([eventful] * 2, [], CouplingPlan(Method.JACOBI, 10_000_000), ("nothing", mode))
    component, message, log, time = failure(plan, native=True)
    assert component == "second"
    assert mode != "early_forever" or "returned early more than 100 times within one step" in message
    assert (component, message, log, time) == failure(plan, native=False)
