"""A profile: which samples leave, and what the network does to them on their way.

The impairments are applied in this order, whatever the order in the file: schedule, loss, duplicate, slot, rate or
mahimahi, recorded, delay (with reorder). A message that one of them loses goes no further.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field, model_validator

from network.channel import Batch, Channel, ChannelModel, Setting, Transmission, ceil_to_tick
from network.impairments.delay import Delay, Reorder
from network.impairments.duplicate import Duplicate
from network.impairments.impairment import Impairment, Stage
from network.impairments.loss import Loss
from network.impairments.mahimahi import Mahimahi
from network.impairments.queue import Rate
from network.impairments.recorded import Recorded
from network.impairments.schedule import Schedule
from network.impairments.slot import Slot


class Profile(ChannelModel):
    """A model whose messages meet any of the impairments."""

    schedule: Schedule | None = Field(None, description="losses by plan: messages, windows, outages")
    loss: Loss | None = Field(None, description='such as "2 %", or {gemodel: [1 %, 20 %]}')
    duplicate: Duplicate | None = Field(None, description='such as "1 %"')
    slot: Slot | None = Field(None, description='a link that has its turn every so often, such as "10 ms"')
    rate: Rate | None = Field(None, description='such as "1 Mbit/s", or {rate: 1 Mbit/s, limit: 20}')
    mahimahi: Mahimahi | None = Field(None, description="a packet-delivery trace, instead of `rate`")
    delay: Delay | None = Field(None, description='such as "20 ms", [10 ms, 30 ms] or {time: 40 ms, jitter: 10 ms}')
    recorded: Recorded | None = Field(None, description="delay and loss over time from a CSV file, before `delay`")
    reorder: Reorder | None = Field(None, description='messages that are not delayed, such as "1 %"')

    @model_validator(mode="after")
    def _delayed(self) -> Profile:
        if self.reorder is not None and (self.delay is None or self.delay.max_delay_ns() == 0):
            raise ValueError("`reorder` lets messages go ahead of delayed ones: give a `delay` as well")
        if self.rate is not None and self.mahimahi is not None:
            raise ValueError("give `rate` or `mahimahi`, not both: each is the link's capacity")
        return self

    @abstractmethod
    def source(self, setting: Setting) -> Channel:
        """Which samples leave, and when."""

    def source_age_ns(self, period_ns: int) -> int | None:  # noqa: ARG002 - for those that send old samples
        """How old the sample that a receiver knows can be at a tick at which everything sent has arrived at once."""
        return 0

    def impairments(self) -> Iterator[Impairment]:
        """Those that there are, in their order, without `reorder`, which belongs to `delay`."""
        capacity = self.rate or self.mahimahi
        for impairment in (self.schedule, self.loss, self.duplicate, self.slot, capacity, self.recorded, self.delay):
            if impairment is not None:
                yield impairment

    def open(self, setting: Setting) -> Channel:
        stages = [
            impairment.open_with(setting, self.reorder) if isinstance(impairment, Delay) else impairment.open(setting)
            for impairment in self.impairments()
        ]
        source = self.source(setting)
        return _Pipeline(source, stages) if stages else source

    def min_delay_ns(self) -> int:
        if self.reorder is not None:
            return 0
        return sum(impairment.min_delay_ns() for impairment in self.impairments())

    def age_bound_ns(self, period_ns: int) -> int | None:
        """Where nothing is lost or waits: the sample of tick k is there one longest delay later."""
        own = self.source_age_ns(period_ns)
        longest = [impairment.max_delay_ns() for impairment in self.impairments()]
        if own is None or None in longest:
            return None
        return own + ceil_to_tick(sum(filter(None, longest)), period_ns)


class Source(Channel):
    """A channel that does several ticks at once."""

    def transmit(self, tick: int) -> Transmission:
        (sent,) = self.transmit_many(range(tick, tick + 1)).by_tick()
        return sent

    @abstractmethod
    def transmit_many(self, ticks: range) -> Batch: ...


class EverySample(Source):
    """Every sample leaves at once."""

    def __init__(self, n_links: int) -> None:
        self._links = np.arange(n_links)

    def transmit_many(self, ticks: range) -> Batch:
        n = len(self._links)
        sent = np.repeat(np.asarray(ticks), n)
        zeros = np.zeros(len(sent), np.int64)
        return Batch(ticks, sent, np.tile(self._links, len(ticks)), sent, zeros, zeros, whole=True)


class _Pipeline(Source):
    def __init__(self, source: Channel, stages: Sequence[Stage]) -> None:
        self.history = source.history
        self._source = source
        self._stages = stages

    def transmit_many(self, ticks: range) -> Batch:
        batch = self._source.transmit_many(ticks)
        for stage in self._stages:
            batch = stage.apply(batch)
        return batch
