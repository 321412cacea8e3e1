"""Collects what is wrong while a scenario is planned, so that a user sees all of it at once."""

from __future__ import annotations

from collections.abc import Iterable

from cosim.errors import ConfigError, Location, Problem, Severity
from cosim.scenario.mending import Doubts


class Problems:
    """Errors and warnings, each once, in the order of the file.

    Args:
        found: problems that are known already.
        doubts: errors about this are left out.
    """

    def __init__(self, found: Iterable[Problem] = (), doubts: Doubts | None = None) -> None:
        self._found: dict[Problem, None] = dict.fromkeys(found)
        self._doubts = doubts or Doubts()
        self._view = 0
        self._reported: dict[Location, int] = {}

    def next_view(self) -> None:
        """From here on, a place that is reported already is not reported again in other words: another agent that is
        made from the same lines has nothing to add.
        """
        self._view += 1

    def error(self, message: str, where: Location) -> None:
        """Something that must be mended before the scenario can run."""
        if not self._doubts.about(message) and self._reported.setdefault(where, self._view) == self._view:
            self._found[Problem(message, where)] = None

    def warning(self, message: str, where: Location) -> None:
        """Something that runs, but perhaps not as the user thinks."""
        self._found[Problem(message, where, Severity.WARNING)] = None

    @property
    def failed(self) -> bool:
        """Whether there is an error."""
        return any(problem.severity is Severity.ERROR for problem in self._found)

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """Those that do not stop a run."""
        return tuple(sorted((p for p in self._found if p.severity is Severity.WARNING), key=_place))

    def raise_if_any(self) -> None:
        """Raise everything found, warnings among it, if there is an error.

        Raises:
            ConfigError: there is an error.
        """
        if self.failed:
            raise ConfigError(sorted(self._found, key=_place))


def _place(problem: Problem) -> Location:
    return problem.where or Location("")
