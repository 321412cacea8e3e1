"""The native loop gives the same bits as the Python loop, whatever the wiring, the steps and the arrivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.components.component import Variable
from cosim.components.opening import describe
from cosim.plan import AgentPlan, ComponentPlan, Connection, CouplingPlan, Integrator, MailboxPlan, Method, Port
from network.messages import MessageLayout
from tests.components.probe import TYPES
from tests.kernel.agents import LAYOUT, T_NS, Case, LiveAgent, live

Row = tuple[int, int, int, list[float]]


@st.composite
def messages(draw: st.DrawFn, tick: int, n_neighbours: int) -> list[Row]:
    """What changes the mailbox in the period after a tick: some at the tick itself, some at the same instant."""
    if n_neighbours == 0:
        return []
    offsets = draw(
        st.lists(st.sampled_from([0, 1, 5_000_000, 33_333_333, T_NS - 1]) | st.integers(0, T_NS - 1), max_size=4)
    )
    number = st.floats(-3.0, 3.0, width=32)
    return [
        (
            tick * T_NS + offset,
            draw(st.integers(0, n_neighbours - 1)),
            draw(st.integers(0, tick)),
            draw(st.lists(number, min_size=LAYOUT.width, max_size=LAYOUT.width)),
        )
        for offset in sorted(offsets)
    ]


@st.composite
def cases(draw: st.DrawFn, method: Method) -> Case:
    joint = method is Method.JOINT
    step_ns = draw(st.sampled_from([5_000_000, 7_654_321, 20_000_000] if joint else [1_000_000, 3_141_592]))
    return Case(
        plant=draw(st.sampled_from([2, 3])),
        controller=draw(st.sampled_from([2, 3])),
        method=method,
        integrator=draw(st.sampled_from(list(Integrator))) if joint else Integrator.RK4,
        step_ns=step_ns,
        grid=not joint and T_NS % step_ns == 0 and draw(st.booleans()),
        parts=() if joint else draw(st.sampled_from([(), (1, 3), (2, 1), (5, 4)])),
        n_neighbours=draw(st.integers(0, 3)),
        role=draw(st.sampled_from(["follower", "leader", "known_velocity"])),
        extrapolation=draw(
            st.sampled_from(["received_estimate", "own_estimate", "own_filtered", "own_filtered_at_stamp"])
        ),
        plant_first=draw(st.booleans()),
        p=(draw(st.floats(-1.5, 1.5)), draw(st.floats(-1.5, 1.5))),
    )


def trace(case: Case, periods: Sequence[Sequence[Row]], *, native: bool) -> list[bytes]:
    """Everything that the loop leaves behind, after the start and after every period."""
    with live(case, native=native, ticks=len(periods)) as agent:
        seen = [agent.snapshot()]
        for tick, rows in enumerate(periods):
            agent.advance(tick, rows)
            seen.append(agent.snapshot())
        return seen


@pytest.mark.parametrize("method", list(Method))
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_arms_with_their_controllers(method: Method, data: st.DataObject) -> None:
    case = data.draw(cases(method))
    periods = [data.draw(messages(tick, case.n_neighbours)) for tick in range(3)]
    assert trace(case, periods, native=True) == trace(case, periods, native=False)


@pytest.mark.parametrize("method", list(Method))
def test_both_versions_of_fmi_give_the_same_signals(method: Method) -> None:
    rows: list[list[Row]] = [[], [(T_NS + 12_345_678, 0, 0, [0.1, 0.2, 0.3, 0.4])], []]
    case = Case(method=method, step_ns=2_000_000)
    traces = {trace(replace(case, plant=p, controller=c), rows, native=True)[-1] for p in (2, 3) for c in (2, 3)}
    assert len(traces) == 1


def test_the_order_of_calls_does_not_matter_to_other_agents() -> None:
    """Agents share libraries and nothing else: interleaved or one after the other, the bits are the same."""
    case = Case()
    alone = trace(case, [[], []], native=True)
    with live(case, native=True) as one, live(replace(case, p=(1.0, 1.0)), native=True) as two:
        seen = [one.snapshot()]
        for tick in range(2):
            for agent in (two, one):
                agent.advance(tick)
            seen.append(one.snapshot())
    assert seen == alone


# --- the probe: every type, time events, state events --------------------------------------------------------------
def probe_pair(
    paths: Sequence[Path],
    connections: Sequence[tuple[str, str]],
    coupling: CouplingPlan,
    fails: tuple[str, str] = ("nothing", "nothing"),
    vector: tuple[float, float] = (1.0, -1.0),
) -> AgentPlan:
    """Two probes: outputs of the first feed inputs of the second; the second's `x` is published."""
    components = tuple(
        ComponentPlan(name, path, None, describe(path, None, {}), {"fails": (mode,), "vector_in": vector})
        for name, path, mode in zip(("first", "second"), paths, fails, strict=True)
    )

    def port(component: int, name: str) -> Port:
        variable: Variable = components[component].description.variables[name]
        return Port(component, variable)

    names = [c.description.variables for c in components]
    recorded = [port(c, name) for c in (0, 1) for name, v in names[c].items() if v.causality == "output" and v.size]
    recorded = [p for p in recorded if p.variable.name != "instances"]
    return AgentPlan(
        index=0,
        name="probes",
        components=components,
        connections=tuple(Connection(port(0, source), port(1, target)) for source, target in connections),
        publish=(),
        mailbox=MailboxPlan({}, None, None, None),
        neighbours=(),
        weights=(),
        coupling=coupling,
        record=tuple((p.variable.name, p) for p in recorded),
    )


