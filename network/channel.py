"""What a channel model is: what the network does to every message of an edge.

A model is one small class: its fields are its YAML (validated, and part of the JSON schema), its `open` makes the live
channel that serves every edge with that profile at once. Random numbers come from `network.draws`, keyed by edge and
tick, so that no edge's fate depends on another's. To add one, write the class and name it in `network.models`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from network.draws import Draws
from network.messages import NEVER, Ints, Links


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
        return Transmission(self.link, self.stamp, delay_ns, self.copy)


@dataclass(frozen=True)
class Batch:
    """What left at several ticks in a row, by rising tick among messages of the same `copy`.

    Attributes:
        ticks: at which.
        sent: (n,) the tick at which each message left.
        link, stamp, delay_ns, copy: (n,) those of `Transmission`.
        whole: every edge sent one message at every tick, none of them twice, by tick and then by edge: columns are the
            rows of a (ticks, edges) table.
    """

    ticks: range
    sent: Ints
    link: Ints
    stamp: Ints
    delay_ns: Ints
    copy: Ints
    whole: bool = False

    @staticmethod
    def of(ticks: range, sent: Sequence[Transmission], whole: bool = False) -> Batch:
        """What left at each of the ticks, put together."""
        link, stamp, delay_ns, copy = (
            np.concatenate([getattr(each, name) for each in sent]) for name in ("link", "stamp", "delay_ns", "copy")
        )
        left = np.repeat(np.asarray(ticks), [len(each.link) for each in sent])
        return Batch(ticks, left, link, stamp, delay_ns, copy, whole)

    def by_tick(self) -> Iterator[Transmission]:
        """What left at each of the ticks, by copy."""
        columns = [self.link, self.stamp, self.delay_ns, self.copy]
        if len(self.ticks) == 1:
            yield Transmission(*columns)
            return
        sent = self.sent
        if self.copy.any():
            order = np.argsort(sent, kind="stable")
            sent, columns = sent[order], [column[order] for column in columns]
        ends = np.searchsorted(sent, range(self.ticks.start, self.ticks.stop + 1)).tolist()
        for begin, end in pairwise(ends):
            yield Transmission(*(column[begin:end] for column in columns))

    def with_delay(self, delay_ns: Ints) -> Batch:
        """The same messages, with other delays."""
        return Batch(self.ticks, self.sent, self.link, self.stamp, delay_ns, self.copy, self.whole)


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

    def transmit_many(self, ticks: range) -> Batch:
        """What leaves at several ticks in a row: as `transmit` at each, which a channel may do at less cost."""
        return Batch.of(ticks, [self.transmit(tick) for tick in ticks])


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


class ChannelError(RuntimeError):
    """A channel of the user's own failed: which, when and where."""


def invalid(sent: object, tick: int, n_links: int, history: int) -> str | None:
    """What is wrong with a channel's answer at a tick; None if nothing is."""
    if not isinstance(sent, Transmission):
        return f"it returned a {type(sent).__name__}, no Transmission"
    columns = {name: getattr(sent, name) for name in ("link", "stamp", "delay_ns", "copy")}
    for name, column in columns.items():
        if not isinstance(column, np.ndarray) or column.ndim != 1 or column.dtype != np.int64:
            kind = f"{column.dtype} array of shape {column.shape}" if isinstance(column, np.ndarray) else repr(column)
            return f"`{name}` is no flat array of int64, but {kind}"
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        return "the arrays differ in length: " + ", ".join(f"{name} has {n}" for name, n in lengths.items())
    oldest = max(0, tick - history)
    for name, low, high in (("link", 0, n_links - 1), ("stamp", oldest, tick), ("copy", 0, None)):
        column = columns[name]
        outside = column[(column < low) | (column > (column if high is None else high))]
        if len(outside):
            return f"`{name}` has {outside[0]}; it must be {low} or more" + (f", and {high} at most" if high else "")
    negative = sent.delay_ns[(sent.delay_ns < 0) & (sent.delay_ns != NEVER)]
    return f"`delay_ns` has {negative[0]}; it must be 0 or more, or NEVER" if len(negative) else None


def ceil_to_tick(time_ns: int, period_ns: int) -> int:
    """The first tick at or after a time, in nanoseconds."""
    return -(-time_ns // period_ns) * period_ns
