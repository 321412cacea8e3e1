"""Agents with components in Python, alone and beside an FMU, through the Python loop."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import fmus
from cosim.agents.coupling import PythonLoop
from cosim.agents.mailbox import Updates
from cosim.agents.memory import LoopMemory
from cosim.agents.wiring import wire
from cosim.components.component import Floats
from cosim.components.opening import describe, open_components
from cosim.components.python import Input, Output, PythonComponent, State
from cosim.plan import AgentPlan, ComponentPlan, Connection, CouplingPlan, Integrator, MailboxPlan, Method, Port
from network.messages import MessageLayout

T_NS = 100_000_000
NONE = np.empty(0, np.int64)
NO_UPDATES = Updates([0, 0], [], [], np.empty((0, 2)))


class Lag(PythonComponent):
    """x' = u - x, sampled every 30 ms."""

    u = Input()
    x = State()
    sampled = Output(depends_on=())

    def derivatives(self, time: float) -> Mapping[str, Any]:
        return {"x": self.u - self.x}

    def event(self, time: float) -> None:
        if abs(time / 0.03 - round(time / 0.03)) < 1e-9:
            self.sampled = self.x

    def next_event(self, time: float) -> float | None:
        return (math.floor(time / 0.03 + 1e-9) + 1) * 0.03


class Damper(PythonComponent):
    """Holds an arm against gravity near a posture."""

    p = Input(shape=(2,), unit="rad")
    v = Input(shape=(2,), unit="rad/s")
    u = Output(shape=(2,), depends_on=("p", "v"), unit="N.m")

    def outputs(self, time: float) -> None:
        self.u = -20.0 * (self.p - 0.1) - 5.0 * self.v


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """pytest imports this file under a name of its own."""
    monkeypatch.setitem(sys.modules, "mixed_agent", sys.modules[Lag.__module__])


def component(name: str, source: str, **start: tuple[float, ...]) -> ComponentPlan:
    path = fmus.path(source) if ":" not in source else None
    return ComponentPlan(name, path, source if path is None else None, describe(path, source, {}), start)


def agent(
    components: tuple[ComponentPlan, ...],
    wires: list[tuple[int, str, int, str]],
    coupling: CouplingPlan,
    record: list[tuple[int, str]],
) -> AgentPlan:
    def port(index: int, name: str) -> Port:
        return Port(index, components[index].description.variables[name])

    return AgentPlan(
        index=0,
        name="mixed",
        components=components,
        connections=tuple(Connection(port(a, x), port(b, y)) for a, x, b, y in wires),
        publish=(),
        mailbox=MailboxPlan({}, None, None, None),
        neighbours=(),
        weights=(),
        coupling=coupling,
        record=tuple((name, port(index, name)) for index, name in record),
    )


def recorded(plan: AgentPlan, ticks: int) -> Floats:
    """The recorded values at every tick, shape (ticks + 1, width)."""
    components = open_components(plan)
    wiring = wire(plan, MessageLayout((), ()))
    state = LoopMemory([(wiring.n_signals, len(components))]).state(0)
    wiring.fill(state.signals, plan)
    loop = PythonLoop(wiring, components, plan.coupling, state)
    try:
        loop.initialise(0, ticks * T_NS)
        rows = [state.signals[wiring.recorded]]
        for tick in range(ticks):
            loop.advance(tick * T_NS, (tick + 1) * T_NS, NO_UPDATES)
            rows.append(state.signals[wiring.recorded])
    finally:
        for live in components:
            live.terminate()
    return np.array(rows)


@pytest.mark.parametrize(
    ("integrator", "error"), [(Integrator.EULER, 5e-3), (Integrator.RK4, 1e-9), (Integrator.DORMAND_PRINCE, 1e-9)]
)
def test_python_components_alone(integrator: Integrator, error: float) -> None:
    """x' = 2 sin t - x has the solution sin t - cos t + exp(-t)."""
    components = (component("sine", "cosim.components.library:Sine"), component("lag", "mixed_agent:Lag"))
    coupling = CouplingPlan(Method.JOINT, 5_000_000, integrator)
    rows = recorded(agent(components, [(0, "phi", 1, "u")], coupling, [(1, "x"), (1, "sampled")]), ticks=9)
    t: Floats = np.linspace(0.0, 0.9, 10)
    for time, column in ((t, 0), (np.floor(t / 0.03 + 1e-9) * 0.03, 1)):
        exact = np.sin(time) - np.cos(time) + np.exp(-time)
        assert np.abs(rows[:, column] - exact).max() < error


@pytest.mark.parametrize("name", ["TwoLinkArm.fmi2", "TwoLinkArm.fmi3"])
def test_an_fmu_beside_a_python_component(name: str) -> None:
    """Every coupling tends to the same motion; the closer, the higher its order."""
    components = (component("arm", name, p=(0.4, -0.2)), component("damper", "mixed_agent:Damper"))
    wires = [(0, "p", 1, "p"), (0, "v", 1, "v"), (1, "u", 0, "u")]
    joint = agent(components, wires, CouplingPlan(Method.JOINT, 2_500_000), [(0, "p"), (0, "v")])
    exact = recorded(joint, ticks=5)
    errors = {}
    for method in (Method.MIDPOINT, Method.GAUSS_SEIDEL, Method.JACOBI):
        plan = replace(joint, coupling=CouplingPlan(method, 1_000_000))
        errors[method] = np.abs(recorded(plan, ticks=5) - exact).max()
    assert errors[Method.MIDPOINT] < 1e-4
    assert errors[Method.MIDPOINT] < 0.1 * errors[Method.GAUSS_SEIDEL]
    assert max(errors.values()) < 0.1
