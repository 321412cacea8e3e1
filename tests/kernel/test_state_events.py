"""State events of Model Exchange: found to the nanosecond, by both loops with the same bits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.agents.crossings import crossed, first_crossing
from cosim.plan import AgentPlan, ComponentPlan, CouplingPlan, Integrator, Method
from network.messages import MessageLayout
from tests.components.probe import description2, description3, with_indicator, write_fmu
from tests.kernel.agents import T_NS, LiveAgent
from tests.kernel.test_bits import probe_pair, probe_trace
from tests.kernel.test_failures import failure

JOINT = CouplingPlan(Method.JOINT, 7_000_000)


@pytest.fixture(scope="module")
def indicated(probe_library: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Probes with an event indicator, by version."""
    folder = tmp_path_factory.mktemp("indicated")
    texts = {2: description2(), 3: description3()}
    return {v: write_fmu(folder / f"probe{v}.fmu", probe_library, with_indicator(t)) for v, t in texts.items()}


# --- the search -----------------------------------------------------------------------------------------------------
@given(
    root=st.floats(0.0, 1e7),
    power=st.sampled_from([0.2, 1.0, 3.0, 9.0]),
    scale=st.floats(1e-9, 1e9),
    second=st.floats(0.0, 1e7),
    high=st.integers(1, 10_000_000),
)
def test_the_first_nanosecond_after_the_earliest_zero(
    root: float, power: float, scale: float, second: float, high: int
) -> None:
    def indicators(time_ns: int) -> np.ndarray:
        distances = np.array([time_ns - root, second - time_ns])
        return np.sign(distances) * scale * np.abs(distances / 1e7) ** power

    before, after = indicators(0), indicators(high)
    if not crossed(before, after).any():
        return
    calls: list[int] = []
    found = first_crossing(0, high, before, after, lambda t: (calls.append(t), indicators(t))[1])
    assert crossed(before, indicators(found)).any()
    assert not any(crossed(before, indicators(time)).any() for time in {*range(max(found - 3, 0), found), found // 2})
    assert all(0 < time < high for time in calls)
    assert len(calls) <= 3 * math.ceil(math.log2(high)) + 3


# --- the loops ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("integrator", list(Integrator))
@pytest.mark.parametrize("versions", [(2, 2), (3, 3), (2, 3)], ids=str)
def test_both_loops_give_the_same_bits(
    indicated: dict[int, Path], versions: tuple[int, int], integrator: Integrator
) -> None:
    plan = probe_pair(
        [indicated[v] for v in versions],
        [("vector_out", "vector_in"), ("x", "Int32_in" if versions[1] == 2 else "Float32_in")],
        replace(JOINT, integrator=integrator),
        vector=(3.7, 0.0),
    )
    (native, _), (python, _) = probe_trace(plan, native=True, ticks=8), probe_trace(plan, native=False, ticks=8)
    assert native == python


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("integrator", list(Integrator))
@pytest.mark.parametrize("step_ns", [T_NS, 7_000_000, 1_000_000])
def test_an_event_takes_effect_where_it_is(
    indicated: dict[int, Path], step_ns: int, integrator: Integrator, native: bool
) -> None:
    """x' = 10 + vector[1] and x falls from 2 to 1 on its way: with every step it is 1 + slope t less whole numbers."""
    slopes = (13.7, 10.3)
    coupling = replace(JOINT, step_ns=step_ns, integrator=integrator)
    plan = probe_pair([indicated[3], indicated[2]], [], coupling)
    plan = replace(plan, components=tuple(start(plan, c, (slopes[c] - 10.0, 0.0)) for c in (0, 1)))
    agent = LiveAgent(plan, native=native, layout=MessageLayout((), ()))
    agent.python.initialise(0, 5 * T_NS)
    for tick in range(5):
        agent.advance(tick)
        for c, slope in enumerate(slopes):
            exact = 1.0 + slope * 0.1 * (tick + 1) % 1.0
            assert abs(agent.value(c, "x")[0] - exact) < 1e-9 * slope * (tick + 2)
    agent.end()


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("integrator", list(Integrator))
def test_two_crossings_soon_after_an_event(indicated: dict[int, Path], integrator: Integrator, native: bool) -> None:
    """36 us after each of its 13 falls the second probe's indicator is negative for 110 us, a small part of a step.

    As that of a ball which bounces less and less: whoever missed a bounce would let it fall through the floor.
    """
    events = []
    for mode in ("nothing", "narrow"):
        plan = probe_pair([indicated[3]] * 2, [], replace(JOINT, integrator=integrator), ("nothing", mode))
        plan = replace(plan, components=tuple(start(plan, c, (3.7, 0.0)) for c in (0, 1)))
        agent = LiveAgent(plan, native=native, layout=MessageLayout((), ()))
        agent.python.initialise(0, 10 * T_NS)
        for tick in range(10):
            agent.advance(tick)
        assert agent.value(1, "x")[0] == pytest.approx(1.0 + 13.7 % 1.0, abs=1e-7)
        events.append(int(agent.value(1, "events")[0]))
        agent.end()
    assert events[1] - events[0] == 2 * 13


def start(plan: AgentPlan, component: int, vector: tuple[float, float]) -> ComponentPlan:
    own = plan.components[component]
    return replace(own, start={**own.start, "vector_in": vector})


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("indicator_nan", "event indicator 1 is not a number"),
        ("chatters", "had more than 100 state events within one step of 7 ms: an event indicator chatters"),
    ],
)
@pytest.mark.parametrize("integrator", list(Integrator))
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_same_failure(indicated: dict[int, Path], fmi: int, integrator: Integrator, mode: str, said: str) -> None:
    coupling = replace(JOINT, integrator=integrator)
    plan = probe_pair([indicated[fmi]] * 2, [("vector_out", "vector_in")], coupling, ("nothing", mode))
    component, message, log, time = failure(plan, native=True)
    assert component == "second"
    assert said in message
    assert (component, message, log, time) == failure(plan, native=False)
