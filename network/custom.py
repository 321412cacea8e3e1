"""A channel model of the user's own: a Python class by its dotted path."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from network.channel import Batch, Channel, ChannelError, ChannelModel, Setting, Transmission, invalid
from network.loading import load, told
from network.units import to_seconds


class Custom(ChannelModel):
    """Any subclass of `ChannelModel`; `network.conformance` checks that it keeps the rules."""

    model: Literal["python"] = "python"
    cls: str = Field(alias="class", description="package.module:Class")
    options: dict[str, Any] = Field({}, description="its fields")

    @model_validator(mode="after")
    def _valid(self) -> Custom:
        self.served  # noqa: B018 - its mistakes are this profile's
        return self

    @cached_property
    def served(self) -> ChannelModel:
        """The model itself.

        Raises:
            ValueError: there is no such class, it is no channel model, or its fields are wrong.
        """
        found = load(self.cls, ChannelModel).cls  # type: ignore[type-abstract]
        try:
            return found.model_validate(self.options)
        except ValidationError as error:
            raise ValueError(f"options of {self.cls}: {'; '.join(map(_mistake, error.errors()))}") from None

    def open(self, setting: Setting) -> Channel:
        try:
            return _Guarded(self.cls, self.served.open(setting), setting)
        except Exception as error:
            raise ChannelError(f"{self.cls} cannot be opened: {told(error, __file__)}") from error

    def min_delay_ns(self) -> int:
        return self.served.min_delay_ns()

    def age_bound_ns(self, period_ns: int) -> int | None:
        return self.served.age_bound_ns(period_ns)


def _mistake(error: ErrorDetails) -> str:
    where = ".".join(map(str, error["loc"]))
    if error["type"] == "extra_forbidden":
        return f"there is no field {where!r}"
    if error["type"] == "missing":
        return f"{where!r} is missing"
    return (f"{where}: " if where else "") + error["msg"].removeprefix("Value error, ")


class _Guarded(Channel):
    """Says which channel failed, when, and where in the user's file."""

    def __init__(self, name: str, channel: Channel, setting: Setting) -> None:
        if not isinstance(channel, Channel):
            raise TypeError(f"open returned a {type(channel).__name__}, no network.channel.Channel")
        self.history = channel.history
        self._name, self._channel = name, channel
        self._n, self._period_ns = len(setting.links), setting.period_ns

    def transmit(self, tick: int) -> Transmission:
        try:
            sent = self._channel.transmit(tick)
        except Exception as error:
            raise ChannelError(f"{self._at(tick)}: {told(error, __file__)}") from error
        wrong = invalid(sent, tick, self._n, self.history)
        if wrong:
            raise ChannelError(f"{self._at(tick)}: {wrong}")
        return sent

    def transmit_many(self, ticks: range) -> Batch:
        if type(self._channel).transmit_many is Channel.transmit_many:
            return super().transmit_many(ticks)
        try:
            batch = self._channel.transmit_many(ticks)
            sent = [*batch.by_tick()]
        except Exception as error:
            raise ChannelError(f"{self._at(ticks.start)}: {told(error, __file__)}") from error
        for tick, each in zip(ticks, sent, strict=True):
            wrong = invalid(each, tick, self._n, self.history)
            if wrong:
                raise ChannelError(f"{self._at(tick)}: {wrong}")
        return batch

    def _at(self, tick: int) -> str:
        return f"channel {self._name}, at tick {tick} (t = {to_seconds(tick * self._period_ns):.9g} s)"
