"""What travels: the samples that agents publish at a tick, and the deliveries that reach them.

Everything is a struct of arrays, so that a tick costs the same few calls for ten agents as for ten thousand.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NEVER = -1
"""Stamp of a neighbour that has not been heard yet; arrival of a message that never comes."""


@dataclass(frozen=True)
class MessageLayout:
    """The published variables of a message, the same for the whole network: names and how many numbers each holds."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]

    @cached_property
    def width(self) -> int:
        """Numbers in one message."""
        return sum(self.sizes)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each variable lies in a message of `width` numbers."""
        ends = np.cumsum((0, *self.sizes)).tolist()
        return {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(self.names)}


@dataclass(frozen=True)
class Links:
    """The directed edges of the network, in the plan's order (by receiver, then by the receiver's in-neighbours).

    Attributes:
        agents: names of all agents, in the order of the file.
        sender, receiver: (n_links,) indices into `agents`.
        slot: (n_links,) which in-neighbour of its receiver the sender is, from 0.
    """

    agents: tuple[str, ...]
    sender: Ints
    receiver: Ints
    slot: Ints

    def __len__(self) -> int:
        return len(self.sender)


class Fate(IntEnum):
    """What became of a message. The names, in lower case, are the `fate` column of `deliveries.parquet`."""

    DELIVERED = 0  # it was the freshest of its sender when it arrived
    SUPERSEDED = 1  # it arrived, but a message with a newer stamp, or a copy of itself, had arrived before
    LOST = 2
    IN_FLIGHT = 3  # the run ended before it arrived


@dataclass(frozen=True)
class Fates:
    """Messages whose fate became known in one tick, in the total order (arrival, receiver, sender, stamp, copy).

    A loss is known at the tick at which the message was sent, anything else when it arrives. As the arrival of a lost
    message is `NEVER`, the losses of a tick come first.

    Attributes:
        sender, receiver: (n,) indices of agents.
        stamp: (n,) tick at which the sample was taken.
        sent: (n,) tick at which it left.
        arrival_ns: (n,) `NEVER` where lost; still to come where in flight.
        fate: (n,) values of `Fate`.
    """

    sender: Ints
    receiver: Ints
    stamp: Ints
    sent: Ints
    arrival_ns: Ints
    fate: Ints

    def __len__(self) -> int:
        return len(self.sender)

    @property
    def columns(self) -> tuple[Ints, ...]:
        """All of them, in the order of the attributes."""
        return self.sender, self.receiver, self.stamp, self.sent, self.arrival_ns, self.fate

    def between(self, begin: int, end: int) -> Fates:
        """Some that follow each other; no copy."""
        return Fates(*(column[begin:end] for column in self.columns))

    @classmethod
    def joined(cls, pieces: Sequence[Fates]) -> Fates:
        """One after the other; one piece at least."""
        if len(pieces) == 1:
            return pieces[0]
        return cls(*map(np.concatenate, zip(*(piece.columns for piece in pieces), strict=True)))


@dataclass(frozen=True)
class Deliveries:
    """What reaches one agent during one tick, in the total order (arrival, sender, stamp, copy).

    Superseded messages are among them: it is the mailbox that keeps the freshest stamp. Arrays are read only.

    Attributes:
        arrival_ns: (n,) exact time of arrival, in [kT, (k+1)T).
        slot: (n,) in-neighbour of the receiver, from 0.
        stamp: (n,) tick at which the sample was taken.
        values: (n, width) the message.
    """

    arrival_ns: Ints
    slot: Ints
    stamp: Ints
    values: Floats

    def __len__(self) -> int:
        return len(self.stamp)


@dataclass(frozen=True)
class Mail:
    """What reaches a block of agents during one tick: the `Deliveries` of each, one after the other.

    Iterating gives them agent by agent, which costs an object per agent; native agents take the arrays as they are.
    The mail of several ticks that follow each other is that of each in turn, as if the block had so many times the
    agents.

    Attributes:
        ends: (n_agents + 1,) where each agent's deliveries begin, and the end.
        arrival_ns, slot, stamp, values: (n,), those of `Deliveries`; contiguous.
    """

    ends: Ints
    arrival_ns: Ints
    slot: Ints
    stamp: Ints
    values: Floats

    def __len__(self) -> int:
        """How many agents."""
        return len(self.ends) - 1

    def __getitem__(self, agent: int) -> Deliveries:
        return self._between(self.ends[agent], self.ends[agent + 1])

    def __iter__(self) -> Iterator[Deliveries]:
        nothing = self._between(0, 0)
        return (self._between(i, j) if i < j else nothing for i, j in pairwise(self.ends.tolist()))

    def of(self, agents: Sequence[int]) -> Mail:
        """That of some agents, in their order; a range that counts up by one costs no copy."""
        which: slice | Ints
        if isinstance(agents, range):
            ends = self.ends[agents.start : agents.stop + 1]
            which, ends = slice(ends[0], ends[-1]), ends - ends[0]
        else:
            chosen = np.asarray(agents, np.intp)
            begins, counts = self.ends[chosen], np.diff(self.ends)[chosen]
            ends = np.concatenate(([0], np.cumsum(counts)))
            which = (begins - ends[:-1]).repeat(counts) + np.arange(ends[-1])
        return Mail(ends, self.arrival_ns[which], self.slot[which], self.stamp[which], self.values[which])

    def _between(self, i: int, j: int) -> Deliveries:
        return Deliveries(self.arrival_ns[i:j], self.slot[i:j], self.stamp[i:j], self.values[i:j])


@dataclass(frozen=True)
class Exchange:
    """The emulator's answer to a tick: the mail of all agents, in the order of the file, and the fates decided."""

    tick: int
    mail: Mail
    fates: Fates


@dataclass(frozen=True)
class Stretch:
    """The emulator's answers to ticks that follow each other, for several groups of agents.

    Attributes:
        first: the first of the ticks.
        mail: of each group, tick by tick.
        fates: of all ticks, one after the other.
        fate_counts: of each tick, how many those are.
    """

    first: int
    mail: Sequence[Mail]
    fates: Fates
    fate_counts: Sequence[int]

    @property
    def n_ticks(self) -> int:
        """How many ticks."""
        return len(self.fate_counts)
