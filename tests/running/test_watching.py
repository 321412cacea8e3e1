"""FMUs that crash, never return or wander about in the process of the run itself, through the real command line."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.results import load
from tests.components.misbehaving import ROOT, cosim, scenario
from tests.components.probe import compile_probe, description3, write_fmu

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

LOOPS = {
    "native": ("jacobi", "native"),
    "python": ("jacobi", "python"),
    "joint": ("joint", "native"),
}


def left(folder: Path, last_tick: int) -> None:
    """What was computed is there and whole, and nothing else is."""
    run = load(folder / "out")
    assert run.manifest["status"].startswith("aborted: ")
    assert run.trajectories["tick"].max() == last_tick
    assert not list((folder / "tmp").iterdir())


@pytest.mark.parametrize("loop", ["native", "python"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_crash_is_told(probes: dict[int, Path], tmp_path: Path, fmi: int, loop: str) -> None:
    text = scenario(probes[fmi], "step_crashes")
    done = cosim(
        tmp_path, "run", "net.yaml", "--out", "out", "--no-report", "--set", f"coupling.loop={loop}", text=text
    )
    assert done.returncode == 3
    said = r"error: agent bad, component probe, at t = 0\.3\d* s: crashed \(SIGSEGV\); `isolate: true` gives it"
    assert re.search(f"^{said} a process of its own$", done.stderr, re.MULTILINE), done.stderr
    assert "what components logged and printed is in out/logs" in done.stderr
    assert (tmp_path / "out" / "logs" / "output.log").read_text().splitlines()[-1] == "about to crash"
    left(tmp_path, 3)


@pytest.mark.parametrize("loop", ["native", "python"])
def test_an_fmu_that_ends_the_process(probes: dict[int, Path], tmp_path: Path, loop: str) -> None:
    """And says that all went well; one that it has forked does so before."""
    setting = ("--set", f"coupling.loop={loop}")
    done = cosim(
        tmp_path, "run", "net.yaml", "--out", "out", "--no-report", *setting, text=scenario(probes[3], "step_exits")
    )
    assert done.returncode == 3
    said = (
        r"error: agent bad, component probe, at t = 0\.3\d* s: ended the process that it runs in; `isolate: true` gives"
    )
    assert re.search(f"^{said}", done.stderr, re.MULTILINE), done.stderr
    assert (tmp_path / "out" / "logs" / "output.log").read_text().splitlines()[-1] == "about to leave"
    left(tmp_path, 3)


@pytest.mark.parametrize("loop", LOOPS)
def test_a_call_that_never_returns_ends_at_the_deadline(probes: dict[int, Path], tmp_path: Path, loop: str) -> None:
    method, kind = LOOPS[loop]
    text = scenario(probes[3], "derivative_hangs" if method == "joint" else "step_hangs", method=method)
    arguments = ("--no-report", "--step-deadline", "3 s", "--set", f"coupling.loop={kind}")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", *arguments, text=text)
    assert done.returncode == 3
    said = r"error: agent bad, component probe, at t = 0\.3\d* s: has not returned for 3 s; --step-deadline gives"
    assert re.search(f"^{said}", done.stderr, re.MULTILINE), done.stderr
    left(tmp_path, 3)


def await_text(stream: Path, text: str) -> None:
    await_true(lambda: text in stream.read_text())


def await_true(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_call_that_never_returns_can_be_stopped(
    probes: dict[int, Path], tmp_path: Path, number: signal.Signals
) -> None:
    """The first signal is told who keeps it waiting, the second one ends the run."""
    (tmp_path / "net.yaml").write_text(scenario(probes[3], "step_hangs"), encoding="utf-8")
    (tmp_path / "tmp").mkdir()
    errors = tmp_path / "errors"
    with errors.open("w") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "cosim", "run", "net.yaml", "--out", "out", "--no-report"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path / "tmp")},
            stderr=stream,
        )
    try:
        log = tmp_path / "out" / "logs" / "output.log"
        await_true(lambda: log.exists() and "going round in circles" in log.read_text())
        process.send_signal(number)
        await_text(
            errors, "stopping as soon as a call returns from agent bad, component probe; once more to stop at once"
        )
        assert process.poll() is None
        process.send_signal(number)
        assert process.wait(60) == 128 + number
    finally:
        process.kill()
        process.wait(60)
    said = errors.read_text()
    assert "interrupted at t = 0.3 s: no call returned from agent bad, component probe" in said
    assert "everything until then is in out" in said
    left(tmp_path, 3)


SLEEPY = """
from cosim.components.python import Output, Parameter, PythonComponent


class Sleepy(PythonComponent):
    until = Parameter(0.35)
    y = Output()

    def step(self, time: float, step: float) -> None:
        while time > self.until:
            print("counting sheep", flush=True)
            self.y = input() if self.until < 0.0 else 1.0
"""
NETWORK = """
period: 100 ms
duration: 1 s
agents:
  good: {components: {node: {python: "cosim.components.library:Sine"}}}
  bad: {components: {node: {python: "sleepy:Sleepy"}}}
