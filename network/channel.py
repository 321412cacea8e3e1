"""Channel models: what the network does to every message of an edge.

A model is one small class: its fields are its YAML (validated, and part of the JSON schema), its `open` makes the live
channel that serves every edge with that profile at once. Random numbers come from `network.draws`, keyed by edge and
tick, so that no edge's fate depends on another's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

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


class Channel(ABC):
    """A live channel over `n` edges that share a profile."""

    history: int = 0
    """How many ticks back a sample that it sends may lie."""

    @abstractmethod
    def transmit(self, tick: int) -> Transmission:
        """What leaves at `tick`. Called once per tick, in order."""


class ChannelModel(BaseModel, ABC):
    """A profile as the user wrote it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @abstractmethod
    def open(self, links: Links, period_ns: int, draws: Draws) -> Channel:
        """The live channel over `links`."""

    @abstractmethod
    def min_delay_ns(self) -> int:
        """No message arrives earlier than this after it left."""

    def age_bound_ns(self, period_ns: int) -> int | None:
        """Largest age of information read at ticks that the model can produce, or None if it has no bound."""
        return None
