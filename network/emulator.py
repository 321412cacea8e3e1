"""The emulator: the samples of a tick in, the deliveries that become due out. Pure: no clock, no state but its own.

All messages leave at ticks, so whatever arrives in [kT, (k+1)T) is known once the samples of tick k are in. What
arrives at (k+1)T exactly belongs to tick k+1.

When, and whether, a message arrives depends on the seed alone, never on what it says. So messages are routed (drawn,
put in order, judged by the freshest-stamp rule) for a block of ticks at once, which costs few calls of numpy per tick
however few the edges; the numbers that they carry are looked up at the tick at which they arrive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from network.channel import Channel, ChannelModel, Setting
from network.draws import Draws
from network.messages import NEVER, Exchange, Fate, Fates, Floats, Ints, Links, Mail, MessageLayout, Stretch

_MESSAGES_AT_ONCE = 2**14  # routed in one block, unless a single tick has more: beyond, caches overflow
_TICKS_AT_ONCE = 64

# Rows of a table of messages, one column per message.
_DUE, _ARRIVAL, _LINK, _STAMP, _COPY, _SENT = range(6)
_NO_MESSAGES: Ints = np.zeros((6, 0), np.int64)


class EmulatorError(RuntimeError):
    """The emulator was called out of turn: a defect of the caller, never of a scenario."""


def _sort_key(values: Ints) -> NDArray[Any]:
    """Values in the same order, in 16 bits where they fit: numpy sorts those by radix, several times as fast."""
    if not len(values):
        return values
    lowest = values.min()
    return (values - lowest).astype(np.uint16) if values.max() - lowest < 2**16 else values


@dataclass(frozen=True)
class _Block:
    """Routed ticks `first`, …, `stop - 1`.

    Attributes:
        table: (6, n) every message whose fate becomes known in the block, in the total order of each tick in turn.
        fate: (n,) their fates.
        ends: (stop - first + 1,) column of `table` at which each tick's messages begin, and the end.
        mail: (6, m) those that arrive, by group, tick and receiver, then in the total order.
        slot, sender: (m,) of those.
        mail_ends: of each group, column of `mail` at which the messages of each agent begin, tick by tick, and the end.
    """

    first: int
    stop: int
    table: Ints
    fate: Ints
    ends: list[int]
    mail: Ints
    slot: Ints
    sender: Ints
    mail_ends: Sequence[Ints]


class _Samples:
    """The samples of recent ticks: a ring of rows (n_agents, width) that grows to hold every tick still needed."""

    def __init__(self, n_agents: int, width: int) -> None:
        self._ring = np.zeros((8, n_agents, width))
        self.oldest = 0
        self.next = 0

    def append(self, values: Floats) -> None:
        capacity = len(self._ring)
        if self.next - self.oldest >= capacity:
            kept = np.arange(self.oldest, self.next)
            grown = np.zeros((2 * capacity, *self._ring.shape[1:]))
            grown[kept % (2 * capacity)] = self._ring[kept % capacity]
            self._ring = grown
        self._ring[self.next % len(self._ring)] = values
        self.next += 1

    def of(self, stamp: Ints, sender: Ints) -> Floats:
        """(n, width) what each sender published at each stamp."""
        capacity, n_agents, width = self._ring.shape
        values: Floats = self._ring.reshape(capacity * n_agents, width).take(
            stamp % capacity * n_agents + sender, axis=0
        )
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
        # Edges are renumbered by (receiver, sender), so that their number is their place in the total order.
        order = np.lexsort((links.sender, links.receiver))
        self._sender, self._receiver, self._slot = links.sender[order], links.receiver[order], links.slot[order]
        names = [link_channel[i] for i in order.tolist()]
        self._n_agents = len(links.agents)
        self._period_ns = period_ns
        self._groups = [len(group) for group in groups] if groups is not None else [self._n_agents]
        self._row, self._base, self._place = self._pigeonholes(groups)
        self._channels: list[tuple[Ints, Channel]] = []
        slack = []
        profiles, which = np.unique(np.array(names, np.str_), return_inverse=True)
        for index, profile in enumerate(profiles.tolist()):
            served = np.flatnonzero(which == index)
            model = channels[profile]
            self._channels.append((served, self._open(model, links.agents, served, seed, 8 * layout.width)))
            slack.append(model.min_delay_ns() // period_ns)
        self._history = max((channel.history for _, channel in self._channels), default=0)
        self.slack = min(slack, default=0)
        """By how many ticks samples may lag behind the exchange."""
        self._block_ticks = max(1, min(_TICKS_AT_ONCE, _MESSAGES_AT_ONCE // max(1, len(links) + self._n_agents)))
        self._samples = _Samples(self._n_agents, layout.width)
        self._freshest = np.full(len(links), NEVER, np.int64)
        self._pending = _NO_MESSAGES
        self._block = self._route(0)
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

    @property
    def published(self) -> int:
        """Ticks whose samples are in."""
        return self._samples.next

    def exchange(self, tick: int) -> Exchange:
        """The deliveries due in [kT, (k+1)T) and the fates that become known in it, k being `tick`; of one group.

        Raises:
            EmulatorError: not the tick's turn, or samples that it needs are missing.
        """
        stretch = self.exchange_several(tick, tick + 1)
        return Exchange(tick, stretch.mail[0], stretch.fates)

    def exchange_several(self, tick: int, stop: int) -> Stretch:
        """The same for the ticks from `tick` to before `stop`, or fewer of them: at least one.

        Raises:
            EmulatorError: not the tick's turn, or samples that it needs are missing.
        """
        if tick != self._tick or self._finished:
            raise EmulatorError(f"tick {tick} was emulated out of turn: {self._expects(self._tick)}")
        if tick == self._block.stop:
            self._block = self._route(tick)
        block = self._block
        stop = min(stop, block.stop)
        if self._samples.next < stop - self.slack:
            missing = self._samples.next
            raise EmulatorError(
                f"tick {missing + self.slack} needs the samples of tick {missing}, which are not in yet"
            )
        self._tick = stop
        begin, end = tick - block.first, stop - block.first
        mail = [
            self._mail(ends[begin * n : end * n + 1]) for ends, n in zip(block.mail_ends, self._groups, strict=True)
        ]
        ends = block.ends[begin : end + 1]
        counts = [after - before for before, after in pairwise(ends)]
        return Stretch(tick, mail, self._fates(ends[0], ends[-1]), counts)

    def finish(self) -> Fates:
        """The messages that are in flight when the run ends. Nothing can be emulated afterwards."""
        self._finished = True
        done = self._block.ends[self._tick - self._block.first]
        rest = np.concatenate((self._block.table[:, done:], self._pending), axis=1)
        rest = rest[:, rest[_SENT] < self._tick]  # the block may have gone ahead
        rest = rest[:, np.lexsort((rest[_COPY], rest[_STAMP], rest[_LINK], rest[_ARRIVAL]))]
        return self._as_fates(rest, np.full(rest.shape[1], Fate.IN_FLIGHT, np.int64))

    def _expects(self, tick: int) -> str:
        return "the emulation is finished" if self._finished else f"tick {tick} is next"

    def _open(self, model: ChannelModel, agents: tuple[str, ...], served: Ints, seed: int, size: int) -> Channel:
        links = Links(agents, self._sender[served], self._receiver[served], self._slot[served])
        senders, receivers = ([agents[i] for i in ends.tolist()] for ends in (links.sender, links.receiver))
        return model.open(Setting(links, self._period_ns, Draws(seed, senders, receivers), size))

    # --- routing: a block of ticks at once ---------------------------------------------------------------------------
    def _route(self, first: int) -> _Block:
        """Draw what is sent in the block that begins at `first`; order and judge all that becomes due in it."""
        stop = first + self._block_ticks
        sent = [self._transmit(served, channel, range(first, stop)) for served, channel in self._channels]
        table = np.concatenate((self._pending, *sent), axis=1)
        self._samples.oldest = max(0, min(first - self._history, int(table[_STAMP].min(initial=first))))
        is_due = table[_DUE] < stop
        self._pending = table[:, ~is_due]
        table = table[:, is_due]
        keys = (table[_COPY], table[_STAMP], table[_LINK], table[_ARRIVAL], table[_DUE])
        table = table.take(np.lexsort([_sort_key(key) for key in keys]), axis=1)
        fate = self._judge(table)
        ends = np.searchsorted(table[_DUE], np.arange(first, stop + 1))
        mail, mail_ends = self._sort_mail(table.compress(fate != Fate.LOST, axis=1), first, stop)
        slot, sender = self._slot[mail[_LINK]], self._sender[mail[_LINK]]
        for array in (table, fate, mail, slot):
            array.flags.writeable = False
        return _Block(first, stop, table, fate, ends.tolist(), mail, slot, sender, mail_ends)

    def _transmit(self, served: Ints, channel: Channel, ticks: range) -> Ints:
        """The table of what leaves through one channel."""
        sent = [channel.transmit(tick) for tick in ticks]
        delay = np.concatenate([transmission.delay_ns for transmission in sent])
        table = np.empty((6, len(delay)), np.int64)
        table[_LINK] = served[np.concatenate([transmission.link for transmission in sent])]
        table[_STAMP] = np.concatenate([transmission.stamp for transmission in sent])
        table[_COPY] = np.concatenate([transmission.copy for transmission in sent])
        table[_SENT] = np.repeat(np.asarray(ticks), [len(transmission.link) for transmission in sent])
        table[_ARRIVAL] = np.where(delay == NEVER, NEVER, table[_SENT] * self._period_ns + delay)
        table[_DUE] = np.where(delay == NEVER, table[_SENT], table[_ARRIVAL] // self._period_ns)
        return table

    def _judge(self, table: Ints) -> Ints:
        """(n,) fates of messages that are in the total order; remembers the freshest stamp of every edge."""
        fate = np.full(table.shape[1], Fate.LOST, np.int64)
        arrived = np.flatnonzero(table[_ARRIVAL] != NEVER)
        if not len(arrived):
            return fate
        arrived = arrived[np.argsort(_sort_key(table[_LINK, arrived]), kind="stable")]
        link, stamp = table[_LINK, arrived], table[_STAMP, arrived]
        # One running maximum serves all edges: an edge's keys exceed those of the edges before it.
        span = int(stamp.max()) + 1
        key, at_first = link * span + stamp, link * span + self._freshest[link]
        before = at_first.copy()
        np.maximum(at_first[1:], np.maximum.accumulate(key)[:-1], out=before[1:])
        fresh = key > before
        fate[arrived] = np.where(fresh, Fate.DELIVERED, Fate.SUPERSEDED)
        self._freshest[link[fresh]] = stamp[fresh]  # stamps that are fresh increase, and the last assignment holds
        return fate

    def _pigeonholes(self, groups: Sequence[Sequence[int]] | None) -> tuple[Ints, Ints, Ints]:
        """Of every agent: how many there are in its group, and in the groups before; its place in its own."""
        agents = np.arange(self._n_agents)
        if groups is None:
            return np.full_like(agents, self._n_agents), np.zeros_like(agents), agents
        row, base, place = np.empty_like(agents), np.empty_like(agents), np.empty_like(agents)
        for group, before in zip(groups, accumulate(self._groups, initial=0), strict=False):
            members = np.asarray(group, np.intp)
            row[members], base[members], place[members] = len(members), before, np.arange(len(members))
        return row, base, place

    def _sort_mail(self, arrivals: Ints, first: int, stop: int) -> tuple[Ints, list[Ints]]:
        """Arrivals by (group, tick, receiver), keeping the total order within, and where each agent's begin."""
        ticks, receiver = stop - first, self._receiver[arrivals[_LINK]]
        box = self._base[receiver] * ticks + (arrivals[_DUE] - first) * self._row[receiver] + self._place[receiver]
        order = np.argsort(_sort_key(box), kind="stable")
        begins = np.searchsorted(box[order], np.arange(ticks * self._n_agents + 1))
        bounds = accumulate((ticks * n for n in self._groups), initial=0)
        return np.take(arrivals, order, axis=1), [begins[i : j + 1] for i, j in pairwise(bounds)]

    # --- answers: ticks of the block ---------------------------------------------------------------------------------
    def _mail(self, ends: Ints) -> Mail:
        block, due = self._block, slice(ends[0], ends[-1])
        stamp = block.mail[_STAMP, due]
        values = self._samples.of(stamp, block.sender[due])
        values.flags.writeable = False
        return Mail(ends - ends[0], block.mail[_ARRIVAL, due], block.slot[due], stamp, values)

    def _fates(self, begin: int, end: int) -> Fates:
        return self._as_fates(self._block.table[:, begin:end], self._block.fate[begin:end])

    def _as_fates(self, table: Ints, fate: Ints) -> Fates:
        link = table[_LINK]
        return Fates(self._sender[link], self._receiver[link], table[_STAMP], table[_SENT], table[_ARRIVAL], fate)
