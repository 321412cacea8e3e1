"""How problems look on the screen."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cosim.errors import Problem, Severity


def print_problems(problems: Sequence[Problem]) -> None:
    """One line each, then how many there were."""
    for problem in problems:
        print(_linked(problem) if problem.see and sys.stderr.isatty() else problem, file=sys.stderr)
    counts = [(severity, sum(p.severity is severity for p in problems)) for severity in Severity]
    said = [f"{count} {severity}{'' if count == 1 else 's'}" for severity, count in counts if count]
    if said:
        print(", ".join(said), file=sys.stderr)


def _linked(problem: Problem) -> str:
    """With a link to its place in the docs, for terminals that know links (OSC 8); others show the text alone."""
    from cosim.channel import explaining

    entry = explaining.entries().get(problem.see or "")
    if entry is None:
        return str(problem)
    link = f"{explaining.page().as_uri()}#L{entry.line}"
    return str(problem).replace(problem.how_to_see, f"\033]8;;{link}\033\\{problem.how_to_see}\033]8;;\033\\")
