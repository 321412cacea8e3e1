"""A channel played alone: the same emulator as in a run, and messages that say nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.channel.subject import Subject
from cosim.errors import ConfigError, NetworkError, Problem
from network.channel import ChannelError
from network.emulator import Emulator
from network.messages import Fates, Links, MessageLayout
from network.units import to_seconds


@dataclass(frozen=True)
class Alone:
    """What became of the messages of one channel: a `cosim.reporting.edges.Logged`, as the results of a run are.

    Attributes:
        name: of the channel.
        ticks: at which messages left.
        bound_ns: on the age at ticks; None if there is none.
    """

    name: str
    links: Links
    period_ns: int
    ticks: int
    fates: Fates
    bound_ns: int | None

    @property
    def agents(self) -> tuple[str, ...]:
        """Names."""
        return self.links.agents

    @property
    def n_ticks(self) -> int:
        """One more, as a run records."""
        return self.ticks + 1

    @property
    def analysis(self) -> Mapping[str, Any]:
        """Of no controller anything is known."""
        return {"k_eta": None, "lambda": None, "leaders": None}

    @property
    def n_fates(self) -> int:
        """How many there are."""
        return len(self.fates)

    def first_fates(self, limit: int) -> Fates:
        """The first ones."""
        return self.fates.between(0, limit)

    def channel(self, link: int) -> str:  # noqa: ARG002 - all edges have one
        """Its name."""
        return self.name

    def age_bound(self, link: int) -> float | None:  # noqa: ARG002
        """In seconds, read at ticks; None without bound."""
        return None if self.bound_ns is None else to_seconds(self.bound_ns)


def play(subject: Subject) -> Alone:
    """What becomes of the messages.

    Raises:
        ConfigError: the channel cannot serve these edges.
        NetworkError: it is a class of the user's own, which failed.
    """
    links, layout = subject.links, MessageLayout(("value",), (subject.size // 8,))
    channels, names = {"all": subject.model}, ["all"] * len(links)
    try:
        emulator = Emulator(links, channels, names, layout, subject.seed, subject.period_ns)
    except ValueError as error:  # as of a replay without these edges
        raise ConfigError([Problem(f"{subject.name} cannot be played on these edges: {error}")]) from None
    except ChannelError as error:
        raise NetworkError(str(error)) from error
    values = np.zeros((len(links.agents), layout.width))
    try:
        parts = [emulator.emulate(tick, values).fates for tick in range(subject.n_ticks)]
    except ChannelError as error:
        raise NetworkError(str(error)) from error
    parts.append(emulator.finish())
    fates = Fates.joined(parts)
    bound = subject.model.age_bound_ns(subject.period_ns)
    return Alone(subject.name, links, subject.period_ns, subject.n_ticks, fates, bound)
