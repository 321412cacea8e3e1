"""Real processes of a run, for tests: the command, what it left behind, and one of its children by name."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from cosim.distributed.processes import Processes
from network.messages import Fates, Floats
from tests.distributed.networks import Record

ROOT = Path(__file__).parents[2]
PATIENCE = 10.0  # s; used up only by a test that fails


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "cosim", "run", *arguments, "--no-report"]


def environment(folder: Path) -> dict[str, str]:
    """All temporary files go to `folder`, so that what is left behind is seen."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder)}


def cosim(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Returns when the command, and all that it started, are gone: they share its output."""
    return subprocess.run(
        command(*arguments),
        cwd=folder,
        env=environment(folder),
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )


def manifest(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return content


def assert_nothing_left(folder: Path) -> None:
    """No temporary folder or socket, and no process that was told of one."""
    assert list(folder.glob("cosim-*")) == []
    lines = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    assert [line for line in lines if b"_process" in line and str(folder).encode() in line] == []


def children() -> dict[str, int]:
    """The processes of runs that this one started and that live, by their names."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = (path / "cmdline").read_bytes().split(b"\0")
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if parent == os.getpid() and b"_process" in words:
            found[words[words.index(b"_process") + 1].decode()] = int(path.name)
    return found


def child(name: str) -> int:
    """The process of that name among those that this one started."""
    deadline = time.monotonic() + PATIENCE
    while (known := children()).get(name) is None:  # one that has just been started may not bear its name yet
        if time.monotonic() > deadline:
            raise LookupError(f"{name} is not among {', '.join(known)}")
        time.sleep(0.01)
    return known[name]


def harm_at_birth(monkeypatch: pytest.MonkeyPatch, name: str, number: signal.Signals) -> None:
    """A process of the runs to come gets a signal as soon as it is started, the first one of that name."""
    start, harmed = Processes.start, []

    def harming(self: Processes, names: Iterable[str]) -> None:
        start(self, names)
        if not harmed:
            harmed.append(name)
            os.kill(child(name), number)

    monkeypatch.setattr(Processes, "start", harming)


class At:
    """An observer that does something when a tick is recorded."""

    def __init__(self, tick: int, act: Callable[[], object]) -> None:
        self._tick = tick
        self._act = act

    def tick(self, tick: int, rows: Sequence[Floats]) -> None:
        if tick == self._tick:
            self._act()

    def fates(self, fates: Fates) -> None:
        pass


def assert_begins(record: Record, whole: Record) -> None:
    """All that was recorded is what the in-process run records."""
    assert record.calls == whole.calls[: len(record.calls)]
    assert record.ticks == whole.ticks[: len(record.ticks)]
    assert record.fates_of == whole.fates_of[: len(record.fates_of)]
