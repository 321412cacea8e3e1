"""FMUs that accept communication steps of one length only: arrivals wait for the end of a step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cosim.plan import AgentPlan, CouplingPlan, MailboxPlan, Method, Port
from network.messages import MessageLayout
from tests.kernel.agents import T_NS, LiveAgent
from tests.kernel.test_bits import probe_pair

LAYOUT = MessageLayout(("vector",), (2,))
MILLISECOND = 1_000_000


def hearing(paths: list[Path], method: Method) -> AgentPlan:
    """Two probes; the second hears one neighbour, and x' = 10 + what it said."""
    coupling = CouplingPlan(method, 10 * MILLISECOND, grid=True)
    plan = probe_pair(paths, [("x", "Float32_in")], coupling, ("step_fixed", "step_fixed"), (-10.0, 0.0))
    heard = Port(1, plan.components[1].description.variables["vector_in"])
    mailbox = MailboxPlan({"vector": heard}, None, None, None)
    return replace(plan, mailbox=mailbox, neighbours=(7,), weights=(1.0,))


@pytest.mark.parametrize("method", [Method.JACOBI, Method.GAUSS_SEIDEL])
@pytest.mark.parametrize("native", [True, False])
def test_arrivals_wait_for_the_end_of_a_step(probes: dict[int, Path], method: Method, *, native: bool) -> None:
    """The probes return Error on a step of any other length, or that begins elsewhere."""
    agent = LiveAgent(hearing([probes[3], probes[3]], method), native=native, layout=LAYOUT)
    agent.python.initialise(0, 3 * T_NS)
    start = agent.value(1, "x")[0]
    # at 20 ms exactly, at 25 ms (counts from 30 ms), after it one of the same instant, and in the last step
    agent.advance(0, [(20 * MILLISECOND, 0, 0, [-8.0, 0.0]), (25 * MILLISECOND, 0, 1, [-6.0, 0.0])])
    first = agent.value(1, "x")[0]
    assert first - start == pytest.approx(0.020 * 0 + 0.010 * 2 + 0.070 * 4)  # the input starts at -10
    agent.advance(1, [(T_NS + 95 * MILLISECOND, 0, 2, [-10.0, 0.0]), (2 * T_NS - 1, 0, 3, [-9.0, 0.0])])
    second = agent.value(1, "x")[0]
    assert second - first == pytest.approx(0.1 * 4)
    agent.advance(2)
    assert agent.value(1, "x")[0] - second == pytest.approx(0.1 * 1)
    agent.end()


def test_both_loops_give_the_same_bits(probes: dict[int, Path]) -> None:
    rows = [
        [(20 * MILLISECOND, 0, 0, [-8.0, 0.0]), (25 * MILLISECOND + 1, 0, 1, [-6.0, 0.3])],
        [(T_NS + 91 * MILLISECOND, 0, 2, [1.0, 0.0]), (2 * T_NS - 1, 0, 1, [5.0, 0.0])],
        [],
    ]
    seen = []
    for native in (True, False):
        agent = LiveAgent(hearing([probes[2], probes[3]], Method.JACOBI), native=native, layout=LAYOUT)
        agent.python.initialise(0, 3 * T_NS)
        seen.append([])
        for tick, came in enumerate(rows):
            agent.advance(tick, came)
            seen[-1].append(agent.snapshot())
        agent.end()
    assert seen[0] == seen[1]
