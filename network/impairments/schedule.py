"""Losses by plan: of certain messages, and while a link is down."""

from __future__ import annotations

import itertools
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

from network.channel import Batch, Setting, Transmission
from network.impairments.impairment import Impairment, Stage, Stepwise, under_way
from network.messages import NEVER, Ints
from network.units import Duration, PositiveDuration, format_duration, parse_duration


def _windows(value: Any) -> Any:
    """Pairs of times, in order and apart."""
    if not isinstance(value, (list, tuple)):
        raise ValueError("write a list of [from, to], such as [[10 s, 12 s], [30 s, 31 s]]")  # noqa: TRY004 - pydantic's
    if len(value) == 2 and not any(isinstance(item, (list, tuple)) for item in value):
        value = [value]
    windows = []
    for item in value:
        if not isinstance(item, (list, tuple)) or len(item) != 2:
            raise ValueError(f"{item!r} is no [from, to], such as [10 s, 12 s]")
        windows.append((parse_duration(item[0]), parse_duration(item[1])))
    for begin, end in windows:
        if not 0 <= begin < end:
            raise ValueError(f"{item!r}: a window begins at 0 or later and ends after it begins")
    if any(first[1] > second[0] for first, second in itertools.pairwise(windows)):
        raise ValueError("windows follow each other in time and do not overlap")
    return windows


def _ordinals(value: Any) -> Any:
    """Numbers from 1, and ranges."""
    items = value if isinstance(value, (list, tuple)) else [value]
    ordinals: list[int] = []
    for item in items:
        first, dots, last = str(item).partition("..")
        if not first.strip().isdigit() or (dots and not last.strip().isdigit()):
            raise ValueError(f"{item!r} is no message: they are counted from 1, such as 3 or 10..20")
        named = range(int(first), int(last or first) + 1)
        if not named:
            raise ValueError(f"{item!r}: a range begins with the lesser number")
        if len(ordinals) + (named[-1] - named[0] + 1) > 1_000_000:
            raise ValueError("more than a million messages; use `down` windows")
        ordinals += named
    if min(ordinals, default=1) < 1:
        raise ValueError("messages are counted from 1")
    return sorted(set(ordinals))


def _as_written(windows: list[tuple[int, int]]) -> list[list[str]]:
    return [[format_duration(time) for time in window] for window in windows]


Windows = Annotated[
    list[tuple[int, int]],
    BeforeValidator(_windows, json_schema_input_type=list[list[float | str]]),
    PlainSerializer(_as_written, when_used="json"),
]
"""Nanoseconds."""


class Outage(Impairment):
    """The link is down for a while, again and again."""

    every: PositiveDuration = Field(description="from the beginning of an outage to that of the next")
    down: PositiveDuration = Field(alias="for", description="how long each lasts")
    first: Duration = Field(0, description="when the first begins")

    @model_validator(mode="after")
    def _shorter(self) -> Outage:
        if self.down >= self.every:
            raise ValueError("an outage must be shorter than the time from one to the next: nothing would arrive")
        return self

    def open(self, setting: Setting) -> Stage:
        return Schedule(outage=self).open(setting)


class Schedule(Impairment):
    """A message that leaves while the link is down is lost; windows include their beginning, not their end."""

    drop: Annotated[list[int], BeforeValidator(_ordinals)] = Field(
        [], description="messages of each edge that are lost, counted from 1: [3, 10..20]"
    )
    down: Windows = Field([], description="windows in which the link is down: [[10 s, 12 s]]")
    up: Windows | None = Field(None, description="windows in which the link is up, and at no other time")
    outage: Outage | None = None

    def open(self, setting: Setting) -> Stage:
        return _Schedule(self, setting)

    def is_down(self, time: Ints) -> NDArray[np.bool_]:
        """Whether the link is down at some times, in nanoseconds."""
        down = _inside(_edges(self.down), time)
        if self.up is not None:
            down |= ~_inside(_edges(self.up), time)
        if self.outage is not None:
            since = time - self.outage.first
            down |= (since >= 0) & (since % self.outage.every < self.outage.down)
        return down

    def max_delay_ns(self) -> int | None:
        return None if self.drop or self.down or self.up is not None or self.outage else 0


class _Schedule(Stage):
    def __init__(self, model: Schedule, setting: Setting) -> None:
        self._period_ns = setting.period_ns
        self._model = model
        self._drop = _Drop(model.drop, setting) if model.drop else None

    def apply(self, batch: Batch) -> Batch:
        if self._drop is not None:
            batch = self._drop.apply(batch)
        down = self._model.is_down(batch.sent * self._period_ns + batch.delay_ns)
        return batch.with_delay(np.where(down, NEVER, batch.delay_ns))


class _Drop(Stepwise):
    """Counts the messages of each edge."""

    def __init__(self, ordinals: list[int], setting: Setting) -> None:
        self._ordinals = np.array(ordinals, np.int64)
        self._count = np.zeros(len(setting.links), np.int64)

    def step(self, tick: int, messages: Transmission) -> Transmission:  # noqa: ARG002 - whatever the tick
        delay = messages.delay_ns.copy()
        for _, index in under_way(messages):
            link = messages.link[index]
            self._count[link] += 1
            delay[index[np.isin(self._count[link], self._ordinals)]] = NEVER
        return messages.with_delay(delay)


def _edges(windows: list[tuple[int, int]]) -> Ints:
    return np.array(windows, np.int64).reshape(-1)


def _inside(edges: Ints, time: Ints) -> NDArray[np.bool_]:
    return np.asarray(np.searchsorted(edges, time, side="right") % 2 == 1)
