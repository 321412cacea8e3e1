"""The agents of a worker, or of the in-process run, opened and advanced together. Pure given their components.

What they publish and what is recorded of them lies in one array, and is gathered by one call of numpy. Agents made of
FMUs are advanced by one call of the native loop, the others one after the other. The outcome is that of advancing each
in its turn: agents do not meet but through the mail, and of several failures that of the first agent counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cosim.agent import Agent
from cosim.components.component import Component, Floats
from cosim.components.opening import await_open, open_components, terminate
from cosim.logs import NO_LOGS, Logs
from cosim.mailbox import Mailboxes
from cosim.memory import LoopMemory
from cosim.plan import AgentPlan, Loop, Plan
from cosim.wiring import Wirings
from network.messages import Ints, Mail

if TYPE_CHECKING:
    from cosim.kernel import NativeBlock

NOTHING: Mapping[int, Floats] = {}


class Agents:
    """The call order is `initialise`, then for every tick: `samples`, `row`, `advance`; at the end `terminate`.

    Args:
        plan: of the whole run.
        own: which of its agents; all of them by default.
        attended: (1,) kept up to date for whoever looks at it from outside: which of `own` is being initialised or
            advanced, -1 for none.
        logs: where what the components log goes.

    Raises:
        ConfigError: a component cannot be opened; none is left open.
        RunError: a component refuses.
    """

    def __init__(
        self, plan: Plan, own: Sequence[AgentPlan] | None = None, attended: Ints | None = None, logs: Logs = NO_LOGS
    ) -> None:
        self._plan = plan
        self._attended = np.full(1, -1) if attended is None else attended
        own = plan.agents if own is None else own
        wirings = Wirings(plan.layout)
        wired = [wirings.of(agent) for agent in own]
        self._memory = LoopMemory(
            [(wiring.n_signals, len(agent.components)) for agent, wiring in zip(own, wired, strict=True)]
        )
        self._agents: list[Agent] = []
        opened: list[list[Component]] = []
        self._native: NativeBlock | None = None
        try:
            for agent in own:
                opened.append(open_components(agent, logs))  # noqa: PERF401 - what is open is known when the next one fails
            for index, (agent, wiring, components) in enumerate(zip(own, wired, opened, strict=True)):
                await_open(agent, components)
                self._agents.append(Agent(agent, wiring, plan.period_ns, components, self._memory.state(index)))
            self._by_themselves = [i for i, agent in enumerate(own) if agent.coupling.loop is Loop.PYTHON]
            self._mailboxes = Mailboxes([len(own[i].neighbours) for i in self._by_themselves], plan.period_ns)
            self._native = self._native_block([i for i, agent in enumerate(own) if agent.coupling.loop is Loop.NATIVE])
        except BaseException:
            for components in opened:
                terminate(components)
            raise
        self._fed = [agent for agent in self._agents if agent.plan.external]
        self._places_of_samples = self._published()
        self._places_of_row = self._recorded()

    def initialise(self) -> None:
        """Bring all agents to tick 0.

        Raises:
            RunError: a component failed.
        """
        for index, agent in enumerate(self._agents):
            self._attended[0] = index
            agent.initialise(self._plan.ticks * self._plan.period_ns)
        self._attended[0] = -1

    def samples(self) -> Floats:
        """(n_agents, width) what the agents publish at the current tick; zero where nobody hears one."""
        return self._memory.signals[self._places_of_samples]

    def row(self) -> Floats:
        """What is recorded at the current tick, agent by agent, before deliveries of this very instant take effect."""
        return self._memory.signals[self._places_of_row]

    def advance(self, tick: int, mail: Mail, taken: Mapping[int, Floats] = NOTHING) -> None:
        """From `tick` to the next one; deliveries take effect at their exact times of arrival.

        Args:
            tick: at which the agents are.
            mail: the deliveries.
            taken: values from outside that are new at this tick, by subscription; they take effect at once.

        Raises:
            RunError: a component failed. Nothing may be advanced afterwards.
        """
        if taken:
            for agent in self._fed:
                agent.take(tick, taken)
        failed = self._native.advance(tick, mail) if self._native else None
        if self._by_themselves:
            updates = self._mailboxes.accept(mail if self._native is None else mail.of(self._by_themselves))
            for place, index in enumerate(self._by_themselves):
                if failed and failed.index < index:
                    break
                self._attended[0] = index
                self._agents[index].advance(tick, updates, place)
        self._attended[0] = -1
        if failed:
            raise self._agents[failed.index].failure(failed.error) from failed.error

    def terminate(self) -> None:
        """End all components; safe after a failure, and twice."""
        if self._native:
            self._native.end()
        for agent in self._agents:
            agent.terminate()

    def _native_block(self, members: list[int]) -> NativeBlock | None:
        if not members:
            return None
        from cosim.kernel import Member, NativeBlock

        found = [self._agents[i] for i in members]
        native = [Member(i, a.wiring, a.components, a.plan.coupling) for i, a in zip(members, found, strict=True)]
        return NativeBlock(native, self._memory, self._plan.period_ns, self._attended)

    def _with_first_signal(self) -> Iterator[tuple[Agent, int]]:
        return zip(self._agents, self._memory.first_signal[:-1].tolist(), strict=True)

    def _published(self) -> NDArray[np.intp]:
        """(n_agents, width) where samples lie in the signals; those of agents that nobody hears at the final zero."""
        silent = self._memory.signals.size - 1
        places = np.full((len(self._agents), self._plan.layout.width), silent, np.intp)
        for row, (agent, first) in zip(places, self._with_first_signal(), strict=True):
            if agent.wiring.published.size:
                row[:] = agent.wiring.published + first
        return places

    def _recorded(self) -> NDArray[np.intp]:
        """Where the recorded numbers lie in the signals."""
        places = [agent.wiring.recorded + first for agent, first in self._with_first_signal()]
        return np.concatenate([np.empty(0, np.intp), *places], dtype=np.intp)