"""


def test_python_that_never_returns_ends_at_the_deadline(tmp_path: Path) -> None:
    (tmp_path / "sleepy.py").write_text(SLEEPY, encoding="utf-8")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", "--step-deadline", "3 s", text=NETWORK)
    assert done.returncode == 3
    line = SLEEPY.splitlines().index('            print("counting sheep", flush=True)')
    said = (
        r"error: agent bad, component node, at t = 0\.3\d* s: has not returned for 3 s \(it is at (.*):(\d+)\); --step-"
    )
    found = re.search(f"^{said}", done.stderr, re.MULTILINE)
    assert found is not None, done.stderr
    assert Path(found[1]) == tmp_path / "sleepy.py"
    assert int(found[2]) - 1 in {line - 1, line, line + 1}
    left(tmp_path, 3)


def test_python_that_never_returns_can_be_stopped(tmp_path: Path) -> None:
    (tmp_path / "sleepy.py").write_text(SLEEPY, encoding="utf-8")
    (tmp_path / "net.yaml").write_text(NETWORK, encoding="utf-8")
    (tmp_path / "tmp").mkdir()
    with subprocess.Popen(
        [sys.executable, "-m", "cosim", "run", "net.yaml", "--out", "out", "--no-report"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path / "tmp")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "counting sheep\n"
        process.stdout.close()  # nobody counts along
        process.send_signal(signal.SIGINT)
        while not process.stderr.readline().startswith("stopping as soon as"):
            pass
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted at t = 0.3 s; everything until then is in out" in said
    assert "Traceback" not in said
    assert load(tmp_path / "out").manifest["status"] == "aborted: interrupted at t = 0.3 s"
    left(tmp_path, 3)


def test_a_program_that_handles_crashes_itself_is_left_alone(probes: dict[int, Path], tmp_path: Path) -> None:
    """Python's own fault handler says where, as whoever asked for it wants to know; so do virtual machines in FMUs."""
    (tmp_path / "net.yaml").write_text(scenario(probes[3], "step_crashes"), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-m", "cosim", "run", "net.yaml", "--out", "out", "--no-report"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == -signal.SIGSEGV
    assert cosim(tmp_path, "report", "out").returncode == 0  # it saves what was computed until then
    assert load(tmp_path / "out").trajectories["tick"].max() == 3


@pytest.mark.parametrize("way", [(), ("--distributed", "--workers", "1")], ids=["here", "in a worker"])
def test_an_fmu_that_changes_the_current_folder(probes: dict[int, Path], tmp_path: Path, way: tuple[str, ...]) -> None:
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", *way, text=scenario(probes[3], "step_wanders"))
    assert done.returncode == 0, done.stderr
    assert "  report                   out/report.html" in done.stdout
    assert load(tmp_path / "out").manifest["status"] == "complete"
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize(
    ("constructor", "said"),
    [
        ("exit(0)", r"ended the process that it runs in; `isolate: true`"),
        ("raise(SIGSEGV)", r"crashed \(SIGSEGV\); `isolate: true`"),
        ("for (;;) pause()", "has not returned for 3 s; --step-deadline"),
    ],
)
def test_a_library_that_does_harm_as_it_is_loaded(tmp_path: Path, constructor: str, said: str, command: str) -> None:
    source = "#include <signal.h>\n#include <stdlib.h>\n#include <unistd.h>\n"
    source += f"__attribute__((constructor)) static void load(void) {{ {constructor}; }}\n"
    write_fmu(tmp_path / "bad.fmu", compile_probe(tmp_path, source), description3())
    done = cosim(tmp_path, command, "net.yaml", "--step-deadline", "3 s", text=scenario(Path("bad.fmu"), "nothing"))
    assert done.returncode == 3
    assert re.search(rf"error: agent \w+, component probe, at t = 0 s: {said}", done.stderr), done.stderr


DESTRUCTOR = """
#include <stdlib.h>
__attribute__((destructor)) static void at_exit(void) { abort(); }
"""


@pytest.mark.parametrize(
    "command",
    [
        ("run", "net.yaml", "--out", "out", "--no-report"),
        ("run", "net.yaml", "--out", "out", "--no-report", "--distributed", "--workers", "1"),
        ("run", "net.yaml", "--out", "out", "--no-report", "--set", "templates.probe.components.probe.isolate=true"),
        ("check", "net.yaml"),
        ("fmu", "test", "ending.fmu"),
    ],
    ids=["run", "distributed", "isolated", "check", "fmu test"],
)
def test_an_fmu_that_does_not_survive_the_end_of_its_process(tmp_path: Path, command: tuple[str, ...]) -> None:
    """Its destructors run after all that matters, and some crash: the outcome stays what it was."""
    library = compile_probe(tmp_path, DESTRUCTOR)
    write_fmu(tmp_path / "ending.fmu", library, description3())
    done = cosim(tmp_path, *command, text=scenario(Path("ending.fmu"), "nothing"))
    assert done.returncode == (2 if command[0] == "fmu" else 0), done.stderr  # the probe has its problems
    assert "crash" not in done.stdout + done.stderr
    assert "SIGABRT" not in done.stdout + done.stderr
    assert not list((tmp_path / "tmp").iterdir())
