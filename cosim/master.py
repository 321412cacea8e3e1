"""The master: advances the shared clock in steps of T. Pure: messages and exchanges in, instructions out.

Rule: nothing in here knows a clock, a socket, a thread or a process, nor who carries out its instructions. One period:
every agent publishes its sample of tick k; the emulator turns all samples into deliveries; every agent advances to
tick k + 1. The master refuses anything out of turn, so that a transport that loses, repeats or reorders is noticed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network.messages import Deliveries, Exchange, Floats


class SequenceError(RuntimeError):
    """Somebody spoke out of turn: a defect of whoever carries the messages, never of a scenario."""


@dataclass(frozen=True)
class Emulate:
    """To the emulator: all samples of a tick.

    Attributes:
        values: (n_agents, width) in the order of the file; rows of agents that nobody hears are zero.
    """

    tick: int
    values: Floats


@dataclass(frozen=True)
class Advance:
    """To one agent: advance from `tick` to the next with these deliveries."""

    tick: int
    agent: int
    deliveries: Deliveries


@dataclass(frozen=True)
class Finish:
    """To everybody: the last tick's samples are in, the run is over."""

    tick: int


class Master:
    """The call order is, per tick: `published` once per agent, then `exchanged`, and so on until `Finish` comes out.

    Args:
        n_agents: how many agents.
        width: numbers in a message.
        ticks: periods to advance; after the sample of tick number `ticks` the run is over.
    """

    def __init__(self, n_agents: int, width: int, ticks: int) -> None:
        self._ticks = ticks
        self._values = np.zeros((n_agents, width))
        self._missing = set(range(n_agents))
        self._awaiting_exchange = False
        self.tick = 0

    @property
    def waiting_for(self) -> frozenset[int]:
        """Agents whose sample of the current tick is not in yet."""
        return frozenset(self._missing)

    def published(self, agent: int, tick: int, message: Floats) -> Emulate | Finish | None:
        """An agent's sample is in; an instruction once all are.

        Raises:
            SequenceError: not this agent's turn, or a message of another tick or size.
        """
        if tick != self.tick or agent not in self._missing:
            raise SequenceError(f"agent {agent} published for tick {tick} out of turn (the clock is at {self.tick})")
        if message.size not in (0, self._values.shape[1]):
            raise SequenceError(f"agent {agent} published {message.size} numbers, not {self._values.shape[1]}")
        if message.size:
            self._values[agent] = message
        self._missing.discard(agent)
        if self._missing:
            return None
        if tick == self._ticks:
            return Finish(tick)
        self._awaiting_exchange = True
        return Emulate(tick, self._values.copy())

    def exchanged(self, exchange: Exchange) -> list[Advance]:
        """The emulator's answer is in: open the next tick.

        Raises:
            SequenceError: no answer, or that of another tick, was awaited.
        """
        if not self._awaiting_exchange or exchange.tick != self.tick:
            raise SequenceError(f"an exchange of tick {exchange.tick} came out of turn (the clock is at {self.tick})")
        self._awaiting_exchange = False
        self._missing = set(range(len(self._values)))
        self.tick += 1
        return [Advance(exchange.tick, agent, deliveries) for agent, deliveries in enumerate(exchange.deliveries)]
