"""How often a worker was lost, when, and whether it is worth replacing once more. Pure."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import count

from cosim.attention import NOWHERE, Spot

_MOST = 100
"""Replacements in a run."""

_MOST_IN_VAIN = 4
"""Losses of one worker in a row, none of which is later than all before."""


@dataclass(frozen=True)
class Moment:
    """At which a worker was lost.

    Attributes:
        tick: that it was at; before the first one, `failure.OPENING` or `failure.INITIALISING`.
        spot: the agent that was being opened, initialised or advanced; none if none was, or it is not known.
        known: whether it is known what the worker was doing.
    """

    tick: int
    spot: Spot = NOWHERE
    known: bool = False

    @property
    def at_work(self) -> bool:
        """Whether the worker may have brought it upon itself."""
        return not self.known or self.tick < 0 or self.spot.agent is not None


class History:
    """The losses of one worker and of its replacements.

    Args:
        name: of the first process.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._moments: list[Moment] = []

    @property
    def losses(self) -> int:
        """How often it was replaced."""
        return len(self._moments)

    def objection(self, moment: Moment, all_of_run: Sequence[History]) -> str | None:
        """Why it must not be replaced after another loss, to follow its name; None if it may."""
        if self._moments and moment.at_work and moment == self._moments[-1]:
            return f"was lost twice {when(moment)}: it is not replaced again"
        furthest, in_vain = -3, 0
        for past in (*self._moments, moment):
            furthest, in_vain = max(furthest, past.tick), 0 if past.tick > furthest else in_vain + 1
        if in_vain >= _MOST_IN_VAIN:
            return f"was lost {in_vain} times without getting beyond tick {furthest}: it is not replaced again"
        if sum(history.losses for history in all_of_run) >= _MOST:
            return f"is not replaced: {_MOST} workers of this run have been"
        return None

    def lost(self, moment: Moment, taken: Container[str]) -> str:
        """Count a loss; the name of the next process, which is none that is or was taken."""
        self._moments.append(moment)
        names = (f"{self._name}.{number}" for number in count(len(self._moments) + 1))
        return next(name for name in names if name not in taken)


def when(moment: Moment) -> str:
    """`at tick 7`."""
    return "before the first tick" if moment.tick < 0 else f"at tick {moment.tick}"
