"""`on_worker_loss: restart`: a run survives the loss of any of its workers at any moment, with the same results."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from cosim.distributed import cluster
from cosim.errors import ClusterError
from network.messages import Fates, Floats
from tests.distributed.networks import Record, in_process, planned, ring, scenario
from tests.distributed.processes import (
    At,
    assert_begins,
    assert_nothing_left,
    child,
    children,
    cosim,
    harm_at_birth,
    manifest,
)

SEEDS = int(os.environ.get("COSIM_FAULT_SEEDS", "4"))
"""How many moments chance picks; the sweep before a release takes 500."""

TICKS = 200


class Told:
    """What people are told, and what the manifest says."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.restarts: list[Mapping[str, Any]] = []

    def __call__(self, text: str, restart: Mapping[str, Any] | None) -> None:
        self.lines.append(text)
        if restart is not None:
            self.restarts.append(restart)


def lossy(ticks: int = TICKS, **more: Any) -> str:
    return scenario(4, ring(4), "lossy", ticks=ticks, on_worker_loss="restart", **more)


@pytest.fixture(scope="module")
def undisturbed() -> Record:
    record, error = in_process(planned(lossy()))
    assert error is None
    return record


class Assassin:
    """Kills one to three workers at moments drawn from a seed: while they start, or when some tick is recorded.

    The first is killed before half of all ticks is recorded.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._started = time.monotonic()
        self._killed = False
        self._ticks = sorted(self._random.choices(range(TICKS // 2), k=self._random.randint(0, 2)))
        self._seconds = sorted(self._random.uniform(0, 1) for _ in range(self._random.randint(not self._ticks, 1)))

    def __call__(self) -> bool:
        """To be asked whether to stop the run: never."""
        if self._seconds and time.monotonic() - self._started > self._seconds[0] and self._kill():
            self._seconds.pop(0)
        return False

    def tick(self, tick: int, row: Floats) -> None:
        """As an observer."""
        if self._ticks and tick >= self._ticks[0]:
            self._ticks.pop(0)
            self._kill()
        if tick >= TICKS // 2 and not self._killed and self._kill():  # a run that is over sooner than it thought
            self._seconds.pop(0)

    def fates(self, fates: Fates) -> None:
        """Not needed."""

    def _kill(self) -> bool:
        workers = {name: pid for name, pid in children().items() if name.startswith("worker-")}
        if workers:
            os.kill(workers[self._random.choice(sorted(workers))], signal.SIGKILL)
            self._killed = True
        return bool(workers)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_workers_killed_at_random_moments(
    seed: int, scratch: Path, undisturbed: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cosim.distributed.assignment._WINDOW_TICKS", TICKS // 4)  # nobody is done at half of them
    record, told, assassin = Record(), Told(), Assassin(seed)
    cluster.run(planned(lossy()), 3, [record, assassin], assassin, tell=told)
    assert record == undisturbed
    assert told.restarts
    assert_nothing_left(scratch)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_worker_lost_before_it_has_joined(
    number: signal.Signals, scratch: Path, undisturbed: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    harm_at_birth(monkeypatch, "worker-2", number)
    record, told = Record(), Told()
    cluster.run(planned(lossy()), 3, [record], tell=told)
    assert record == undisturbed
    assert [entry["replaced_by"] for entry in told.restarts] == ["worker-2.2"]
    assert_nothing_left(scratch)


def test_several_workers_lost_at_once_and_again_while_they_catch_up(scratch: Path, undisturbed: Record) -> None:
    record, told = Record(), Told()

    def kill_all() -> None:
        for name in ("worker-1", "worker-2", "worker-3"):
            os.kill(child(name), signal.SIGKILL)

    def kill_again(text: str, restart: Mapping[str, Any] | None) -> None:
        told(text, restart)
        if restart is not None and restart["replaced_by"] == "worker-2.2":
            os.kill(child("worker-2.2"), signal.SIGKILL)

    cluster.run(planned(lossy()), 3, [record, At(TICKS // 2, kill_all)], tell=kill_again)
    assert record == undisturbed
    assert {"worker-1.2", "worker-2.2", "worker-2.3", "worker-3.2"} <= {entry["replaced_by"] for entry in told.restarts}
    assert_nothing_left(scratch)


@pytest.mark.parametrize("tick", [0, TICKS - 1])
def test_worker_lost_in_the_first_and_last_ticks(tick: int, scratch: Path, undisturbed: Record) -> None:
    record = Record()
    cluster.run(planned(lossy()), 2, [record, At(tick, lambda: os.kill(child("worker-1"), signal.SIGKILL))])
    assert record == undisturbed
    assert_nothing_left(scratch)


@pytest.mark.parametrize("fault", ["Stopped", "Hanging", "Exiting"])
def test_worker_that_does_not_go_on_once(
    fault: str, scratch: Path, undisturbed: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The component looks for a file, and leaves one: its fault happens once."""
    monkeypatch.setenv("COSIM_TEST_FOLDER", str(scratch))
    text = lossy(faults={2: (f"Once{fault}", 10.05)})
    record, told = Record(), Told()
    cluster.run(planned(text), 2, [record], tell=told, step_deadline=5.0)
    assert record == undisturbed
    assert len(told.restarts) == 1
    assert told.restarts[0] | {"why": ""} == {
        "worker": "worker-1",
        "replaced_by": "worker-1.2",
        "why": "",
        "tick": 100,
    }
    assert "while it advanced agent 2, component node; worker-1.2 takes its place" in told.lines[0]
    assert told.lines[-1].startswith("worker-1.2 (agents 1, 2) has caught up at tick 10")
    assert_nothing_left(scratch)


