"""The mailbox of an agent: of every in-neighbour, the message with the freshest stamp that has arrived (eq. k_t)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network.messages import NEVER, Deliveries, Floats, Ints
from network.units import NANOSECONDS_PER_SECOND


@dataclass(frozen=True)
class Updates:
    """Deliveries that change the mailbox, in the order of arrival.

    Attributes:
        arrival_ns: (n,) not decreasing.
        slot: (n,) row of the mailbox.
        stamp: (n,) tick at which the sample was taken.
        time: (n,) the same in seconds.
        values: (n, width).
    """

    arrival_ns: Ints
    slot: Ints
    stamp: Ints
    time: Floats
    values: Floats

    def __len__(self) -> int:
        return len(self.stamp)


class Mailbox:
    """Keeps the freshest stamp of each in-neighbour; an older stamp that arrives later changes nothing."""

    def __init__(self, n_neighbours: int, period_ns: int) -> None:
        self._period_ns = period_ns
        self.stamps = [NEVER] * n_neighbours

    def accept(self, deliveries: Deliveries) -> Updates:
        """The deliveries, in their order, that are fresher than what is there."""
        stamps, values = deliveries.stamp, deliveries.values
        arrival_ns, slots = deliveries.arrival_ns, deliveries.slot
        kept = []
        for i, (slot, stamp) in enumerate(zip(slots.tolist(), stamps.tolist(), strict=True)):
            if stamp > self.stamps[slot]:
                self.stamps[slot] = stamp
                kept.append(i)
        if len(kept) < len(stamps):
            arrival_ns, slots, stamps, values = arrival_ns[kept], slots[kept], stamps[kept], values[kept]
        contiguous = np.ascontiguousarray  # the native loop reads them by address
        return Updates(
            contiguous(arrival_ns),
            contiguous(slots),
            contiguous(stamps),
            stamps * self._period_ns / NANOSECONDS_PER_SECOND,
            contiguous(values),
        )
