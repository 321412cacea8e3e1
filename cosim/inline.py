"""The in-process run: one loop carries every message between the agents, the emulator and the master."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from cosim.agent import Agent
from cosim.components.component import Floats
from cosim.components.opening import open_components
from cosim.master import Emulate, Finish, Master
from cosim.plan import Plan
from network.emulator import Emulator
from network.messages import Fates


class Observer(Protocol):
    """Sees every tick: a recorder, a progress bar, a test."""

    def tick(self, tick: int, rows: Sequence[Floats]) -> None:
        """The recorded values of every agent at a tick, in the order of the file."""

    def fates(self, fates: Fates) -> None:
        """Messages whose fate became known in a tick."""


class Interrupted(Exception):  # noqa: N818 - it is a request, not an error
    """Somebody asked the run to stop; everything observed so far is complete up to this tick."""

    def __init__(self, tick: int) -> None:
        self.tick = tick
        super().__init__(f"interrupted after tick {tick}")


def open_agents(plan: Plan) -> list[Agent]:
    """All agents of a plan with their components instantiated; none is left open when one fails."""
    agents: list[Agent] = []
    try:
        for agent_plan in plan.agents:
            agents.append(Agent(agent_plan, plan.layout, plan.period_ns, open_components(agent_plan)))  # noqa: PERF401
    except BaseException:
        terminate(agents)
        raise
    return agents


def terminate(agents: Sequence[Agent]) -> None:
    """End all agents."""
    for agent in agents:
        agent.terminate()


def run(plan: Plan, observers: Sequence[Observer], stop_requested: Callable[[], bool] = lambda: False) -> None:
    """Play a plan from tick 0 to its last tick.

    Args:
        plan: what to run.
        observers: told of every tick and every fate, in order.
        stop_requested: asked once per tick.

    Raises:
        RunError: a component failed.
        Interrupted: `stop_requested` said so.
    """
    agents = open_agents(plan)
    try:
        _play(plan, agents, observers, stop_requested)
    finally:
        terminate(agents)


def _play(
    plan: Plan, agents: Sequence[Agent], observers: Sequence[Observer], stop_requested: Callable[[], bool]
) -> None:
    emulator = Emulator(plan.links, plan.channels, plan.link_channel, plan.layout, plan.seed, plan.period_ns)
    master = Master(len(agents), plan.layout.width, plan.ticks)
    for agent in agents:
        agent.initialise(plan.ticks * plan.period_ns)
    while True:
        tick = master.tick
        instruction: Emulate | Finish | None = None
        for index, agent in enumerate(agents):
            instruction = master.published(index, tick, agent.message())
        rows = [agent.row() for agent in agents]
        for observer in observers:
            observer.tick(tick, rows)
        if not isinstance(instruction, Emulate):
            break
        if stop_requested():
            raise Interrupted(tick)
        exchange = emulator.emulate(instruction.tick, instruction.values)
        for observer in observers:
            observer.fates(exchange.fates)
        for order in master.exchanged(exchange):
            agents[order.agent].advance(order.tick, order.deliveries)
    in_flight = emulator.finish()
    for observer in observers:
        observer.fates(in_flight)
