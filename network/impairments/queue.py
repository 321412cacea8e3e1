"""A link of limited rate with a queue in front of it: every edge has its own."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from network.channel import Setting, Transmission
from network.impairments.impairment import Impairment, Stage, Stepwise, schema_of, under_way
from network.messages import NEVER
from network.units import BitRate, Size, parse_bit_rate


class Rate(Impairment):
    """tc's `rate RATE [PACKETOVERHEAD [CELLSIZE [CELLOVERHEAD]]]`, with a queue of finite length."""

    short_form = schema_of(BitRate)
    short_field = "rate"
    from_short = parse_bit_rate

    rate: BitRate = Field(description='such as "1 Mbit/s"')
    overhead: Size = Field(0, description="bytes that the network adds to every message; may be negative")
    cell: Size = Field(0, ge=0, description="messages fill whole cells of so many bytes")
    cell_overhead: Size = Field(0, description="bytes that the network adds to every cell")
    limit: int | None = Field(
        None, ge=1, description="messages in the queue, the one on the link included; more are lost"
    )

    def transmission_ns(self, message_bytes: int) -> int:
        """How long a message occupies the link."""
        size = max(0, message_bytes + self.overhead)
        if self.cell:
            size = math.ceil(size / self.cell) * (self.cell + self.cell_overhead)
        return math.ceil(max(0, size) * 8e9 / self.rate)

    def open(self, setting: Setting) -> Stage:
        return _Rate(self, setting)

    def max_delay_ns(self) -> int | None:
        return None


class _Rate(Stepwise):
    def __init__(self, model: Rate, setting: Setting) -> None:
        self._period_ns = setting.period_ns
        self._service_ns = model.transmission_ns(setting.message_bytes)
        self._limit = model.limit
        self._free_ns = np.zeros(len(setting.links), np.int64)  # when the link has sent all it was given

    def step(self, tick: int, messages: Transmission) -> Transmission:
        delay = messages.delay_ns.copy()
        now = tick * self._period_ns
        for _, offered in under_way(messages):
            index = offered
            link, arrives = messages.link[index], now + messages.delay_ns[index]
            free = self._free_ns[link]
            if self._limit is not None and self._service_ns:
                # All messages of a run are equally long: what is left to send, in messages, is the queue's length.
                full = -((arrives - free) // self._service_ns) >= self._limit
                delay[index[full]] = NEVER
                index, link, arrives, free = index[~full], link[~full], arrives[~full], free[~full]
            done = np.maximum(arrives, free) + self._service_ns
            self._free_ns[link] = done
            delay[index] = done - now
        return messages.with_delay(delay)
