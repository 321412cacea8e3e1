"""A channel model of the user's own: a Python class by its dotted path."""

from __future__ import annotations

import difflib
import importlib
import sys
import traceback
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from network.channel import Batch, Channel, ChannelError, ChannelModel, Setting, Transmission, invalid
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
        found = load(self.cls)
        try:
            return found.model_validate(self.options)
        except ValidationError as error:
            raise ValueError(f"options of {self.cls}: {'; '.join(map(_mistake, error.errors()))}") from None

    def open(self, setting: Setting) -> Channel:
        try:
            return _Guarded(self.cls, self.served.open(setting), setting)
        except Exception as error:
            raise ChannelError(f"{self.cls} cannot be opened: {_say(error)}") from error

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


def load(dotted: str) -> type[ChannelModel]:
    """The class at `package.module:Class`, looked for on Python's path, then in the current folder.

    Raises:
        ValueError: there is none, its module cannot be imported, or it is no channel model.
    """
    module_name, colon, name = dotted.partition(":")
    if not (module_name and colon and name):
        raise ValueError(f"{dotted!r} is no class; write package.module:Class")
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and (module_name == error.name or module_name.startswith(f"{error.name}.")):
            raise ValueError(f"there is no Python module {error.name!r}") from None
        raise ValueError(f"{module_name} cannot be imported: {_say(error)}") from error
    except (Exception, SystemExit) as error:
        raise ValueError(f"{module_name} cannot be imported: {_say(error)}") from error
    found = getattr(module, name, None)
    if isinstance(found, type) and issubclass(found, ChannelModel):
        return found
    if found is None:
        models = [
            key for key, value in vars(module).items() if isinstance(value, type) and issubclass(value, ChannelModel)
        ]
        near = difflib.get_close_matches(name, models, n=1)
        raise ValueError(f"{module_name} has no class {name!r}" + (f" (did you mean {near[0]!r}?)" if near else ""))
    raise ValueError(f"{dotted} is no subclass of network.channel.ChannelModel")


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
            raise ChannelError(f"{self._at(tick)}: {_say(error)}") from error
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
            raise ChannelError(f"{self._at(ticks.start)}: {_say(error)}") from error
        for tick, each in zip(ticks, sent, strict=True):
            wrong = invalid(each, tick, self._n, self.history)
            if wrong:
                raise ChannelError(f"{self._at(tick)}: {wrong}")
        return batch

    def _at(self, tick: int) -> str:
        return f"channel {self._name}, at tick {tick} (t = {to_seconds(tick * self._period_ns):.9g} s)"


def _say(error: BaseException) -> str:
    """One line: what went wrong, and the place in the user's code."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "importlib" not in f.filename]
    own = [f for f in frames if f.filename != __file__]
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    return f"{type(error).__name__}: {error}{place}"