def probe_trace(plan: AgentPlan, *, native: bool, ticks: int = 3) -> tuple[list[bytes], np.ndarray]:
    agent = LiveAgent(plan, native=native, layout=MessageLayout((), ()))
    try:
        agent.python.initialise(0, ticks * T_NS)
        seen = [agent.snapshot()]
        for tick in range(ticks):
            agent.advance(tick)
            seen.append(agent.snapshot())
        return seen, agent.state.signals[agent.wiring.recorded]
    finally:
        for component in agent.components:
            component.terminate()


def begins(plan: AgentPlan, name: str) -> list[int]:
    """Where the variables of a name begin in the recorded row."""
    ends = np.cumsum([port.variable.size for _, port in plan.record])
    return [
        int(end) - port.variable.size for end, (other, port) in zip(ends, plan.record, strict=True) if other == name
    ]


@pytest.mark.parametrize("method", list(Method))
@pytest.mark.parametrize("source", ["x", *(f"{name}_out" for name in TYPES)])
def test_values_of_every_type(probes: dict[int, Path], method: Method, source: str) -> None:
    coupling = CouplingPlan(method, 10_000_000)
    plan = probe_pair([probes[3], probes[3]], [(source, f"{name}_in") for name in TYPES], coupling)
    (native, signals), (python, _) = probe_trace(plan, native=True), probe_trace(plan, native=False)
    assert native == python
    assert np.all(np.isfinite(signals))


@pytest.mark.parametrize("method", list(Method))
def test_values_across_versions(probes: dict[int, Path], method: Method) -> None:
    pairs = [("vector_out", "vector_in"), *((f"{t}_out", f"{t}_in") for t in ("Int32", "Boolean", "Enumeration"))]
    for first, second in ((2, 3), (3, 2), (2, 2)):
        plan = probe_pair([probes[first], probes[second]], pairs, CouplingPlan(method, 10_000_000))
        assert probe_trace(plan, native=True)[0] == probe_trace(plan, native=False)[0]


@pytest.mark.parametrize("integrator", list(Integrator))
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("mode", ["nothing", "state_grows"], ids=["x' = 10 + vector[1]", "x' = x^3"])
def test_time_events_and_state_jumps(probes: dict[int, Path], fmi: int, integrator: Integrator, mode: str) -> None:
    """`x` loses 1 whenever it has passed 2 at the end of a step; every 0.03 s is a time event."""
    coupling = CouplingPlan(Method.JOINT, 7_000_000, integrator)
    plan = probe_pair([probes[fmi], probes[fmi]], [("vector_out", "vector_in")], coupling, (mode, mode))
    (native, signals), (python, _) = probe_trace(plan, native=True, ticks=6), probe_trace(plan, native=False, ticks=6)
    assert native == python
    for begin in begins(plan, "x"):
        assert 1.0 <= signals[begin] < 2.2
