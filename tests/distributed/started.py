"""Commands that run side by side, as people start them in several terminals or on several hosts."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
PATIENCE = 90.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Started:
    """A `cosim` command that goes on.

    Attributes:
        said: lines on standard error that have been read.
    """

    def __init__(self, folder: Path, *arguments: str, prefix: Sequence[str] = (), **environment: str) -> None:
        folder.mkdir(exist_ok=True)
        temporary = folder / "tmp"  # where all temporary files go, so that what is left behind is seen
        temporary.mkdir(exist_ok=True)
        self.folder = folder
        self.said: list[str] = []
        self.process = subprocess.Popen(
            [*prefix, sys.executable, "-m", "cosim", *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary), **environment},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def hear(self, text: str) -> str:
        """Wait for a line on standard error that has this in it."""
        assert self.process.stderr is not None
        while line := self.process.stderr.readline():
            self.said.append(line.rstrip("\n"))
            if text in line:
                return self.said[-1]
        raise AssertionError(f"it ended without saying {text!r}: {self.said}")

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self) -> tuple[int, str, str]:
        """Wait for its end: exit code, output, and all of standard error. It leaves nothing behind."""
        output, rest = self.process.communicate(timeout=PATIENCE)
        said = "\n".join([*self.said, rest])
        assert "Traceback" not in said, said
        assert list((self.folder / "tmp").iterdir()) == []
        return self.process.returncode, output, said

    def succeed(self) -> str:
        """Wait for its end, which must be a good one; its output."""
        code, output, said = self.end()
        assert code == 0, said
        return output


@contextmanager
def started(folder: Path, *arguments: str, prefix: Sequence[str] = (), **environment: str) -> Iterator[Started]:
    """Start a command; it does not outlive the `with`."""
    command = Started(folder, *arguments, prefix=prefix, **environment)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.kill()
        command.process.communicate()