def test_component_that_always_kills_its_process_is_given_up(scratch: Path, undisturbed: Record) -> None:
    record, told = Record(), Told()
    with pytest.raises(ClusterError) as caught:
        cluster.run(planned(lossy(faults={3: ("Killed", 3.05)})), 2, [record], tell=told)
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("worker-2.2 (agents 3, 4) was killed by signal 9 ")
    assert lines[0].endswith("at tick 30 (t = 3 s), while it advanced agent 3, component node")
    assert lines[1] == "  worker-2.2 was lost twice at tick 30: it is not replaced again"
    assert len(told.restarts) == 1
    assert len(record.ticks) > 1
    assert_begins(record, undisturbed)
    assert_nothing_left(scratch)


def test_loss_of_the_emulator_ends_the_run(scratch: Path, undisturbed: Record) -> None:
    record = Record()
    with pytest.raises(ClusterError, match=r"^the emulator was killed by signal 9 "):
        cluster.run(planned(lossy()), 2, [record, At(20, lambda: os.kill(child("emulator"), signal.SIGKILL))])
    assert_begins(record, undisturbed)
    assert_nothing_left(scratch)


def test_command_line_and_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSIM_TEST_FOLDER", str(tmp_path))
    (tmp_path / "net.yaml").write_text(scenario(4, ring(4), ticks=60, faults={1: ("OnceExiting", 3.05)}))
    (tmp_path / "plain.yaml").write_text(scenario(4, ring(4), ticks=60))
    across = cosim(tmp_path, "net.yaml", "--distributed", "--on-worker-loss", "restart", "--out", "a", "--workers", "2")
    assert across.returncode == 0, across.stderr
    assert (
        "worker-1 (agents 1, 2) ended with exit code 7 at tick 30 (t = 3 s), while it advanced agent 1, component node"
        in (across.stderr)
    )
    assert "worker-1.2 (agents 1, 2) has caught up at tick " in across.stderr
    assert cosim(tmp_path, "plain.yaml", "--out", "b").returncode == 0
    one, other = manifest(tmp_path / "a"), manifest(tmp_path / "b")
    assert (one["status"], one["digest"]) == ("complete", other["digest"])
    assert one["distributed"]["restarts"] == [
        {"worker": "worker-1", "replaced_by": "worker-1.2", "why": "ended with exit code 7", "tick": 30}
    ]
    assert_nothing_left(tmp_path)
