"""The plain channels: every sample leaves at the tick at which it was taken."""

from __future__ import annotations

from typing import Literal

from network.channel import Channel, ChannelModel, Setting
from network.profile import EverySample, Profile


class Ideal(ChannelModel):
    """Every message arrives at the tick at which it was sent."""

    model: Literal["ideal"] = "ideal"

    def open(self, setting: Setting) -> Channel:
        return EverySample(len(setting.links))

    def min_delay_ns(self) -> int:
        return 0

    def age_bound_ns(self, period_ns: int) -> int | None:  # noqa: ARG002
        return 0


class Netem(Profile):
    """Impairments in the vocabulary of Linux's `tc qdisc … netem`."""

    model: Literal["netem"] = "netem"

    def source(self, setting: Setting) -> Channel:
        return EverySample(len(setting.links))
