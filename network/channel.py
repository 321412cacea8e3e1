"""What a channel model is: what the network does to every message of an edge.

A model is one small class: its fields are its YAML (validated, and part of the JSON schema), its `open` makes the live
channel that serves every edge with that profile at once. Random numbers come from `network.draws`, keyed by edge and
tick, so that no edge's fate depends on another's. To add one, write the class and name it in `network.models`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel, ConfigDict

from network.draws import Draws
from network.messages import Ints, Links


@dataclass(frozen=True)
class Transmission:
    """What left at a tick.

    Attributes:
        link: (n,) index of the edge among those that the channel serves.
        stamp: (n,) tick at which the sample was taken (the tick itself, unless the channel sends old samples).
        delay_ns: (n,) at least 0; `NEVER` where the message is lost.
        copy: (n,) 0 for the message, 1, 2, … for its duplicates.
    """

    link: Ints
    stamp: Ints
    delay_ns: Ints
    copy: Ints

    def with_delay(self, delay_ns: Ints) -> Transmission:
        """The same messages, with other delays."""
        return replace(self, delay_ns=delay_ns)


@dataclass(frozen=True)
class Setting:
    """What a channel is opened for.

    Attributes:
        links: the edges that it serves.
        period_ns: T.
        draws: random numbers of these edges.
        message_bytes: length of a message, all of which are equally long.
    """

    links: Links
    period_ns: int
    draws: Draws
    message_bytes: int


class Channel(ABC):
    """A live channel over `n` edges that share a profile.

    What it does depends on the edges, the tick and the draws alone, never on what the messages say: the emulator asks
    for several ticks ahead.
    """

    history: int = 0
    """How many ticks back a sample that it sends may lie."""

    @abstractmethod
    def transmit(self, tick: int) -> Transmission:
        """What leaves at `tick`. Called once per tick, in order from 0."""


class ChannelModel(BaseModel, ABC):
    """A profile as the user wrote it. Every model also has a field `model`, a literal: its name in YAML."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def as_written(self) -> dict[str, Any]:
        """What a user would write for it, without what goes without saying."""
        written = self.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        own = {name: written.pop(name) for name in type(self).__annotations__ if name in written}
        return {"model": type(self).model_fields["model"].default, **own, **written}

    @abstractmethod
    def open(self, setting: Setting) -> Channel:
        """The live channel."""

    @abstractmethod
    def min_delay_ns(self) -> int:
        """No message arrives earlier than this after it left."""

    def age_bound_ns(self, period_ns: int) -> int | None:  # noqa: ARG002 - part of the interface
        """Largest age of information read at ticks that the model can produce, or None if it has no bound.

        The age is that of `network.freshness`: at a tick, after what arrives at the tick itself.
        """
        return None


def ceil_to_tick(time_ns: int, period_ns: int) -> int:
    """The first tick at or after a time, in nanoseconds."""
    return -(-time_ns // period_ns) * period_ns
