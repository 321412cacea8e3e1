"""Delay, jitter and order: how long messages travel, and whether they may overtake each other."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, ValidationError, model_serializer, model_validator

from network.channel import Batch, Setting, Transmission
from network.files import file_read_by
from network.impairments import distributions
from network.impairments.impairment import (
    Impairment,
    Part,
    Stage,
    Stepwise,
    Sticky,
    schema_of,
    under_way,
    under_way_in,
    uniform,
    uniforms,
)
from network.impairments.order import InOrder
from network.messages import NEVER, Floats, Ints
from network.units import Duration, DurationRange, Probability, parse_duration_range, parse_probability


class Reorder(Part):
    """tc's `reorder PERCENT [CORRELATION] gap N`: some messages are not delayed at all, and so overtake others."""

    short_form = schema_of(Probability)
    short_field = "random"
    from_short = parse_probability

    random: Probability = Field(description="a message that may go ahead does so with this probability")
    correlation: Probability = Field(0.0, description="from one message to the next; the rate stays")
    gap: int = Field(1, ge=1, description="after one that went ahead, the next gap - 1 messages may not")


class Delay(Impairment):
    """tc's `delay TIME [JITTER [CORRELATION]] [distribution NAME]`; one time; or the lowest and the highest."""

    short_form = schema_of(DurationRange)
    short_field = "time"

    time: Duration = Field(description="mean; for pareto and tables what they are relative to")
    jitter: Duration = Field(0, description="half the range where uniform, else the standard deviation, or nearly so")
    correlation: Probability = Field(0.0, description="of a message's delay with that of the one before")
    distribution: distributions.Name = "uniform"
    table: file_read_by(distributions.read_table) | None = Field(  # type: ignore[valid-type]
        None, description="a file in iproute2's format (.dist), instead of `distribution`"
    )
    min: Duration = Field(0, description="no delay is less")
    max: Duration | None = Field(None, description="no delay is more")
    fifo: bool = Field(False, description="whether messages keep their order: who would overtake arrives together")

    @model_validator(mode="before")
    @classmethod
    def _from_range(cls, value: Any) -> Any:
        if isinstance(value, (int, float, str, list, tuple)) and not isinstance(value, bool):
            low, high = parse_duration_range(value)
            # Nanoseconds as text: numbers would be seconds. The middle may lie between two of them.
            return {"time": f"{low + (high - low) // 2} ns", "jitter": f"{(high - low + 1) // 2} ns"} | (
                {"min": f"{low} ns", "max": f"{high} ns"} if high > low else {}
            )
        return value

    @model_serializer(mode="wrap")
    def _as_range(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = self._as_short_as_can_be(handler)
        if isinstance(written, dict) and [*written] == ["time", "jitter", "min", "max"]:
            try:
                if Delay.model_validate([written["min"], written["max"]]) == self:
                    return [written["min"], written["max"]]
            except ValidationError:
                pass
        return written

    @model_validator(mode="after")
    def _possible(self) -> Delay:
        if self.max is not None and self.max < self.min:
            raise ValueError("`max` is less than `min`")
        if self.table is not None and "distribution" in self.model_fields_set:
            raise ValueError("give `distribution` or `table`, not both")
        if self.distribution in ("lognormal", "gamma") and self.time == 0:
            raise ValueError(f"a {self.distribution} distribution needs a mean `time` of more than 0")
        return self

    def quantile(self) -> distributions.Quantile:
        """The distribution before it is cut to `min` and `max`.

        Raises:
            ValueError: the table cannot be read.
        """
        table = None if self.table is None else distributions.read_table(Path(self.table))
        return distributions.Quantile(self.distribution, self.time, self.jitter, table)

    def open(self, setting: Setting) -> Stage:
        return self.open_with(setting, None)

    def open_with(self, setting: Setting, reorder: Reorder | None) -> Stage:
        """The live stage, in which some messages go ahead."""
        if reorder is None and not (self.correlation and self.jitter):
            return _Delay(self, setting)
        return _DelayAfterDelay(self, setting, reorder)

    def min_delay_ns(self) -> int:
        return self._bound(0, -math.inf, self.min, max)

    def max_delay_ns(self) -> int | None:
        high = self._bound(1, math.inf, self.max if self.max is not None else -1, min)
        return None if high < 0 else high

    def _bound(self, side: int, unbounded: float, cut: int, tighter: Any) -> int:
        """The lowest or the highest delay; `cut` where the distribution has no end there."""
        if self.jitter == 0:
            end = float(self.time)
        elif self.table is not None:
            table = distributions.read_table(Path(self.table))
            end = self.time + self.jitter * float(table.max() if side else table.min())
        else:
            end = self.time + self.jitter * distributions.support(self.distribution)[side]
        if end == unbounded:
            return cut
        whole = math.ceil(end) if side else math.floor(end)
        return int(whole if cut < 0 else tighter(whole, cut))


class _Law:
    """The delay of a message as a function of a number in [0, 1)."""

    def __init__(self, model: Delay) -> None:
        self._fixed = min(max(model.time, model.min), model.time if model.max is None else model.max)
        self._quantile = model.quantile() if model.jitter else None
        self._low = max(model.min, model.time - model.jitter, 0)
        self._high = model.time + model.jitter if model.max is None else min(model.max, model.time + model.jitter)
        uniform_ = model.jitter and model.distribution == "uniform" and model.table is None
        self._even = bool(uniform_ and model.correlation == 0 and self._low <= self._high)
        self._min, self._max = model.min, np.iinfo(np.int64).max if model.max is None else model.max

    @property
    def fixed(self) -> int | None:
        """The one delay of all messages, if there is one."""
        return self._fixed if self._quantile is None else None

    def __call__(self, number: Floats) -> Ints:
        if self._quantile is None:
            return np.full(len(number), self._fixed, np.int64)
        if self._even:  # over the whole nanoseconds, both ends included
            return self._low + (number * (self._high - self._low + 1)).astype(np.int64)
        return np.clip(np.rint(self._quantile(number)).astype(np.int64), self._min, self._max)


class _Delay(Stage):
    """Delays that do not depend on each other."""

    def __init__(self, model: Delay, setting: Setting) -> None:
        self._law = _Law(model)
        self._draws = setting.draws
        self._in_order = InOrder(setting) if model.fifo else None

    def apply(self, batch: Batch) -> Batch:
        if self._law.fixed is not None:
            delay = np.where(batch.delay_ns == NEVER, NEVER, batch.delay_ns + self._law.fixed)
        else:
            delay = batch.delay_ns.copy()
            for copy, which in under_way_in(batch):
                delay[which] += self._law(uniforms(self._draws, "delay", batch, copy, which))
        after = batch.with_delay(delay)
        return after if self._in_order is None else self._in_order.apply(after)


class _DelayAfterDelay(Stepwise):
    """Delays that resemble those of the messages before, or that depend on which of them went ahead."""

    def __init__(self, model: Delay, setting: Setting, reorder: Reorder | None) -> None:
        self._law = _Law(model)
        self._correlation = model.correlation
        self._draws = setting.draws
        self._normal = np.full(len(setting.links), np.nan)
        self._reorder = _Reorder(reorder, setting) if reorder is not None else None
        self._in_order = InOrder(setting) if model.fifo else None

    def apply(self, batch: Batch) -> Batch:
        after = super().apply(batch)
        return after if self._in_order is None else self._in_order.apply(after)

    def step(self, tick: int, messages: Transmission) -> Transmission:
        delay = messages.delay_ns.copy()
        for copy, index in under_way(messages):
            link = messages.link[index]
            number = uniform(self._draws, "delay", tick, copy)[link]
            own = self._law(self._correlated(number, link) if self._correlation else number)
            if self._reorder is not None:
                own[self._reorder.ahead(tick, copy, link)] = 0
            delay[index] += own
        return messages.with_delay(delay)

    def _correlated(self, number: Floats, link: Ints) -> Floats:
        """Uniform numbers whose normal scores are an autoregressive sequence: the distribution stays what it is."""
        fresh, last = distributions.to_normal(number), self._normal[link]
        c = self._correlation
        score = np.where(np.isnan(last), fresh, c * last + math.sqrt(1 - c * c) * fresh)
        self._normal[link] = score
        return distributions.from_normal(score)


class _Reorder:
    def __init__(self, model: Reorder, setting: Setting) -> None:
        self._rate, self._gap = model.random, model.gap
        self._numbers = Sticky(setting, "reorder", model.correlation)
        self._count = np.zeros(len(setting.links), np.int64)

    def ahead(self, tick: int, copy: int, link: Ints) -> Ints:
        """Indices into `link` of the messages that go ahead."""
        may = self._count[link] >= self._gap - 1
        goes = may & (self._numbers.next(tick, copy, link) < self._rate)
        self._count[link] = np.where(goes, 0, self._count[link] + 1)
        return np.flatnonzero(goes)
