"""What the kit found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """Of one check."""

    OK = "ok"
    NOTE = "note"  # allowed, but worth knowing
    PROBLEM = "problem"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Attributes:
        interface: how the component was driven: `Co-Simulation`, `Model Exchange`, or empty where that does not matter.
        check: its name.
        text: a sentence for people.
    """

    interface: str
    check: str
    verdict: Verdict
    text: str


class ConformanceError(AssertionError):
    """A component has problems."""


@dataclass(frozen=True)
class Report:
    """All findings about a component.

    Attributes:
        target: what was checked.
    """

    target: str
    findings: tuple[Finding, ...]

    @property
    def problems(self) -> tuple[Finding, ...]:
        """Those that must be mended."""
        return tuple(finding for finding in self.findings if finding.verdict is Verdict.PROBLEM)

    def require(self) -> None:
        """Nothing, if there are no problems.

        Raises:
            ConformanceError: there are; the message is the whole report.
        """
        if self.problems:
            raise ConformanceError(str(self))

    def __str__(self) -> str:
        lines = [self.target]
        interface = None
        for finding in self.findings:
            if finding.interface != interface:
                interface = finding.interface
                lines += ["", interface] if interface else []
            lines.append(f"  {finding.verdict:<8} {finding.check:<18} {finding.text}")
        n = len(self.problems)
        return "\n".join([*lines, "", "no problems" if not n else f"{n} problem{'' if n == 1 else 's'}"])
