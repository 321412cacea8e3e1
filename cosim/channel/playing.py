"""A channel played alone: the same emulator as in a run, and messages that say nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.channel.subject import Subject
from cosim.errors import ConfigError, Problem
from network.emulator import Emulator
from network.messages import Fates, Links, MessageLayout
from network.units import to_seconds

_COLUMNS = ("sender", "receiver", "stamp", "sent", "arrival_ns", "fate")


class Played:
    """What became of the messages; a `cosim.reporting.edges.Logged`, as the results of a run are.

    Args:
        subject: that is played.

    Raises:
        ConfigError: the channel cannot serve these edges.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.fates = _play(subject)

    @property
    def agents(self) -> tuple[str, ...]:
        """Names."""
        return self.subject.links.agents

    @property
    def links(self) -> Links:
        """The edges."""
        return self.subject.links

    @property
    def period_ns(self) -> int:
        """T."""
        return self.subject.period_ns

    @property
    def n_ticks(self) -> int:
        """One more than those at which messages left, as a run records."""
        return self.subject.n_ticks + 1

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
        return Fates(*(getattr(self.fates, name)[:limit] for name in _COLUMNS))

    def channel(self, link: int) -> str:  # noqa: ARG002 - all edges have one
        """Its name."""
        return self.subject.name

    def age_bound(self, link: int) -> float | None:  # noqa: ARG002
        """In seconds, read at ticks; None without bound."""
        bound = self.subject.model.age_bound_ns(self.subject.period_ns)
        return None if bound is None else to_seconds(bound)


def _play(subject: Subject) -> Fates:
    links, layout = subject.links, MessageLayout(("value",), (subject.size // 8,))
    try:
        emulator = Emulator(
            links, {"all": subject.model}, ["all"] * len(links), layout, subject.seed, subject.period_ns
        )
    except ValueError as error:  # as of a replay without these edges
        raise ConfigError([Problem(f"{subject.name} cannot be played on these edges: {error}")]) from None
    values = np.zeros((len(links.agents), layout.width))
    fates = [emulator.emulate(tick, values).fates for tick in range(subject.n_ticks)]
    fates.append(emulator.finish())
    return Fates(*(np.concatenate([getattr(part, name) for part in fates]) for name in _COLUMNS))
