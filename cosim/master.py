"""The master: advances the shared clock in steps of T. Pure: messages and exchanges in, instructions out.

Rule: nothing in here knows a clock, a socket, a thread or a process, nor who carries out its instructions. One period:
every agent publishes its sample of tick k; the emulator turns all samples into deliveries; every agent advances to
tick k + 1. The master refuses anything out of turn, so that a transport that loses, repeats or reorders is noticed.
Whoever carries a block of agents speaks for all of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from network.messages import Exchange, Floats, Mail


class SequenceError(RuntimeError):
    """Somebody spoke out of turn: a defect of whoever carries the messages, never of a scenario."""


@dataclass(frozen=True)
class Emulate:
    """To the emulator: all samples of a tick.

    Attributes:
        values: (n_agents, width) in the order of the file.
    """

    tick: int
    values: Floats


@dataclass(frozen=True)
class Advance:
    """To everybody: advance from `tick` to the next with this mail."""

    tick: int
    mail: Mail


@dataclass(frozen=True)
class Finish:
    """To everybody: the last tick's samples are in, the run is over."""

    tick: int


class Master:
    """The call order is, per tick: `published` once per block, then `exchanged`, and so on until `Finish` comes out.

    Args:
        blocks: of how many agents each block consists; they follow each other in the order of the file.
        width: numbers in a message.
        ticks: periods to advance; after the sample of tick number `ticks` the run is over.
    """

    def __init__(self, blocks: Sequence[int], width: int, ticks: int) -> None:
        self._ticks = ticks
        ends = list(itertools.accumulate(blocks, initial=0))
        self._values = np.zeros((ends[-1], width))
        self._blocks = [self._values[i:j] for i, j in itertools.pairwise(ends)]
        self._missing = set(range(len(blocks)))
        self._awaiting_exchange = False
        self.tick = 0

    def published(self, block: int, tick: int, values: Floats) -> Emulate | Finish | None:
        """The samples of a block are in, one row per agent; an instruction once all are.

        Raises:
            SequenceError: not this block's turn, or samples of another tick or shape.
        """
        if tick != self.tick or block not in self._missing:
            raise SequenceError(f"block {block} published for tick {tick} out of turn (the clock is at {self.tick})")
        if values.shape != self._blocks[block].shape:
            raise SequenceError(f"block {block} published {values.shape} numbers, not {self._blocks[block].shape}")
        self._blocks[block][...] = values
        self._missing.discard(block)
        if self._missing:
            return None
        if tick == self._ticks:
            return Finish(tick)
        self._awaiting_exchange = True
        return Emulate(tick, self._values.copy())

    def exchanged(self, exchange: Exchange) -> Advance:
        """The emulator's answer is in: open the next tick.

        Raises:
            SequenceError: no answer, or that of another tick, was awaited.
        """
        if not self._awaiting_exchange or exchange.tick != self.tick:
            raise SequenceError(f"an exchange of tick {exchange.tick} came out of turn (the clock is at {self.tick})")
        self._awaiting_exchange = False
        self._missing = set(range(len(self._blocks)))
        self.tick += 1
        return Advance(exchange.tick, exchange.mail)
