"""Routing: what every channel does to the messages of a block of ticks, put in order and judged. Pure.

When, and whether, a message arrives depends on the seed alone, never on what it says. So a block of ticks is drawn, put
in order, and judged by the freshest-stamp rule at once, which costs few calls of numpy per tick however few the edges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from network.channel import Channel, ChannelModel, Setting
from network.draws import Draws
from network.messages import NEVER, Fate, Fates, Ints, Links

_MESSAGES_AT_ONCE = 2**14  # routed in one block, unless a single tick has more: beyond, caches overflow
_TICKS_AT_ONCE = 64

# Rows of a table of messages, one column per message.
_DUE, _ARRIVAL, _LINK, _STAMP, _COPY, _SENT = range(6)


@dataclass(frozen=True)
class Routed:
    """The messages of ticks `first`, …, `stop - 1`.

    Attributes:
        first, stop: the ticks.
        fates: of every message whose fate becomes known in these ticks, in the total order of each tick in turn.
        fate_ends: (stop - first + 1) where each tick's fates begin, and the end.
        arrival_ns, stamp, slot, sender: (m,) the messages that arrive, by group, tick and receiver, then in the total
            order.
        mail_ends: of each group, where the arrivals of each of its agents begin, tick by tick, and the end.
    """

    first: int
    stop: int
    fates: Fates
    fate_ends: list[int]
    arrival_ns: Ints
    stamp: Ints
    slot: Ints
    sender: Ints
    mail_ends: list[Ints]


class Router:
    """Applies every edge's channel, one block of ticks after the other.

    Args:
        links: the edges.
        channels: profiles by name.
        link_channel: (n_links,) name of each edge's profile.
        message_bytes: length of a message.
        seed: of the run.
        period_ns: T.
        groups: of agents whose mail goes together, each in ascending order; all agents are one group by default.
    """

    def __init__(  # noqa: PLR0917
        self,
        links: Links,
        channels: Mapping[str, ChannelModel],
        link_channel: Sequence[str],
        message_bytes: int,
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
        self.group_sizes = [len(group) for group in groups] if groups is not None else [self._n_agents]
        self._row, self._base, self._place = self._pigeonholes(groups)
        self._channels: list[tuple[Ints, Channel]] = []
        slack = []
        profiles, which = np.unique(np.array(names, np.str_), return_inverse=True)
        for index, profile in enumerate(profiles.tolist()):
            served = np.flatnonzero(which == index)
            model = channels[profile]
            self._channels.append((served, self._open(model, links.agents, served, seed, message_bytes)))
            slack.append(model.min_delay_ns() // period_ns)
        self.slack = min(slack, default=0)
        """By how many ticks samples may lag behind what arrives."""
        self._history = max((channel.history for _, channel in self._channels), default=0)
        self._block_ticks = max(1, min(_TICKS_AT_ONCE, _MESSAGES_AT_ONCE // max(1, len(links) + self._n_agents)))
        self._freshest = np.full(len(links), NEVER, np.int64)
        self._pending: Ints = np.zeros((6, 0), np.int64)
        self._settled = self._pending
        self._first = 0
        self.oldest = 0
        """The first tick whose samples may still arrive, in the latest block or later."""

    def _open(self, model: ChannelModel, agents: tuple[str, ...], served: Ints, seed: int, size: int) -> Channel:
        links = Links(agents, self._sender[served], self._receiver[served], self._slot[served])
        senders, receivers = ([agents[i] for i in ends.tolist()] for ends in (links.sender, links.receiver))
        return model.open(Setting(links, self._period_ns, Draws(seed, senders, receivers), size))

    def next_block(self) -> Routed:
        """Draw what is sent in the next ticks; order and judge all that becomes due in them."""
        first, stop = self._first, self._first + self._block_ticks
        self._first = stop
        sent = [self._transmit(served, channel, range(first, stop)) for served, channel in self._channels]
        table = np.concatenate((self._pending, *sent), axis=1)
        self.oldest = max(0, min(first - self._history, int(table[_STAMP].min(initial=first))))
        is_due = table[_DUE] < stop
        self._pending = table.compress(~is_due, axis=1)
        if self._pending.shape[1]:
            table = table.compress(is_due, axis=1)
        self._settled = table = self._in_order(table, first)
        fate = self._judge(table)
        lost = fate == Fate.LOST
        mail, mail_ends = self._sort_mail(table.compress(~lost, axis=1) if lost.any() else table, first, stop)
        slot, sender = self._slot[mail[_LINK]], self._sender[mail[_LINK]]
        for array in (table, fate, mail, slot):
            array.flags.writeable = False
        return Routed(
            first,
            stop,
            self._as_fates(table, fate),
            np.searchsorted(table[_DUE], np.arange(first, stop + 1)).tolist(),
            mail[_ARRIVAL],
            mail[_STAMP],
            slot,
            sender,
            mail_ends,
        )

    def in_flight(self, tick: int) -> Fates:
        """What left before `tick`, which is in the latest block or its end, and arrives then or later."""
        rest = np.concatenate((self._settled[:, self._settled[_DUE] >= tick], self._pending), axis=1)
        rest = rest[:, rest[_SENT] < tick]  # the block may have gone ahead
        rest = rest[:, np.lexsort((rest[_COPY], rest[_STAMP], rest[_LINK], rest[_ARRIVAL]))]
        return self._as_fates(rest, np.full(rest.shape[1], Fate.IN_FLIGHT, np.int64))

    def _as_fates(self, table: Ints, fate: Ints) -> Fates:
        link = table[_LINK]
        return Fates(self._sender[link], self._receiver[link], table[_STAMP], table[_SENT], table[_ARRIVAL], fate)

    def _transmit(self, served: Ints, channel: Channel, ticks: range) -> Ints:
        """The table of what leaves through one channel."""
        batch = channel.transmit_many(ticks)
        table = np.empty((6, len(batch.link)), np.int64)
        table[_LINK] = served[batch.link]
        table[_STAMP] = batch.stamp
        table[_COPY] = batch.copy
        table[_SENT] = batch.sent
        np.multiply(batch.sent, self._period_ns, out=table[_ARRIVAL])
        table[_ARRIVAL] += batch.delay_ns
        np.floor_divide(table[_ARRIVAL], self._period_ns, out=table[_DUE])
        lost = np.flatnonzero(batch.delay_ns == NEVER)
        table[_ARRIVAL, lost] = NEVER
        table[_DUE, lost] = batch.sent[lost]
        return table

    def _in_order(self, table: Ints, first: int) -> Ints:
        """A table in the total order of each tick in turn, losses first."""
        if not table.shape[1]:
            return table
        link, stamp, copy = table[_LINK], table[_STAMP], table[_COPY]
        since = 2 * (table[_ARRIVAL] - first * self._period_ns) + 1
        lost = np.flatnonzero(table[_ARRIVAL] == NEVER)
        since[lost] = 2 * (table[_SENT, lost] - first) * self._period_ns
        oldest = stamp.min()
        spans = len(self._sender), int(stamp.max() - oldest) + 1, int(copy.max()) + 1
        if int(since.max() + 1) * math.prod(spans) < 2**63:
            # One number says it all: it is sorted several times as fast as four, and mostly is in order already.
            key = ((since * spans[0] + link) * spans[1] + (stamp - oldest)) * spans[2] + copy
            if _rises(key):
                return table
            order = np.argsort(key)
            if _rises(key[order]):
                return table.take(order, axis=1)
        # Equals, where a channel sends one sample twice and calls both the same copy, are in the order of sending.
        return table.take(np.lexsort((table[_SENT], copy, stamp, link, since)), axis=1)

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
        for group, before in zip(groups, accumulate(self.group_sizes, initial=0), strict=False):
            members = np.asarray(group, np.intp)
            row[members], base[members], place[members] = len(members), before, np.arange(len(members))
        return row, base, place

    def _sort_mail(self, arrivals: Ints, first: int, stop: int) -> tuple[Ints, list[Ints]]:
        """Arrivals by (group, tick, receiver), keeping the total order within, and where each agent's begin."""
        ticks, receiver = stop - first, self._receiver[arrivals[_LINK]]
        box = self._base[receiver] * ticks + (arrivals[_DUE] - first) * self._row[receiver] + self._place[receiver]
        begins = np.concatenate(([0], np.cumsum(np.bincount(box, minlength=ticks * self._n_agents))))
        if (box[1:] < box[:-1]).any():
            arrivals = arrivals.take(np.argsort(_sort_key(box), kind="stable"), axis=1)
        bounds = accumulate((ticks * n for n in self.group_sizes), initial=0)
        return arrivals, [begins[i : j + 1] for i, j in pairwise(bounds)]


def _sort_key(values: Ints) -> NDArray[Any]:
    """Values in the same order, in 16 bits where they fit: numpy sorts those by radix, several times as fast."""
    if not len(values):
        return values
    lowest = values.min()
    return (values - lowest).astype(np.uint16) if values.max() - lowest < 2**16 else values


def _rises(values: Ints) -> bool:
    """Whether each value is greater than the one before."""
    return bool((values[1:] > values[:-1]).all())
