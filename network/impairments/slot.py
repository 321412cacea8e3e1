"""Slots: a link that delivers in bursts, such as a radio that has its turn every few milliseconds."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field, field_validator, model_validator

from network.channel import Setting, Transmission
from network.impairments.impairment import Impairment, Stage, Stepwise, schema_of, under_way
from network.messages import Ints
from network.units import DurationRange


class Slot(Impairment):
    """tc's `slot MIN [MAX] [packets N]`: what arrives is handed over at the beginning of the next slot.

    Slots follow each other at times drawn evenly between the lowest and the highest; the first begins at 0. (netem's
    slots begin when there is something to send; these go on all the time, as a radio's do.)
    """

    short_form = schema_of(DurationRange)
    short_field = "every"

    every: DurationRange = Field(description="time between slots: one, or the lowest and the highest")
    packets: int | None = Field(None, ge=1, description="messages per slot; the others wait for the next one")

    @model_validator(mode="before")
    @classmethod
    def _from_time(cls, value: Any) -> Any:
        if isinstance(value, (int, float, str, list, tuple)) and not isinstance(value, bool):
            return {"every": value}
        return value

    @field_validator("every")
    @classmethod
    def _long_enough(cls, every: tuple[int, int]) -> tuple[int, int]:
        if every[0] < 1000:
            raise ValueError("slots must be 1 us apart at least")
        return every

    def open(self, setting: Setting) -> Stage:
        return _Slot(self, setting)

    def max_delay_ns(self) -> int | None:
        return self.every[1] if self.packets is None else None


class _Slot(Stepwise):
    """Per edge: when the current slot began, its number, and how many messages it has taken."""

    def __init__(self, model: Slot, setting: Setting) -> None:
        n = len(setting.links)
        self._low, self._high = model.every
        self._packets = model.packets
        self._period_ns = setting.period_ns
        self._draws = setting.draws
        self._begin = np.zeros(n, np.int64)
        self._number = np.zeros(n, np.int64)
        self._taken = np.zeros(n, np.int64)

    def step(self, tick: int, messages: Transmission) -> Transmission:
        # In the order of arrival on each edge, so that a slot is never asked for again once it has passed.
        delay = messages.delay_ns.copy()
        now = tick * self._period_ns
        for _, index in under_way(messages):
            link = messages.link[index]
            arrives = now + messages.delay_ns[index]
            self._open_slots(link, arrives)
            delay[index] = np.maximum(self._begin[link], arrives) - now
            self._taken[link] += 1
        return messages.with_delay(delay)

    def _open_slots(self, link: Ints, arrives: Ints) -> None:
        """Go to the first slot that begins at or after each arrival and has room."""
        while True:
            late = self._begin[link] < arrives
            if self._packets is not None:
                late |= self._taken[link] >= self._packets
            link, arrives = link[late], arrives[late]
            if not len(link):
                return
            self._begin[link] += self._interval(link)
            self._number[link] += 1
            self._taken[link] = 0

    def _interval(self, link: Ints) -> Ints:
        if self._low == self._high:
            return np.full(len(link), self._low, np.int64)
        drawn = self._draws.at("slot", self._number[link], link)
        return self._low + (drawn * (self._high - self._low + 1)).astype(np.int64)
