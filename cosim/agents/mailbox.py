"""Mailboxes: of every in-neighbour, the message with the freshest stamp that has arrived (eq. k_t)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from network.messages import NEVER, Floats, Ints, Mail
from network.units import NANOSECONDS_PER_SECOND


@dataclass(frozen=True)
class Updates:
    """Deliveries that change the mailboxes of agents, agent by agent, in the order of arrival.

    Attributes:
        ends: n_agents + 1 numbers: where those of each agent begin, and the end.
        arrival_ns: n numbers, not decreasing within an agent.
        slot: n rows of mailboxes.
        content: (n, width + 2): the values, the tick at which the sample was taken, and the same in seconds.
    """

    ends: Sequence[int]
    arrival_ns: Sequence[int]
    slot: Sequence[int]
    content: Floats


class Mailboxes:
    """Those of several agents; an older stamp that arrives later changes nothing.

    Args:
        n_neighbours: of each agent.
        period_ns: T.
    """

    def __init__(self, n_neighbours: Sequence[int], period_ns: int) -> None:
        self._period_ns = period_ns
        self._first = np.cumsum([0, *n_neighbours])
        self.stamps: Ints = np.full(self._first[-1], NEVER, np.int64)
        """Agent by agent, the freshest stamp of each in-neighbour."""

    def accept(self, mail: Mail) -> Updates:
        """The deliveries, in their order, that are fresher than what is there.

        Args:
            mail: of all agents, possibly for several ticks in turn; then the updates are tick by tick as well.
        """
        n_agents = len(self._first) - 1
        n_ticks = len(mail) // n_agents if n_agents else 0
        box = np.tile(self._first[:-1], n_ticks).repeat(np.diff(mail.ends)) + mail.slot
        fresh = self._judge(box, mail.stamp)
        self.stamps[box[fresh]] = mail.stamp[fresh]  # they increase, and the last assignment holds
        ends, arrival, slot, stamp, values = mail.ends, mail.arrival_ns, mail.slot, mail.stamp, mail.values
        if not fresh.all():
            ends = np.concatenate(([0], np.cumsum(fresh)))[ends]
            arrival, slot, stamp, values = arrival[fresh], slot[fresh], stamp[fresh], values[fresh]
        time = stamp * self._period_ns / NANOSECONDS_PER_SECOND
        return Updates(ends.tolist(), arrival.tolist(), slot.tolist(), np.column_stack((values, stamp, time)))

    def _judge(self, box: Ints, stamp: Ints) -> NDArray[np.bool_]:
        """Whether each message is fresher than all before it in the same box."""
        known = self.stamps[box]
        fresh = stamp > known
        place = np.arange(len(box))
        last = np.empty(len(self.stamps), np.int64)
        last[box] = place
        if np.array_equal(last[box], place):  # one message per box
            return fresh
        order = np.argsort(box, kind="stable")
        span = int(stamp.max()) + 2  # one running maximum serves all boxes: the keys of a box exceed those before it
        key, before = box[order] * span + stamp[order], box[order] * span + known[order]
        np.maximum(before[1:], np.maximum.accumulate(key)[:-1], out=before[1:])
        fresh[order] = key > before
        return fresh
