"""The plain channels: every message leaves at once; it may be delayed and, independently of all others, lost."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from network.channel import Channel, ChannelModel, Transmission, ceil_to_tick, draw_delays
from network.draws import Draws
from network.messages import NEVER, Links
from network.units import DurationRange, Probability


class Ideal(ChannelModel):
    """Every message arrives at the tick at which it was sent."""

    model: Literal["ideal"] = "ideal"

    def open(self, links: Links, period_ns: int, draws: Draws) -> Channel:  # noqa: ARG002
        return _DelayChannel(len(links), (0, 0), 0.0, draws)

    def min_delay_ns(self) -> int:
        return 0

    def age_bound_ns(self, period_ns: int) -> int | None:  # noqa: ARG002
        return 0


class Delay(ChannelModel):
    """Fixed or uniformly distributed delay, and independent losses. A message may overtake an earlier one."""

    model: Literal["delay"] = "delay"
    delay: DurationRange = Field(description="one time, or the lowest and the highest of a uniform distribution")
    loss: Probability = Field(default=0.0, description="probability that a message is lost")

    def open(self, links: Links, period_ns: int, draws: Draws) -> Channel:  # noqa: ARG002
        return _DelayChannel(len(links), self.delay, self.loss, draws)

    def min_delay_ns(self) -> int:
        return self.delay[0]

    def age_bound_ns(self, period_ns: int) -> int | None:
        """Without losses: the sample of tick k is there `delay` later, so it is read at the next tick after that."""
        return ceil_to_tick(self.delay[1], period_ns) if self.loss == 0.0 else None


class _DelayChannel(Channel):
    def __init__(self, n_links: int, delay_ns: tuple[int, int], loss: float, draws: Draws) -> None:
        self._delay = delay_ns
        self._loss = loss
        self._draws = draws
        self._links = np.arange(n_links)
        self._zeros = np.zeros(n_links, np.int64)

    def transmit(self, tick: int) -> Transmission:
        low, high = self._delay
        delay = draw_delays(self._draws, tick, self._delay) if high > low else self._zeros + low
        if self._loss > 0.0:
            delay[self._draws.uniform("loss", tick) < self._loss] = NEVER
        return Transmission(self._links, self._zeros + tick, delay, self._zeros)
