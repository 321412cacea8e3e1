"""Agents of shipped FMUs, planned by hand, and both loops over them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

import fmus
from cosim.agents.coupling import PythonLoop
from cosim.agents.mailbox import Mailboxes
from cosim.agents.memory import LoopMemory
from cosim.agents.wiring import wire
from cosim.components.component import Component, Value, Variable, head
from cosim.components.opening import describe, open_components
from cosim.kernel import Member, NativeBlock
from cosim.plan import AgentPlan, ComponentPlan, Connection, CouplingPlan, Integrator, MailboxPlan, Method, Port
from network.messages import Mail, MessageLayout

T_NS = 100_000_000
LAYOUT = MessageLayout(("p", "v_hat"), (2, 2))


@dataclass(frozen=True)
class Case:
    """An agent: versions of FMI of its plant and its controller, how it is coupled, how many neighbours it hears."""

    plant: int = 3
    controller: int = 3
    method: Method = Method.JOINT
    integrator: Integrator = Integrator.RK4
    step_ns: int = 5_000_000
    n_neighbours: int = 2
    role: str = "follower"
    extrapolation: str = "received_estimate"
    plant_first: bool = True
    adaptation_sign: float = -1.0
    p: tuple[float, float] = (0.4, -1.1)
    grid: bool = False
    parts: tuple[int, ...] = ()


def plan(case: Case) -> AgentPlan:
    n = case.n_neighbours
    structural = {"n_neighbours": n}
    plant = component("plant", "TwoLinkArm", case.plant, {"p": case.p, "v": (0.1, 0.0)})
    controller = component(
        "controller",
        "ArmSyncController",
        case.controller,
        {
            "n_neighbours": (n,),
            "role": (case.role,),
            "extrapolation": (case.extrapolation,),
            "adaptation_sign": (case.adaptation_sign,),
            "v_hat_start": (0.05, -0.02),
        },
        structural,
    )
    components = (plant, controller) if case.plant_first else (controller, plant)
    at = {"plant": 1 - int(case.plant_first), "controller": int(case.plant_first)}

    def port(name: str, variable: str, *rows: int) -> Port:
        found = components[at[name]].description.variables[variable]
        return Port(at[name], head(found, rows + found.shape[len(rows) :]) if rows else found)

    record = [port("plant", "p"), port("plant", "v"), port("controller", "u"), port("controller", "theta_hat")]
    return AgentPlan(
        index=0,
        name="1",
        components=components,
        connections=(
            Connection(port("plant", "p"), port("controller", "p")),
            Connection(port("plant", "v"), port("controller", "v")),
            Connection(port("controller", "u"), port("plant", "u")),
        ),
        publish=(port("plant", "p"), port("controller", "v_hat")),
        mailbox=MailboxPlan(
            {"p": port("controller", "neighbour_p", n), "v_hat": port("controller", "neighbour_v_hat", n)},
            stamp=port("controller", "neighbour_stamp", n),
            time=port("controller", "neighbour_time", n),
            weight=port("controller", "weight", n),
        ),
        neighbours=tuple(range(1, n + 1)),
        weights=(1.0 / n,) * n if n else (),
        coupling=CouplingPlan(case.method, case.step_ns, case.integrator, grid=case.grid, parts=case.parts),
        record=tuple((f"x.{p.variable.name}", p) for p in record),
    )


def component(
    name: str, model: str, fmi: int, start: dict[str, Sequence[Value]], structural: dict[str, int] | None = None
) -> ComponentPlan:
    path = fmus.path(f"{model}.fmi{fmi}")
    description = describe(path, None, structural or {})
    return ComponentPlan(name, path, None, description, {key: tuple(value) for key, value in start.items()})


def mail(rows: Sequence[tuple[int, int, int, Sequence[float]]], layout: MessageLayout = LAYOUT) -> Mail:
    """For one agent, from (arrival in ns, slot, stamp, values), in the order of arrival."""
    arrival, slot, stamp = (np.array([row[i] for row in rows], dtype=np.int64) for i in range(3))
    values = np.array([row[3] for row in rows], dtype=np.float64).reshape(len(rows), layout.width)
    return Mail(np.array([0, len(rows)]), arrival, slot, stamp, values)


class LiveAgent:
    """The components of a plan, with one of the two loops."""

    def __init__(self, agent: AgentPlan, *, native: bool, layout: MessageLayout = LAYOUT) -> None:
        self.components: list[Component] = open_components(agent)
        self.wiring = wire(agent, layout)
        self.memory = LoopMemory([(self.wiring.n_signals, len(self.components))])
        self.state = self.memory.state(0)
        self.wiring.fill(self.state.signals, agent)
        self.python = PythonLoop(self.wiring, self.components, agent.coupling, self.state)
        self._mailbox = Mailboxes([len(agent.neighbours)], T_NS)
        member = Member(0, self.wiring, self.components, agent.coupling)
        self._block = NativeBlock([member], self.memory, T_NS) if native else None
        self._layout = layout

    def advance(self, tick: int, rows: Sequence[tuple[int, int, int, Sequence[float]]] = ()) -> None:
        """To the next tick; raises the `ComponentError`."""
        came = mail(rows, self._layout)
        if self._block is None:
            self.python.advance(tick * T_NS, (tick + 1) * T_NS, self._mailbox.accept(came))
        elif failed := self._block.advance(tick, 1, came)[1]:
            raise failed.error

    def end(self) -> None:
        """End the components, as `cosim.agents.group.Agents` does."""
        if self._block is not None:
            self._block.end()
        for component in self.components:
            component.terminate()

    def snapshot(self) -> bytes:
        """Every bit that the loop leaves behind."""
        state = self.state
        arrays = (state.signals, state.previous, state.steps, state.next_event, state.time)
        return b"".join(array.tobytes() for array in arrays)

    def value(self, component: int, name: str) -> np.ndarray:
        found: Variable = self.components[component].description.variables[name]
        return self.components[component].get(found)


@contextmanager
def live(case: Case, *, native: bool, ticks: int = 100) -> Iterator[LiveAgent]:
    """An initialised agent, ended afterwards."""
    agent = LiveAgent(plan(case), native=native)
    try:
        agent.python.initialise(0, ticks * T_NS)
        yield agent
    finally:
        agent.end()


__all__ = ["LAYOUT", "T_NS", "Case", "LiveAgent", "component", "live", "mail", "plan", "replace"]
