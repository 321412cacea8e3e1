"""The errors that a user can meet, and how they are printed.

`ConfigError` collects every problem of a file before the first step (exit code 2); `RunError` names the agent, the
component and the simulated time of a failure during a run (exit code 3).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """Whether a problem stops a run."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, order=True)
class Location:
    """A place in a file; line and column count from 1, as editors do."""

    file: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file

    @property
    def short(self) -> str:
        """For a sentence about the same file: `at line 7`, or `in --set KEY`."""
        return f"at line {self.line}" if self.line else f"in {self.file}"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: what, where, and what to write instead (inside `message`).

    Attributes:
        see: parameter of a channel, which `cosim channel --explain` explains.
    """

    message: str
    where: Location | None = None
    severity: Severity = Severity.ERROR
    see: str | None = None

    def __str__(self) -> str:
        prefix = f"{self.where}: " if self.where else ""
        return f"{prefix}{self.severity}: {self.message}{f' ({self.how_to_see})' if self.see else ''}"

    @property
    def how_to_see(self) -> str:
        """The command that explains the parameter."""
        return f"cosim channel --explain {self.see}"


class CosimError(Exception):
    """Base of every error that `cosim` prints without a traceback."""

    exit_code = 2


class ConfigError(CosimError):
    """Everything that is wrong with a scenario, all at once."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class ComponentError(CosimError):
    """A component refused or failed; the agent adds who and when, and raises `RunError`.

    Attributes:
        component: name of the component inside its agent.
        log: last line that the component itself logged, if any.
    """

    exit_code = 3

    def __init__(self, component: str, message: str, log: str | None = None) -> None:
        self.component = component
        self.message = message
        self.log = log
        super().__init__(f"{component}: {message}" + (f" (its last log line: {log})" if log else ""))


class DiscardedStepError(ComponentError):
    """A component could not make a whole step (FMI: Discard), and is still usable."""


class EndRequestedError(ComponentError):
    """A component asks for the end of the simulation (FMI: `terminateSimulation`), which is no failure."""


class RunError(CosimError):
    """A run failed: which agent, which component, at which simulated time, and the component's own last log line."""

    exit_code = 3

    def __init__(self, agent: str, component: str, time: float, message: str, log: str | None = None) -> None:
        self.agent = agent
        self.component = component
        self.time = time
        self.message = message
        self.log = log
        text = f"agent {agent}, component {component}, at t = {time:.9g} s: {message}"
        super().__init__(text + _last_lines(log))


class RunEndedError(RunError):
    """A component asked for the end of a run that had begun; the tick before is the last one."""


def _last_lines(log: str | None) -> str:
    if not log:
        return ""
    lines = log.splitlines()
    return f"\n  its last log line: {log}" if len(lines) == 1 else "\n    ".join(["\n  its last log lines:", *lines])


class ClusterError(CosimError):
    """A process of a distributed run was lost, hangs, or said what it must not; names it, its agents and the tick."""

    exit_code = 3


class NetworkError(CosimError):
    """A channel of the user's own failed: which, at which time, and where in its file."""

    exit_code = 3


class OverrunError(CosimError):
    """A tick of a paced run was complete only after its deadline, and the run was asked to end then."""

    exit_code = 3


def suggest(wrong: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` for the nearest known name, else the list of known names if it is short, else nothing."""
    names = list(known)
    nearest = difflib.get_close_matches(wrong, names, n=1, cutoff=0.6)
    if nearest:
        return f" (did you mean {nearest[0]!r}?)"
    if names and len(names) <= 12:
        return f" (known: {', '.join(names)})"
    return ""
