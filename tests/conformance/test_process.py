"""`cosim fmu test` leaves no process behind, however it ends."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LONGEST = 60.0
COMMAND = [sys.executable, "-m", "cosim", "fmu", "test", "tests.conformance.components:Staying", "--deadline", "1 h"]


@contextmanager
def trying(tmp_path: Path, *prefix: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """The command while its component hangs, and a descriptor that ends with all that it has started."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "STAYING": str(fifo), "TMPDIR": str(tmp_path)}
    descriptor = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    pids: list[int] = []
    with subprocess.Popen([*prefix, *COMMAND], cwd=tmp_path, env=environment) as command:
        try:
            pids += map(int, read(descriptor).split())
            yield command, descriptor
        finally:
            os.close(descriptor)
            for pid in (command.pid, *pids):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


def read(descriptor: int) -> bytes:
    """What comes next; nothing at the end."""
    assert select.select([descriptor], [], [], LONGEST)[0], "nothing came, not even the end"
    return os.read(descriptor, 100)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_whatever_ends_it_ends_what_it_started(number: signal.Signals, tmp_path: Path) -> None:
    with trying(tmp_path) as (command, descriptor):
        command.send_signal(number)
        assert read(descriptor) == b""
        code = command.wait(LONGEST)
    assert code == (-number if number == signal.SIGKILL else 128 + number)
    assert [*tmp_path.iterdir()] == [tmp_path / "fifo"]


def test_nohup(tmp_path: Path) -> None:
    with trying(tmp_path, "sh", "-c", 'trap "" HUP; exec "$@"', "sh") as (command, descriptor):
        command.send_signal(signal.SIGHUP)
        command.send_signal(signal.SIGTERM)
        assert read(descriptor) == b""
        assert command.wait(LONGEST) == 128 + signal.SIGTERM
