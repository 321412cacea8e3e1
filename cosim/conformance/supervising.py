"""The kit from outside: tries a component out in a process of its own, and says so when that crashes or hangs."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from cosim.components.component import Description, Interface, Value
from cosim.components.limits import odd_limits
from cosim.components.opening import describe
from cosim.components.presented import find
from cosim.conformance.report import Finding, Report, Verdict
from cosim.errors import ConfigError, Problem
from cosim.spawning import kill_group, signal_name

_LONGEST_START = 60.0
"""Seconds within which a process has read the component."""
_LEAVE_SECONDS = 5.0
"""Within which a process that is through has removed its files."""
_MOST_LOSSES = 2
"""After so many processes that one interface crashed or hung, its other checks are left out."""
_NAMES = {Interface.CO_SIMULATION: "Co-Simulation", Interface.MODEL_EXCHANGE: "Model Exchange"}


def check(
    target: str | Path | type,
    *,
    start: Mapping[str, Value | Sequence[Value]] | None = None,
    deadline: float = 10.0,
) -> Report:
    """Try a component out, through every interface that it offers.

    Args:
        target: an FMU file, or a component class: itself, or as `package.module:Class`.
        start: start values of its variables, where its own will not do; numbers and texts, or lists of them.
        deadline: longest time of one check in seconds.

    Raises:
        ConfigError: it cannot be read, or cannot run here at all.
    """
    path, python = _target(target)
    values = {name: _listed(x) for name, x in (start or {}).items()}
    structural = {name: x[0] for name, x in values.items() if isinstance(x[0], int)}
    description = describe(path, python, structural)
    unknown = [name for name in values if find(description.variables, name) is None]
    if unknown:
        raise ConfigError([Problem(f"{path or python} has no variable {name!r}") for name in unknown])
    if not description.whole:
        raise ConfigError([Problem(f"{path} holds only the description of an FMU; trying it out takes the FMU itself")])
    title = f"{path.name if path else python}: {description.model}, " + (
        "Python" if path is None else f"FMI {description.fmi}"
    )
    found = [*_validation(path, description), *_Trial(path, python, values, description, deadline).findings()]
    return Report(title, tuple(found))


def _listed(value: Value | Sequence[Value]) -> list[Value]:
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]


_AFTER_ANOTHER = "after other instances have ended in it; `isolate: true` gives each a process of its own"


def _target(target: str | Path | type) -> tuple[Path | None, str | None]:
    if isinstance(target, type):
        if target.__module__ == "__main__" or "<locals>" in target.__qualname__:
            raise ConfigError([Problem(f"{target.__qualname__} must lie in a module, to be found by another process")])
        return None, f"{target.__module__}:{target.__qualname__}"
    if isinstance(target, str) and ":" in target and not Path(target).exists():
        return None, target
    return Path(target), None


def _validation(path: Path | None, description: Description) -> list[Finding]:
    if path is None:
        return []
    from cosim.components.fmu.library import findings

    found = [*findings(path), *odd_limits(description.variables)]
    if not found:
        return [Finding("", "description", Verdict.OK, "the validation finds nothing")]
    return [Finding("", "description", *_weighed(text)) for text in found]


def _weighed(text: str) -> tuple[Verdict, str]:
    """Most tools get `InitialUnknowns` wrong, and only one that needs their order minds."""
    if text.startswith("ModelStructure/InitialUnknowns"):
        return Verdict.NOTE, f"{text} Nothing here depends on that; some tools refuse it"
    return Verdict.PROBLEM, text


class _Trial:
    """Starts a process, and another one where that did not get through all checks."""

    def __init__(
        self,
        path: Path | None,
        python: str | None,
        start: Mapping[str, list[Value]],
        description: Description,
        deadline: float,
    ) -> None:
        self._request = {
            "file": str(path.absolute()) if path else None,
            "python": python,
            "start": start,
            "path": [entry or str(Path.cwd()) for entry in sys.path],
        }
        self._interfaces = description.interfaces
        self._deadline = deadline

    def findings(self) -> list[Finding]:
        from cosim.conformance.checks import CHECKS, checks_of

        left = [(str(interface), name) for interface in self._interfaces for name in checks_of(interface)]
        found: list[Finding] = []
        losses: Counter[str] = Counter()
        alone = False
        while left:
            done, lost = self._attempt(left[:1] if alone else left, found)
            interface = left[done - 1][0]
            if lost and done > 1 and (again := self._alone(left[done - 1])) is not None:
                ended = found.pop()
                found += [*again, replace(ended, check="independence", text=f"{ended.text}, {_AFTER_ANOTHER}")]
                alone, lost = True, False
            left = left[done:]
            losses[interface] += lost
            if losses[interface] == _MOST_LOSSES:
                title, text = _NAMES[Interface(interface)], "left out, as others crash or hang"
                others = [name for other, name in left if other == interface]
                found += [Finding(title, name, Verdict.SKIPPED, text) for name in others]
                left = [(other, name) for other, name in left if other != interface]
        order = {(_NAMES[interface], name): i for i, interface in enumerate(self._interfaces) for name in CHECKS}
        return sorted(found, key=lambda finding: order[finding.interface, finding.check])

    def _alone(self, check: tuple[str, str]) -> list[Finding] | None:
        """What a check finds in a process of its own; None if that does not survive either."""
        found: list[Finding] = []
        _, lost = self._attempt([check], found)
        return None if lost else found

    def _attempt(self, checks: Sequence[tuple[str, str]], found: list[Finding]) -> tuple[int, bool]:
        """One process; how many of the checks are done with, and whether the last of them was its end."""
        lost = False
        with tempfile.TemporaryFile() as prints:
            child = subprocess.Popen(
                [sys.executable, "-m", "cosim.conformance.child"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=prints,
                start_new_session=True,
            )
            try:
                done, ended = self._listen(child, checks, found)
                if done < len(checks):
                    interface, name = checks[done]
                    text = self._account(child, ended) + _last_line(prints)
                    found.append(Finding(_NAMES[Interface(interface)], name, Verdict.PROBLEM, text))
                    done, lost = done + 1, True
                else:
                    with suppress(subprocess.TimeoutExpired):
                        child.wait(_LEAVE_SECONDS)
            finally:
                kill_group(child, "the process of a component")
                if child.stdin is not None:
                    child.stdin.close()
        return done, lost

    def _listen(
        self, child: subprocess.Popen[bytes], checks: Sequence[tuple[str, str]], found: list[Finding]
    ) -> tuple[int, bool]:
        """Take what a process says; how many checks it has ended, and whether it can say no more."""
        if child.stdin is None or child.stdout is None:
            raise AssertionError("pipes were asked for")
        with suppress(BrokenPipeError):  # it has ended already, as is read below
            child.stdin.write(json.dumps({**self._request, "checks": checks}).encode() + b"\n")
            child.stdin.flush()
        lines: queue.Queue[dict[str, Any] | None] = queue.Queue()
        threading.Thread(target=_read, args=(child.stdout, lines), daemon=True).start()
        done, patience = 0, _LONGEST_START
        while done < len(checks):
            try:
                said = lines.get(timeout=patience)
            except queue.Empty:
                return done, False
            if said is None:
                return done, True
            patience = self._deadline
            if "ends" in said:
                done += 1
            elif "verdict" in said:
                name = _NAMES[Interface(said["interface"])]
                found.append(Finding(name, said["check"], Verdict(said["verdict"]), said["text"]))
        return done, True

    def _account(self, child: subprocess.Popen[bytes], ended: bool) -> str:
        late = f"does not come to an end within {self._deadline:g} s"
        if not ended:
            return late
        try:
            code = child.wait(self._deadline)
        except subprocess.TimeoutExpired:
            return f"closes file descriptors that are not its own, and {late}"
        if code < 0:
            return f"crashes its process ({signal_name(-code)})"
        return f"ends its process (exit code {code})"


def _read(stream: IO[bytes], lines: queue.Queue[dict[str, Any] | None]) -> None:
    with stream:
        for line in stream:
            lines.put(json.loads(line))
    lines.put(None)


def _last_line(prints: IO[bytes]) -> str:
    prints.seek(0)
    text = prints.read().decode(errors="replace").strip()
    return f"; the last line that it printed: {text.splitlines()[-1]}" if text else ""
