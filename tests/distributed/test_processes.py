"""Distributed runs as people start them: real processes over Zenoh; their results, their faults, what they leave."""

from __future__ import annotations

import gc
import os
import re
import signal
import stat
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cosim.distributed import cluster
from cosim.distributed.processes import Processes
from cosim.errors import ClusterError
from cosim.running.inline import Interrupted
from cosim.scratch import Scratch, place_for_socket
from network.zenoh import ZenohHub
from tests.distributed.networks import Record, in_process, planned, ring, scenario
from tests.distributed.processes import (
    At,
    assert_begins,
    assert_nothing_left,
    child,
    command,
    cosim,
    environment,
    manifest,
)


def assert_begins_on_disk(folder: Path, text: str, said: str) -> None:
    """The run folder of an orchestrator that was killed is readable by anybody, and the user has been told."""
    status = manifest(folder)["status"]
    pattern = r"aborted: the process that recorded it was killed(; recorded until t = \S+ s| before the first tick)"
    assert re.fullmatch(pattern, status)
    assert f"{status.removeprefix('aborted: ')}; everything until then is in {folder}" in said
    assert not list(folder.glob(".*"))
    rows, fates = (pq.read_table(folder / f"{name}.parquet") for name in ("trajectories", "deliveries"))
    plan = planned(text)
    n_ticks = len(rows) // len(plan.agents)
    whole, _ = in_process(replace(plan, ticks=max(1, n_ticks)))
    values = np.stack([rows.column(f"node.x[{i}]").to_numpy() for i in (1, 2)], axis=1)
    assert values.tobytes() == b"".join(row for _, row in whole.ticks[:n_ticks])
    known = [stamp for fates_of in whole.fates_of[:n_ticks] for stamp in fates_of["stamp"]][: len(fates)]
    assert fates.column("stamp").to_pylist() == known
    assert manifest(folder)["ticks"]["done"] == max(0, n_ticks - 1)


# --- results ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("config", "workers"),
    [
        ("channel_sine", "1"),
        ("paper_known_velocity", "2"),
        ("paper_leaderless", "3"),
        ("paper_leaders", None),
        ("paper_leaders", "per-agent"),
    ],
)
def test_digest_is_that_of_the_in_process_run(config: str, workers: str | None, tmp_path: Path) -> None:
    how = ["--distributed", *(["--workers", workers] if workers else [])]
    across = cosim(tmp_path, config, *how, "--until", "1 s", "--out", "across")
    assert across.returncode == 0, across.stderr
    plain = cosim(tmp_path, config, "--until", "1 s", "--out", "plain")
    assert plain.returncode == 0, plain.stderr
    digest = manifest(tmp_path / "plain")["digest"]
    assert manifest(tmp_path / "across")["digest"] == digest
    assert manifest(tmp_path / "across")["status"] == "complete"
    assert digest in across.stdout
    assert across.stdout.splitlines()[1:-1] == plain.stdout.splitlines()[1:-1]
    assert_nothing_left(tmp_path)


def test_workers_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(5, ring(5)) + "workers: {lab-a: '5, 1, 3', lab-b: '2, 4'}\n")
    across = cosim(tmp_path, "net.yaml", "--distributed", "--out", "across")
    assert across.returncode == 0, across.stderr
    plain = cosim(tmp_path, "net.yaml", "--out", "plain")
    again = cosim(tmp_path, "across/scenario.yaml", "--distributed", "--workers", "3", "--out", "again")
    assert plain.returncode == again.returncode == 0
    assert {manifest(tmp_path / name)["digest"] for name in ("across", "plain", "again")} == {
        manifest(tmp_path / "plain")["digest"]
    }
    assert manifest(tmp_path / "across")["distributed"] == {"workers": 2}
    assert manifest(tmp_path / "again")["distributed"] == {"workers": 3}
    assert_nothing_left(tmp_path)


