"""What FMUs log and print: in the run folder, not on the screen, and never more than a disk or a memory can take."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from time import sleep

import pytest

from cosim.logs import LIMIT, Logs
from cosim.native_output import captured
from tests.components.misbehaving import cosim, scenario

WAYS = {"in one process": (), "across processes": ("--distributed", "--workers", "2")}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("fmi", [2, 3])
def test_what_an_fmu_prints_goes_to_the_run_folder(probes: dict[int, Path], tmp_path: Path, fmi: int, way: str) -> None:
    done = cosim(
        tmp_path,
        "run",
        "net.yaml",
        "--out",
        "out",
        "--no-report",
        *WAYS[way],
        text=scenario(probes[fmi], "step_prints"),
    )
    assert done.returncode == 0, done.stderr
    assert "the probe" not in done.stdout + done.stderr
    name = "output" if way == "in one process" else "worker-2.output"
    (file,) = (tmp_path / "out" / "logs").iterdir()
    assert file.name == f"{name}.log"
    lines = file.read_text().splitlines()
    assert lines.count("the probe printed at t = 0.36") == 1
    assert lines.count("the probe complained") == 64


def test_what_an_fmu_prints_while_it_is_checked(probes: dict[int, Path], tmp_path: Path) -> None:
    """Shown only where it refuses: that may be all that it says."""
    quiet = cosim(tmp_path, "check", "net.yaml", text=scenario(probes[2], "nothing", fmi_label="talks"))
    assert quiet.returncode == 0
    assert "the probe talks" not in quiet.stdout + quiet.stderr
    refused = cosim(tmp_path, "check", "net.yaml", text=scenario(probes[2], "nothing", fmi_label="refuses"))
    assert refused.returncode == 3
    assert refused.stderr.startswith("the probe talks\nerror: agent bad, component probe")


@pytest.mark.parametrize("fmi", [2, 3])
def test_what_an_fmu_logs_goes_to_the_run_folder(probes: dict[int, Path], tmp_path: Path, fmi: int) -> None:
    text = scenario(probes[fmi], "step_error")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", text=text)
    assert done.returncode == 3
    assert "agent bad, component probe, at t = 0 s" in done.stderr
    log = (tmp_path / "out" / "logs" / "bad.probe.log").read_text()
    assert log == "[Error] the probe gives up at t = 0\n"


@pytest.mark.parametrize(("way", "fmi"), [("in one process", 3), ("across processes", 2)])
def test_an_fmu_that_logs_a_gigabyte(probes: dict[int, Path], tmp_path: Path, way: str, fmi: int) -> None:
    """At one step of 1 s: 1 GiB to the log, a quarter of it to standard output."""
    text = scenario(probes[fmi], "step_floods").replace("step: 10 ms", "step: 500 ms").replace("100 ms", "500 ms")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", *WAYS[way], text=text, measured=True)
    assert done.returncode == 0, done.stderr
    logs = tmp_path / "out" / "logs"
    sizes = {file.name: file.stat().st_size for file in logs.iterdir()}
    output = "output" if way == "in one process" else "worker-2.output"
    assert set(sizes) == {f"{name}{end}.log" for name in ("bad.probe", output) for end in ("", ".1")}
    assert max(sizes.values()) <= LIMIT
    assert (logs / "bad.probe.log").read_text().endswith("\n[Warning] the last line\n")
    assert (logs / f"{output}.log").read_text().endswith("\nthe last line\n")
    assert int((tmp_path / "largest").read_text()) < 500_000  # kB


def test_a_disk_that_stalls_costs_no_line(capfd: pytest.CaptureFixture[str]) -> None:
    taken: list[bytes] = []

    def stalls(data: bytes) -> None:
        sleep(2.5)
        taken.append(data)

    with captured(stalls):
        os.write(1, b"the last line\n")
    assert taken == [b"the last line\n"]
    assert capfd.readouterr() == ("", "")


def test_a_disk_that_never_answers_is_told(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("cosim.native_output._DRAIN_SECONDS", 0.01)
    answers = threading.Event()
    with captured(lambda _: answers.wait(60) and None):
        os.write(1, b"the last line\n")
    answers.set()
    assert capfd.readouterr().err == (
        "warning: what FMUs printed last is lost: it could not be written within 0.01 s\n"
    )


def test_who_goes_on_printing_is_not_waited_for() -> None:
    """A process that an FMU started, and that outlives it."""
    taken: list[bytes] = []
    with captured(taken.append):
        process = subprocess.Popen(["sh", "-c", "echo begins; exec cat"], stdin=subprocess.PIPE, text=True)
        os.write(2, b"the last line\n")
    assert process.poll() is None
    assert b"the last line\n" in b"".join(taken)
    process.communicate("still there", timeout=60)
    assert process.returncode == 0


def test_more_files_than_are_kept_open(tmp_path: Path) -> None:
    with Logs(tmp_path) as logs:
        for turn in range(2):
            for i in range(200):
                logs.sink(str(i))(b"%d\n" % turn)
    assert {file.read_text() for file in tmp_path.iterdir()} == {"0\n1\n"}
    assert len(list(tmp_path.iterdir())) == 200


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_a_full_disk_costs_the_log_not_the_run(tmp_path: Path) -> None:
    (tmp_path / "x.log").symlink_to("/dev/full")
    with Logs(tmp_path) as logs:
        logs.sink("x")(b"some text")


@pytest.mark.parametrize("isolate", ["", ", isolate: true", ", inputs: {u: Int32_in}"])
def test_the_tolerance_that_a_scenario_gives_reaches_the_fmu(
    probes: dict[int, Path], tmp_path: Path, isolate: str
) -> None:
    text = scenario(probes[3], "nothing", isolate=f", tolerance: 1.0e-9{isolate}")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", text=text)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out/logs/bad.probe.log").read_text() == "[Warning] told the tolerance 1e-09\n"
    assert "tolerance: 1.0e-09" in (tmp_path / "out/scenario.yaml").read_text()
