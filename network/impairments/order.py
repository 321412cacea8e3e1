"""Messages that keep their order: who would overtake arrives together with those ahead of it."""

from __future__ import annotations

import numpy as np

from network.channel import Batch, Setting, Transmission
from network.impairments.impairment import Stepwise, under_way
from network.messages import NEVER


class InOrder(Stepwise):
    """Holds messages back until those that left before them on their edge have arrived."""

    def __init__(self, setting: Setting) -> None:
        self._period_ns = setting.period_ns
        self._last = np.zeros(len(setting.links), np.int64)  # arrivals

    def apply(self, batch: Batch) -> Batch:
        if not batch.whole:
            return super().apply(batch)
        now = batch.sent * self._period_ns
        arrival = np.where(batch.delay_ns == NEVER, 0, now + batch.delay_ns).reshape(len(batch.ticks), -1)
        np.maximum(arrival[0], self._last, out=arrival[0])
        np.maximum.accumulate(arrival, axis=0, out=arrival)
        self._last = arrival[-1].copy()
        return batch.with_delay(np.where(batch.delay_ns == NEVER, NEVER, arrival.reshape(-1) - now))

    def step(self, tick: int, messages: Transmission) -> Transmission:
        delay = messages.delay_ns.copy()
        now = tick * self._period_ns
        for _, index in under_way(messages):
            link = messages.link[index]
            self._last[link] = np.maximum(now + delay[index], self._last[link])
            delay[index] = self._last[link] - now
        return messages.with_delay(delay)