def test_longer_than_a_window_of_grants(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.distributed.assignment._WINDOW_TICKS", 8)
    plan = planned(scenario(4, ring(4), "slack", ticks=300))
    expected, _ = in_process(plan)
    record = Record()
    cluster.run(plan, 2, [record])
    assert record == expected
    assert_nothing_left(scratch)


def test_component_that_fails_ends_the_run_as_in_process(tmp_path: Path) -> None:
    text = scenario(5, ring(5), "slack", faults={3: ("Failing", 0.55), 4: ("Failing", 0.55)})
    (tmp_path / "net.yaml").write_text(text)
    plain = cosim(tmp_path, "net.yaml", "--out", "plain", "--quiet")
    across = cosim(tmp_path, "net.yaml", "--out", "across", "--distributed", "--workers", "3", "--quiet")
    assert plain.returncode == across.returncode == 3
    assert across.stderr == plain.stderr.replace("plain", "across")
    assert "agent 3, component node, at t = 0.5" in across.stderr
    one, other = manifest(tmp_path / "plain"), manifest(tmp_path / "across")
    assert (one["status"], one["digest"], one["ticks"]) == (other["status"], other["digest"], other["ticks"])
    assert_nothing_left(tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_leaves_a_readable_run_folder(number: signal.Signals, tmp_path: Path) -> None:
    with subprocess.Popen(
        command("paper_leaders", "--distributed", "--until", "10 h", "--out", "long"),
        cwd=tmp_path,
        env=environment(tmp_path),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        process_group=0,
    ) as run:
        assert run.stderr is not None
        shown = run.stderr.readline()
        assert "s simulated" in shown
        os.killpg(run.pid, number) if number is signal.SIGINT else run.send_signal(number)  # as a terminal does
        _, error = run.communicate(timeout=60)
    assert run.returncode == 128 + number
    assert "interrupted at t = " in error
    assert "Traceback" not in error
    content = manifest(tmp_path / "long")
    assert content["status"].startswith("aborted: interrupted at t = ")
    assert_nothing_left(tmp_path)


def test_request_to_stop_is_heard_while_nothing_moves(scratch: Path) -> None:
    plan = planned(scenario(3, ring(3), faults={2: ("Hanging", 0.35)}))
    asked = count()
    with pytest.raises(Interrupted):
        cluster.run(plan, 2, [Record()], lambda: next(asked) > 200)  # well after the first ticks
    assert_nothing_left(scratch)


# --- faults -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("tick", "channel"), [(0, "ideal"), (3, "slack"), (7, "late")])
def test_worker_that_is_killed(tick: int, channel: str, scratch: Path) -> None:
    faults = {3: ("Killed", tick / 10 + 0.05)}
    plan = planned(scenario(4, ring(4), channel, faults=faults))
    expected, _ = in_process(planned(scenario(4, ring(4), channel)))
    record = Record()
    with pytest.raises(ClusterError) as caught:
        cluster.run(plan, 2, [record])
    said = re.fullmatch(
        r"worker-2 \(agents 3, 4\) was killed by signal 9 \(SIGKILL, as the system does when memory runs out\) "
        rf"at tick {tick} \(t = {tick / 10:g} s\), while it advanced agent 3, component node\n"
        r"  the emulator waits for the samples of tick (\d+) from worker-2 \(agents 3, 4\)\n"
        r"  worker-1 \(agents 1, 2\) waits for the mail of tick (\d+) from the emulator",
        str(caught.value),
    )
    assert said is not None, str(caught.value)
    assert int(said[1]) <= tick + 1 <= int(said[2])  # what it had just sent may have died with it
    assert_begins(record, expected)
    assert_nothing_left(scratch)


@pytest.mark.parametrize("name", ["emulator", "worker-1", "worker-2"])
def test_process_that_is_killed_from_outside_at_any_moment(name: str, scratch: Path) -> None:
    plan = planned(scenario(4, ring(4), "slack", ticks=20_000))
    record = Record()
    with pytest.raises(ClusterError, match=rf"^(the )?{name} .*was killed by signal 9 .* at tick \d+ ") as caught:
        cluster.run(plan, 2, [record, At(100, lambda: os.kill(child(name), signal.SIGKILL))])
    assert str(caught.value).count(" wait") == (1 if name == "emulator" else 2), str(caught.value)
    expected, _ = in_process(planned(scenario(4, ring(4), "slack", ticks=len(record.ticks))))
    assert len(record.ticks) > 100
    assert_begins(Record(record.ticks, [], []), Record(expected.ticks, [], []))
    assert_nothing_left(scratch)


@pytest.mark.parametrize(
    ("fault", "deadline", "said"),
    [
        ("Hanging", 5.0, "did not get further for 5 s"),
        ("Stopped", 5.0, "is stopped by signal 19 (SIGSTOP)"),
        ("Stopped", 60.0, "is stopped by signal 19 (SIGSTOP)"),
        ("Exiting", 60.0, "ended with exit code 7"),
    ],
)
def test_worker_that_does_not_go_on(fault: str, deadline: float, said: str, scratch: Path) -> None:
    plan = planned(scenario(3, ring(3), "slack", faults={2: (fault, 0.45)}))
    expected, _ = in_process(planned(scenario(3, ring(3), "slack")))
    record = Record()
    with pytest.raises(ClusterError) as caught:
        cluster.run(plan, 3, [record], step_deadline=deadline)
    found = re.fullmatch(
        rf"worker-2 \(agent 2\) {re.escape(said)} at tick 4 \(t = 0.4 s\), while it advanced agent 2, component node\n"
        r"  the emulator waits for the samples of tick \d from worker-2 \(agent 2\)\n"
        r"  worker-1 \(agent 1\) and worker-3 \(agent 3\) wait for the mail of tick \d from the emulator",
        str(caught.value),
    )
    assert found is not None, str(caught.value)
    assert_begins(record, expected)
    assert_nothing_left(scratch)


def test_fault_on_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), faults={1: ("Killed", 0.45)}))
    done = cosim(tmp_path, "net.yaml", "--distributed", "--out", "out", "--workers", "3")
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert "error: worker-1 (agent 1) was killed by signal 9 " in done.stderr
    assert "everything until then is in out" in done.stderr
    assert manifest(tmp_path / "out")["status"].startswith("aborted: worker-1 (agent 1) was killed by signal 9 ")
    assert_nothing_left(tmp_path)


