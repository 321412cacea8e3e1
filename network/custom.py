"""A channel model of the user's own: a Python class by its dotted path."""

from __future__ import annotations

import importlib
from functools import cached_property
from typing import Any, Literal

from pydantic import Field, model_validator

from network.channel import Channel, ChannelModel, Setting


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
        module_name, colon, name = self.cls.partition(":")
        if not colon:
            raise ValueError(f"{self.cls!r} is no class; write package.module:Class")
        try:
            found = getattr(importlib.import_module(module_name), name, None)
        except ImportError as error:
            raise ValueError(f"{self.cls}: {error}") from None
        if not (isinstance(found, type) and issubclass(found, ChannelModel)):
            raise ValueError(f"{self.cls} is no subclass of network.channel.ChannelModel")  # noqa: TRY004 - for pydantic
        return found.model_validate(self.options)

    def open(self, setting: Setting) -> Channel:
        return self.served.open(setting)

    def min_delay_ns(self) -> int:
        return self.served.min_delay_ns()

    def age_bound_ns(self, period_ns: int) -> int | None:
        return self.served.age_bound_ns(period_ns)
