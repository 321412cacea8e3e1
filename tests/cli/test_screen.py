"""Where nobody reads what a command prints: a terminal that is closed, a pipe that is, streams that never were."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cosim import results

ROOT = Path(__file__).parents[2]
COSIM = [sys.executable, "-m", "cosim"]

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="terminals and pipes of POSIX")


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.mark.parametrize("way", [(), ("--distributed", "--workers", "2")], ids=["here", "distributed"])
@pytest.mark.parametrize("ignores", [False, True], ids=["", "nohup"])
def test_a_terminal_that_is_closed(way: tuple[str, ...], ignores: bool, tmp_path: Path) -> None:
    """The run is stopped in good order; with `nohup` it goes on."""
    import pty
    import termios

    duration = "6 s" if ignores else "10 h"
    run = [*COSIM, "run", "paper_leaders", "--realtime", "5", "--until", duration, "--out", "run", "--no-report", *way]
    code = f"import os, signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\nos.execvp({run[0]!r}, {run!r})"
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(tmp_path)
        command = [sys.executable, "-c", code] if ignores else run
        os.execvpe(command[0], command, environment())
    termios.tcsetwinsize(terminal, (24, 100))
    shown = b""
    while not re.search(rb"[1-9]\.\d s simulated", shown):  # the bar
        shown += os.read(terminal, 1000)
    os.close(terminal)
    _, status = ended(process)
    content = json.loads((tmp_path / "run" / "manifest.json").read_text())
    if ignores:
        assert os.waitstatus_to_exitcode(status) == 0
        assert content["status"] == "complete"
    else:
        assert os.waitstatus_to_exitcode(status) == 128 + signal.SIGHUP
        assert content["status"].startswith("aborted: interrupted at t = ")
    assert len(results.load(tmp_path / "run").array("plant.p")) == content["ticks"]["done"] + 1 > 1


def ended(process: int) -> tuple[int, int]:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        found = os.waitpid(process, os.WNOHANG)
        if found[0]:
            return found
        time.sleep(0.02)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    pytest.fail("it goes on without its terminal")


def test_a_reader_that_has_gone_still_gets_the_report(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        run = [*COSIM, "run", "channel_sine", "--until", "2 s", "--out", "run"]
        done = subprocess.run(
            run,
            cwd=tmp_path,
            env=environment(),
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "run" / "report.html").exists()


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_streams_that_are_closed(closed: str, tmp_path: Path) -> None:
    def cosim(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = ["/bin/sh", "-c", f'exec "$@" {closed}', "sh", *COSIM, *arguments]
        return subprocess.run(
            command, cwd=tmp_path, env=environment(), text=True, capture_output=True, timeout=120, check=False
        )

    done = cosim("run", "channel_sine", "--until", "2 s", "--out", "run", "--no-report")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["status"] == "complete"
    wrong = cosim("run", "nothing.yaml")
    assert wrong.returncode == 2
    assert "Traceback" not in wrong.stderr