@pytest.mark.parametrize("others", [{}, {3: ("Hanging", 0.05)}], ids=["waiting", "one hangs"])
def test_orchestrator_that_is_killed_takes_all_with_it(others: dict[int, tuple[str, float]], tmp_path: Path) -> None:
    text = scenario(3, ring(3), "late", ticks=50, faults={1: ("OrphanMaker", 0.25), **others})
    (tmp_path / "net.yaml").write_text(text)
    done = cosim(tmp_path, "net.yaml", "--distributed", "--out", "out", "--workers", "3")
    assert done.returncode == -signal.SIGKILL
    assert "Traceback" not in done.stderr
    assert_nothing_left(tmp_path)
    assert_begins_on_disk(tmp_path / "out", scenario(3, ring(3), "late", ticks=50), done.stderr)


@pytest.mark.parametrize("tick", [53, 271])
def test_orchestrator_that_is_killed_from_outside_leaves_all_it_had(tick: int, tmp_path: Path) -> None:
    text = scenario(4, ring(4), "slack", ticks=20_000)
    (tmp_path / "net.yaml").write_text(text)
    run = f"""
import os, pathlib, signal, sys
from cosim import cli
from cosim.recording.recorder import Recorder
record = Recorder._take_rows
def kill(self, rows, *before):
    record(self, rows, *before)
    if self._kept > {tick}:
        pathlib.Path("kept").write_text(str(self._kept))
        os.kill(os.getpid(), signal.SIGKILL)
Recorder._take_rows = kill
cli.main(["run", "net.yaml", "--distributed", "--workers", "2", "--out", "out", "--no-report", "--quiet"])
"""
    done = subprocess.run(
        [sys.executable, "-c", run],
        cwd=tmp_path,
        env=environment(tmp_path),
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert_nothing_left(tmp_path)
    assert pq.read_table(tmp_path / "out" / "trajectories.parquet").num_rows == 4 * int((tmp_path / "kept").read_text())
    assert_begins_on_disk(tmp_path / "out", text, done.stderr)


# --- arguments --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--distributed", "--workers", "0"], "--workers 0: write a number from 1, or 'per-agent'"),
        (["--distributed", "--workers", "many"], "--workers many: write a number from 1, or 'per-agent'"),
        (["--workers", "2"], "--workers is for runs across processes; add --distributed"),
        (["--distributed", "--step-deadline", "soon"], "'soon' is not a time"),
        (["--distributed", "--step-deadline", "0 s"], "'0 s' leaves no time"),
    ],
)
def test_mistakes_are_said_before_anything_starts(arguments: list[str], said: str, tmp_path: Path) -> None:
    done = cosim(tmp_path, "paper_leaders", *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert not (tmp_path / "runs").exists()


# --- ends -------------------------------------------------------------------------------------------------------------
def test_process_that_does_not_die_is_left_behind_with_a_word(
    scratch: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """One that waits for a disk takes no signal until that answers; here the signal is withheld."""
    monkeypatch.setattr("cosim.spawning._DEATH_SECONDS", 0.01)
    monkeypatch.setattr(subprocess.Popen, "kill", lambda _: None)
    folder = scratch / "run"
    folder.mkdir()
    with Processes("run", f"unixsock-stream/{folder}/hub", folder) as processes:
        processes.start(["worker-1"])
        process = processes._running["worker-1"]
    assert f"warning: worker-1 (process {process.pid}) was killed, but has not ended within 0.01 s" in (
        capfd.readouterr().err
    )
    process.wait(60)  # it saw its standard input end


# --- the socket of the run --------------------------------------------------------------------------------------------
LONG = "l" * 115


@pytest.mark.parametrize("killed", [False, True], ids=["complete", "orchestrator killed"])
def test_temporary_folder_whose_name_is_too_long_for_a_socket(killed: bool, tmp_path: Path) -> None:
    faults = {1: ("OrphanMaker", 0.25)} if killed else {}
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), faults=faults))
    (tmp_path / LONG).mkdir()
    before = set(Path("/tmp").glob("cosim-*"))
    done = subprocess.run(
        command("net.yaml", "--distributed", "--workers", "2", "--out", "out"),
        cwd=tmp_path,
        env=environment(tmp_path / LONG),
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == (-signal.SIGKILL if killed else 0), done.stderr
    assert manifest(tmp_path / "out")["status"].startswith("aborted: " if killed else "complete")
    assert_nothing_left(tmp_path / LONG)
    left = [path for path in set(Path("/tmp").glob("cosim-*")) - before if (path / "hub").exists()]
    lines = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    assert [path for path in left if not any(str(path).encode() in line for line in lines)] == []  # of other runs


def test_folders_of_a_run_are_for_its_user_alone(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(scratch / LONG))
    (scratch / LONG).mkdir()
    with Scratch() as folder, place_for_socket(folder) as socket:
        assert len(os.fsencode(socket)) < 100
        assert {stat.S_IMODE(path.stat().st_mode) for path in (folder, socket.parent)} == {0o700}
    assert not socket.parent.exists()
    assert_nothing_left(scratch / LONG)


def test_emulator_that_cannot_listen(
    scratch: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "place_for_socket", lambda _: nullcontext(scratch / "not there" / "hub"))
    with pytest.raises(ClusterError, match=r"^the emulator could not join the run \(it says why above\) before"):
        cluster.run(planned(scenario(3, ring(3))), 2, [Record()])
    assert "error: emulator cannot join the run: emulator: cannot listen at unixsock-stream/" in capfd.readouterr().err
    assert_nothing_left(scratch)


def test_session_of_the_orchestrator_that_breaks(scratch: Path) -> None:
    """As Zenoh closes it where it cannot go on."""

    def breaks() -> None:
        (hub,) = [thing for thing in gc.get_objects() if isinstance(thing, ZenohHub) and not thing._closed]
        hub._session.close()  # type: ignore[no-untyped-call]

    record = Record()
    with pytest.raises(ClusterError, match=r"^orchestrator cannot .*; tick \d+ is the last one recorded$"):
        cluster.run(planned(scenario(3, ring(3), "slack", ticks=20_000)), 2, [record, At(20, breaks)])
    assert len(record.ticks) > 20
    assert_nothing_left(scratch)
