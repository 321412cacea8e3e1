"""The emulator: the samples of a tick in, the deliveries that become due out. Pure: no clock, no state but its own.

All messages leave at ticks, so whatever arrives in [kT, (k+1)T) is known once the samples of tick k are in. What
arrives at (k+1)T exactly belongs to tick k+1. `network.routing` says what arrives when, for a block of ticks at once;
the numbers that the messages carry are looked up at the tick at which they arrive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from network.channel import ChannelModel
from network.messages import Exchange, Fates, Floats, Ints, Links, Mail, MessageLayout, Stretch
from network.routing import Router


class EmulatorError(RuntimeError):
    """The emulator was called out of turn: a defect of the caller, never of a scenario."""


class _Samples:
    """The samples of recent ticks: a ring of rows (n_agents, width) that grows to hold every tick still needed."""

    def __init__(self, n_agents: int, width: int) -> None:
        self._ring = np.zeros((8, n_agents, width))
        self.oldest = 0
        self.next = 0

    @property
    def capacity(self) -> int:
        """How many ticks the ring holds, a power of two."""
        return len(self._ring)

    def append(self, values: Floats) -> None:
        self.place(self.next, slice(None), values[None])
        self.next += 1

    def place(self, first: int, agents: slice | Sequence[int], values: Floats) -> None:
        """(n_ticks, …, width) of some agents for ticks from `first` on, which need not be whole afterwards."""
        stop = first + len(values)
        while stop - self.oldest > len(self._ring):
            self._grow()
        at, mask = first, len(self._ring) - 1
        while at < stop:  # twice where it goes over the end of the ring
            row = at & mask
            n = min(stop - at, len(self._ring) - row)
            self._ring[row : row + n, agents] = values[at - first : at - first + n]
            at += n

    def _grow(self) -> None:
        """To twice the size; whatever is in the ring stays, whole or not."""
        capacity = len(self._ring)
        kept = np.arange(self.oldest, self.oldest + capacity)
        grown = np.zeros((2 * capacity, *self._ring.shape[1:]))
        grown[kept % (2 * capacity)] = self._ring[kept % capacity]
        self._ring = grown

    def rows(self, stamp: Ints, sender: Ints) -> Ints:
        """(n,) which row of the ring has what each sender publishes at each stamp; void once the ring has grown."""
        capacity, n_agents, _ = self._ring.shape
        return (stamp & (capacity - 1)) * n_agents + sender

    def take(self, rows: Ints) -> Floats:
        """(n, width) what some rows of the ring say."""
        values: Floats = self._ring.reshape(math.prod(self._ring.shape[:2]), self._ring.shape[2]).take(rows, axis=0)
        return values


class Emulator:
    """Applies every edge's channel to the samples that agents publish.

    Per tick, in order from 0: `emulate`, or `publish` and then `exchange`; `exchange_several` is for several ticks at
    once, and for mail that goes to several places. After the last one: `finish`.
    Where `slack` is s > 0, `exchange` of tick k needs only the samples up to tick k - s: those of the last s ticks may
    still be on their way.

    Args:
        links: the edges.
        channels: profiles by name.
        link_channel: (n_links,) name of each edge's profile.
        layout: of a message.
        seed: of the run.
        period_ns: T.
        groups: of agents whose mail goes together, each in ascending order; all agents are one group by default.
    """

    def __init__(  # noqa: PLR0917
        self,
        links: Links,
        channels: Mapping[str, ChannelModel],
        link_channel: Sequence[str],
        layout: MessageLayout,
        seed: int,
        period_ns: int,
        groups: Sequence[Sequence[int]] | None = None,
    ) -> None:
        self._router = Router(links, channels, link_channel, 8 * layout.width, seed, period_ns, groups)
        self.slack = self._router.slack
        """By how many ticks samples may lag behind the exchange."""
        self._samples = _Samples(len(links.agents), layout.width)
        self._next_block()
        self._tick = 0
        self._finished = False

    def emulate(self, tick: int, values: Floats) -> Exchange:
        """What becomes visible in [kT, (k+1)T), k being `tick`.

        Args:
            tick: the one after the previous call's, 0 at first.
            values: (n_agents, width) every agent's message; copied. Rows of agents that nobody hears are not read.

        Raises:
            EmulatorError: not the tick's turn.
        """
        self.publish(tick, values)
        return self.exchange(tick)

    def publish(self, tick: int, values: Floats) -> None:
        """Take the samples of a tick, (n_agents, width).

        Raises:
            EmulatorError: not the tick's turn.
        """
        if tick != self._samples.next or self._finished:
            raise EmulatorError(f"samples of tick {tick} came out of turn: {self._expects(self._samples.next)}")
        self._samples.append(values)

    def place(self, first: int, agents: slice | Sequence[int], values: Floats) -> None:
        """Samples of some agents that come by themselves, before `publish_placed` tells that all are there.

        Args:
            first: tick of the first ones, not published yet.
            agents: whose they are.
            values: (n_ticks, n, width); copied.
        """
        if first < self._samples.next or self._finished:
            raise EmulatorError(f"samples of tick {first} came out of turn: {self._expects(self._samples.next)}")
        self._samples.place(first, agents, values)

    def publish_placed(self, stop: int) -> None:
        """The samples of all agents are in place for the ticks before `stop`."""
        self._samples.next = max(self._samples.next, stop)

    @property
    def published(self) -> int:
        """Ticks whose samples are in."""
        return self._samples.next

    def exchange(self, tick: int) -> Exchange:
        """The deliveries due in [kT, (k+1)T) and the fates that become known in it, k being `tick`; of one group.

        Raises:
            EmulatorError: not the tick's turn, or samples that it needs are missing.
        """
        begin, end = self._advance(tick, tick + 1)
        n = self._router.group_sizes[0]
        mail = self._mail(self._block.mail_ends[0][begin * n : end * n + 1])
        return Exchange(tick, mail, self._fates(*self._block.fate_ends[begin : end + 1]))

    def exchange_several(self, tick: int, stop: int) -> Stretch:
        """The same for the ticks from `tick` to before `stop`, or fewer of them: at least one.

        Raises:
            EmulatorError: not the tick's turn, or samples that it needs are missing.
        """
        begin, end = self._advance(tick, stop)
        block, sizes = self._block, self._router.group_sizes
        mail = [self._mail(ends[begin * n : end * n + 1]) for ends, n in zip(block.mail_ends, sizes, strict=True)]
        ends = block.fate_ends[begin : end + 1]
        counts = [after - before for before, after in pairwise(ends)]
        return Stretch(tick, mail, self._fates(ends[0], ends[-1]), counts)

    def _advance(self, tick: int, stop: int) -> tuple[int, int]:
        """Count the ticks from `tick` to `stop`, or to the end of the block; the rows of the block that they are."""
        if tick != self._tick or self._finished:
            raise EmulatorError(f"tick {tick} was emulated out of turn: {self._expects(self._tick)}")
        if tick == self._block.stop:
            self._next_block()
        stop = min(stop, self._block.stop)
        if self._samples.next < stop - self.slack:
            missing = self._samples.next
            raise EmulatorError(
                f"tick {missing + self.slack} needs the samples of tick {missing}, which are not in yet"
            )
        self._tick = stop
        return tick - self._block.first, stop - self._block.first

    def finish(self) -> Fates:
        """The messages that are in flight when the run ends. Nothing can be emulated afterwards."""
        self._finished = True
        return self._router.in_flight(self._tick)

    def _expects(self, tick: int) -> str:
        return "the emulation is finished" if self._finished else f"tick {tick} is next"

    def _next_block(self) -> None:
        self._block = self._router.next_block()
        self._samples.oldest = self._router.oldest
        self._rows = self._samples.rows(self._block.stamp, self._block.sender)
        self._rows_for = self._samples.capacity

    def _mail(self, ends: Ints) -> Mail:
        block = self._block
        if self._rows_for != self._samples.capacity:
            self._rows = self._samples.rows(block.stamp, block.sender)
            self._rows_for = self._samples.capacity
        begin = int(ends[0])
        due = slice(begin, int(ends[-1]))
        values = self._samples.take(self._rows[due])
        values.flags.writeable = False
        return Mail(ends - begin, block.arrival_ns[due], block.slot[due], block.stamp[due], values)

    def _fates(self, begin: int, end: int) -> Fates:
        return self._block.fates.between(begin, end)
