"""The agents of a worker, or of the in-process run, opened and advanced together. Pure given their components.

What they publish and what is recorded of them lies in one array, and is gathered by one call of numpy. Agents made of
FMUs are advanced by one call of the native loop (where there are no others, over all ticks whose mail is there), the
others one after the other. The outcome is that of advancing each in its turn: agents do not meet but through the mail,
and of several failures at a tick that of the first agent counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cosim.agents.agent import Agent
from cosim.agents.mailbox import Mailboxes, Updates
from cosim.agents.memory import LoopMemory
from cosim.agents.step_control import StepAccount
from cosim.agents.wiring import Wirings
from cosim.attention import AGENT, TICK, Spot, idle
from cosim.components.component import Component, Floats
from cosim.components.opening import await_open, open_components, terminate
from cosim.errors import ComponentError, RunError
from cosim.logs import NO_LOGS, Logs
from cosim.plan import AgentPlan, Loop, Plan
from network.messages import Ints, Mail

if TYPE_CHECKING:
    from cosim.kernel import Failed, NativeBlock

NOTHING: Mapping[int, Floats] = {}


@dataclass(frozen=True)
class Course:
    """What agents did over ticks that follow each other.

    Attributes:
        samples: (n_ticks, n_agents, width) what they publish at each tick that they have come to.
        rows: (n_ticks, row_width) what is recorded there.
        error: why they came no further.
    """

    samples: Floats
    rows: Floats
    error: RunError | None

    def __len__(self) -> int:
        """How many ticks."""
        return len(self.rows)


class Agents:
    """The call order is `initialise`, `samples` and `row` of tick 0, then for every tick `advance`, after which those
    of the next can be had, or `advance_several`, which gives them; at the end `terminate`.

    Args:
        plan: of the whole run.
        own: which of its agents; all of them by default.
        attended: kept up to date; see `cosim.attention`.
        logs: where what the components log goes.

    Raises:
        ConfigError: a component cannot be opened; none is left open.
        RunError: a component refuses.
    """

    def __init__(
        self, plan: Plan, own: Sequence[AgentPlan] | None = None, attended: Ints | None = None, logs: Logs = NO_LOGS
    ) -> None:
        self._plan = plan
        self._attended = idle() if attended is None else attended
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
            for index, agent in enumerate(own):
                self._attend(index)
                opened.append(open_components(agent, logs, self._attended))
            for index, (agent, wiring, components) in enumerate(zip(own, wired, opened, strict=True)):
                self._attend(index)
                await_open(agent, components)
                self._agents.append(Agent(agent, wiring, plan.period_ns, components, self._memory.state(index)))
            self._by_themselves = [i for i, agent in enumerate(own) if agent.coupling.loop is Loop.PYTHON]
            self._mailboxes = Mailboxes([len(own[i].neighbours) for i in self._by_themselves], plan.period_ns)
            self._places_of_samples = self._published()
            self._places_of_row = self._recorded()
            self._native = self._native_block([i for i, agent in enumerate(own) if agent.coupling.loop is Loop.NATIVE])
        except BaseException:
            for components in opened:
                terminate(components)
            raise
        self._attend(-1)
        self._fed = [agent for agent in self._agents if agent.plan.external]

    def initialise(self) -> None:
        """Bring all agents to tick 0.

        Raises:
            RunError: a component failed.
        """
        for index, agent in enumerate(self._agents):
            self._attend(index)
            agent.initialise(self._plan.ticks * self._plan.period_ns)
        self._attend(-1)

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
        updates = self._mailboxes.accept(self._mail_of_others(mail, 1)) if self._by_themselves else None
        self._advance(tick, mail, updates, 0)

    def advance_several(self, tick: int, n_ticks: int, mail: Mail, taken: Mapping[int, Floats] = NOTHING) -> Course:
        """From `tick` over `n_ticks` periods, or until a component fails; after that, nothing may be advanced.

        Args:
            tick: at which the agents are.
            n_ticks: how many periods.
            mail: the deliveries, tick by tick.
            taken: values from outside that are new at `tick`.
        """
        samples = np.empty((n_ticks, *self._places_of_samples.shape))
        rows = np.empty((n_ticks, len(self._places_of_row)))
        done, error = 0, None
        try:
            if self._native is not None and not self._by_themselves and not taken:
                done, failed = self._native.advance(tick, n_ticks, mail, samples, rows)
                self._raise(failed)
            else:
                for agent in self._fed if taken else ():
                    agent.take(tick, taken)
                updates = self._mailboxes.accept(self._mail_of_others(mail, n_ticks))
                for done in range(n_ticks):
                    self._advance(tick + done, mail, updates, done)
                    samples[done], rows[done] = self.samples(), self.row()
                done = n_ticks
        except RunError as failure:
            error = failure
        self._attend(-1)
        return Course(samples[:done], rows[:done], error)

    def _advance(self, tick: int, mail: Mail, updates: Updates | None, nth: int) -> None:
        """From `tick` to the next one, of whose mail and updates it is the part number `nth`."""
        failed = None
        if self._native is not None:
            n = len(self._agents)
            _, failed = self._native.advance(tick, 1, mail.of(range(nth * n, nth * n + n)) if nth else mail)
        if updates is not None:
            self._attended[TICK] = tick
            first = nth * len(self._by_themselves)
            for place, index in enumerate(self._by_themselves, first):
                if failed and failed.index < index:
                    break
                self._attend(index)
                self._agents[index].advance(tick, updates, place)
        self._attend(-1)
        self._raise(failed)

    def _attend(self, index: int) -> None:
        self._attended[AGENT:] = index, -1

    def _raise(self, failed: Failed | None) -> None:
        if failed:
            raise self._agents[failed.index].failure(failed.error) from failed.error

    def _mail_of_others(self, mail: Mail, n_ticks: int) -> Mail:
        """That of agents which are not native, tick by tick."""
        if self._native is None:
            return mail
        n = len(self._agents)
        return mail.of([tick * n + agent for tick in range(n_ticks) for agent in self._by_themselves])

    def failure(self, spot: Spot, text: str) -> RunError:
        """For a component that cannot raise anything itself; for all of the agent's if it is not known which."""
        agent = self._agents[spot.agent or 0]
        log = None if spot.component is None else agent.components[spot.component].last_log
        return agent.failure(ComponentError(spot.names(agent.plan), text, log))

    def accounts(self) -> list[StepAccount]:
        """What became of the steps of those agents whose steps are controlled."""
        return [account for agent in self._agents if (account := agent.account()) is not None]

    def terminate(self) -> None:
        """End all components; safe after a failure, and twice."""
        if self._native:
            self._native.end()
        for index, agent in enumerate(self._agents):
            self._attend(index)
            agent.terminate()
        self._attend(-1)

    def _native_block(self, members: list[int]) -> NativeBlock | None:
        if not members:
            return None
        from cosim.kernel import Member, NativeBlock

        found = [self._agents[i] for i in members]
        native = [Member(i, a.wiring, a.components, a.plan.coupling) for i, a in zip(members, found, strict=True)]
        places = self._places_of_samples, self._places_of_row
        return NativeBlock(native, self._memory, self._plan.period_ns, *places, self._attended)

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
