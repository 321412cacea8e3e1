"""A bridge and a program in another process, over real Zenoh sessions; and the same run again without that program."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cosim.bridge import Taken
from cosim.bridge.live import Live
from cosim.cli import main
from cosim.errors import ConfigError
from cosim.plan import Plan
from network.plain import PlainKeys
from tests.bridge.labs import TICKS, outside, planned, play, refuse_nothing, replayed, scenario, until
from tests.distributed.started import free_port

PYTHON_LOOP = "coupling.loop=python"
JACOBI = "{method: jacobi, step: 5 ms}"


def endpoint(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path / 'bridge'}"


@contextmanager
def heard(live: Live, tmp_path: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    """The other program, once the run knows that it listens to the first two arms: what is said before is lost."""
    with outside(endpoint(tmp_path), "1,2", *more) as process:
        until(lambda: all(publisher.matching_status.matching for publisher in live._keys._publishers[:2]))
        yield process


class Answered:
    """Takes at every tick what the outside has answered to that very tick, for as many ticks as are wanted."""

    def __init__(self, live: Live, ticks: int = TICKS) -> None:
        self._live = live
        self._ticks = ticks

    def __call__(self, tick: int) -> Taken:
        taken: dict[int, np.ndarray] = {}
        if tick < self._ticks:
            until(lambda: taken.update(self._live.take(tick)) or len(taken) == 2)
        return taken


def closed_loop(plan: Plan, tmp_path: Path, out: Path, *, workers: int | None = None) -> str:
    with Live(plan, refuse_nothing) as live, heard(live, tmp_path):
        return play(plan, out, live, workers=workers, take=Answered(live))


@pytest.mark.parametrize("coupling", ["{method: joint, step: 5 ms}", JACOBI])
def test_a_run_and_its_replays(tmp_path: Path, coupling: str) -> None:
    plan = planned(tmp_path, scenario(endpoint(tmp_path), coupling=coupling))
    digest = closed_loop(plan, tmp_path, tmp_path / "live")
    alone = play(plan, tmp_path / "alone", None)
    assert alone != digest  # the outside matters

    table = pq.read_table(tmp_path / "live/external.parquet").to_pydict()
    assert table["tick"] == [tick for tick in range(TICKS) for _ in range(2)]
    assert table["key"] == ["lab/1/u", "lab/2/u"] * TICKS
    p = pq.read_table(tmp_path / "live/trajectories.parquet").to_pydict()
    assert table["value[1]"][2::2] == [-0.5 * x for x in p["plant.p[1]"][3 : 3 * TICKS : 3]]  # agent 1, from tick 1

    assert replayed(tmp_path / "live", tmp_path / "native") == digest
    assert replayed(tmp_path / "live", tmp_path / "python", PYTHON_LOOP) == digest
    assert replayed(tmp_path / "native", tmp_path / "again") == digest  # a replay can be replayed


def test_across_processes(tmp_path: Path) -> None:
    plan = planned(tmp_path, scenario(endpoint(tmp_path)))
    digest = closed_loop(plan, tmp_path, tmp_path / "inline")
    assert closed_loop(plan, tmp_path, tmp_path / "live", workers=2) == digest
    assert replayed(tmp_path / "live", tmp_path / "replay") == digest
    assert replayed(tmp_path / "live", tmp_path / "processes", workers=1) == digest
    names = ("inline", "live", "replay", "processes")
    files = [pq.read_table(tmp_path / name / "external.parquet") for name in names]
    assert all(file.equals(files[0]) for file in files)


def test_bad_messages_are_refused_and_counted(tmp_path: Path) -> None:
    plan = planned(tmp_path, scenario(endpoint(tmp_path)))
    warnings: list[str] = []
    with Live(plan, warnings.append) as live, heard(live, tmp_path, "bad"):
        play(plan, tmp_path / "run", live, take=Answered(live))
        account = live.account()
    assert warnings == ["a message at 'lab/1/u' is refused: it has 1 number, not 2"]
    assert f"lab/1/u: a new value at {TICKS} ticks, 8 messages refused" in account
    assert f"lab/2/u: a new value at {TICKS} ticks" in account
    rows = pq.read_table(tmp_path / "run/external.parquet").to_pydict()
    assert np.isfinite(rows["value[1]"]).all()


def test_nobody_is_there(tmp_path: Path) -> None:
    plan = planned(tmp_path, scenario(endpoint(tmp_path)))
    with Live(plan, refuse_nothing) as live:
        digest = play(plan, tmp_path / "live", live)
    assert digest == play(plan, tmp_path / "alone", None)
    assert pq.read_table(tmp_path / "live/external.parquet").num_rows == 0
    assert replayed(tmp_path / "live", tmp_path / "again") == digest


def test_who_stops_reading_does_not_stop_the_run(tmp_path: Path) -> None:
    """The outside hears nothing any more; what it does not take is dropped."""
    text = scenario(endpoint(tmp_path)).replace(f"duration: {TICKS * 100} ms", "duration: 400 s")
    plan = planned(tmp_path, text)
    with Live(plan, refuse_nothing) as live, heard(live, tmp_path) as process:
        os.kill(process.pid, signal.SIGSTOP)
        play(plan, tmp_path / "run", live)
        assert live.account()[0] == f"{4 * 4001} messages published"


def test_what_is_published(tmp_path: Path) -> None:
    plan = planned(tmp_path, scenario(endpoint(tmp_path)))
    heard: list[list[bytes | None]] = [[], []]

    def all_heard() -> bool:
        for index, payloads in enumerate(heard):
            payloads += [arrival.payload for arrival in other.arrived(index, 10_000)]
        return all(len(payloads) > TICKS for payloads in heard)

    with (
        Live(plan, refuse_nothing) as live,
        PlainKeys((), [endpoint(tmp_path)], [("lab/1/u", "application/json")], ["lab/2/p", "lab/raw"]) as other,
    ):
        other.put(0, b"[1, 2]")  # arrives after the subscriptions of its session
        until(lambda: bool(live.take(0)))
        play(plan, tmp_path / "run", live)
        until(all_heard)
    table = pq.read_table(tmp_path / "run/trajectories.parquet").to_pydict()
    p, v = [[table[f"plant.{x}[{i}]"][agent::3] for i in (1, 2)] for x, agent in (("p", 1), ("v", 2))]
    said = [json.loads(payload or b"") for payload in heard[0]]
    assert said == [{"tick": k, "time": k / 10, "value": [p[0][k], p[1][k]]} for k in range(TICKS + 1)]
    assert heard[1] == [struct.pack("<2d", v[0][k], v[1][k]) for k in range(TICKS + 1)]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.yaml").write_text(scenario(endpoint(tmp_path)))
    assert main(["run", str(tmp_path / "lab.yaml"), "--out", str(tmp_path / "one"), "--no-report"]) == 0
    said = capsys.readouterr()
    assert f"the bridge listens at {endpoint(tmp_path)}" in said.err
    assert f"{4 * (TICKS + 1)} messages published" in said.out
    assert main(["run", str(tmp_path / "one/scenario.yaml"), "--out", str(tmp_path / "two"), "--no-report"]) == 0
    again = capsys.readouterr()
    assert f"the bridge replays {tmp_path / 'one/external.parquet'}" in again.err
    digest = next(line for line in said.out.splitlines() if "digest" in line)
    assert digest in again.out


def test_an_endpoint_that_is_taken(tmp_path: Path) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    plan = planned(tmp_path, scenario(where))
    with Live(plan, refuse_nothing), pytest.raises(ConfigError, match=f"cannot listen at {re.escape(where)}"):
        Live(plan, refuse_nothing)
