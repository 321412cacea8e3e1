"""Paced runs as people start them: the same results, never too early, and an end as soon as it is asked for."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from fractions import Fraction
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.distributed import cluster
from cosim.errors import ClusterError
from cosim.plan import Plan
from cosim.running import inline
from cosim.running.inline import Interrupted, Observer
from cosim.running.pacing import Pacer
from network.messages import Floats
from tests.distributed.loopback import Loopback
from tests.distributed.networks import Record, in_process, planned, ring, scenario, scenarios
from tests.distributed.test_processes import At, assert_nothing_left, child, command, cosim, environment, manifest

ACROSS = ["--distributed", "--workers", "2"]
WAYS = pytest.mark.parametrize("how", [[], ACROSS], ids=["in-process", "distributed"])


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


# --- results ----------------------------------------------------------------------------------------------------------
@WAYS
def test_digest_is_that_of_the_free_run_and_it_takes_its_time(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3)))
    free = cosim(tmp_path, "net.yaml", "--out", "free")
    paced = cosim(tmp_path, "net.yaml", "--out", "paced", "--realtime", "2", *how)
    assert free.returncode == paced.returncode == 0, paced.stderr
    one, other = manifest(tmp_path / "free"), manifest(tmp_path / "paced")
    assert one["digest"] == other["digest"]
    assert other["wall_s"] >= 1.2 / 2
    assert "realtime" not in one
    account = other["realtime"]
    assert (account["factor"], account["overrun"], account["ticks"]) == (2, "warn", 13)
    assert account["period_s"] == 0.05
    assert 0 < account["reached"] <= 2
    lateness = account["lateness_s"]
    assert 0 < lateness["p50"] <= lateness["p99"] <= lateness["max"]
    assert lateness["max"] == max(account["course_s"]["max"])
    assert account["missed"] == sum(late > 0.05 for late in account["course_s"]["max"])
    assert re.search(
        r"real-time factor +\S+ reached, 2 wanted\n +lateness of ticks +p50 .*, p99 .*, max ", paced.stdout
    )
    assert f"{account['missed']} of 13\n" in paced.stdout


class Begun:
    """An observer of when ticks are seen."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def tick(self, tick: int, row: Floats) -> None:
        self.seen.append(time.monotonic_ns())

    def fates(self, fates: object) -> None:
        pass


def play(how: list[str], plan: Plan, observers: list[Observer], pacer: Pacer, stop: Callable[[], bool]) -> None:
    if how:
        cluster.run(plan, 2, observers, stop, pacer=pacer)
    else:
        inline.run(plan, observers, stop, pacer)


@WAYS
def test_no_tick_is_seen_before_its_release(how: list[str], scratch: Path) -> None:
    plan = planned(scenario(2, ring(2), "slack", ticks=30))
    begun, pacer = Begun(), Pacer(plan, Fraction(20), say=lambda _: None)
    play(how, plan, [begun], pacer, lambda: False)
    assert len(begun.seen) == pacer.report()["ticks"] == 31
    assert all(at >= pacer.release_ns(tick) for tick, at in enumerate(begun.seen))


@settings(max_examples=25, deadline=None)
@given(scenarios(), st.integers(1, 5), st.integers(0, 2**31))
def test_release_by_release_in_any_order(text: str, n_workers: int, seed: int) -> None:
    plan = planned(text)
    expected, _ = in_process(plan)
    record, told = Record(), []
    loopback = Loopback(plan, n_workers, [record], random.Random(seed), paced=True)
    tick = record.tick

    def watched(at: int, row: Floats) -> None:
        told.append(loopback.orchestration.released >= at)
        tick(at, row)

    record.tick = watched  # type: ignore[method-assign, assignment]
    loopback.run()
    assert (record.ticks, record.fates_of, record.calls) == (expected.ticks, expected.fates_of, expected.calls)
    assert all(told)


# --- overruns ---------------------------------------------------------------------------------------------------------
@WAYS
def test_abort_ends_the_run_with_the_tick_that_is_late(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), ticks=600, faults={2: ("Slow", 0.25)}))
    done = cosim(tmp_path, "net.yaml", "--out", "out", "--realtime", "--overrun", "abort", *how)
    assert done.returncode == 3
    said = re.search(
        r"error: overrun: tick (\d+) \(t = (\S+) s\) was complete \S+ m?s after its release, \S+ m?s after its",
        done.stderr,
    )
    assert said is not None, done.stderr
    tick = int(said[1])
    assert tick <= 3  # an earlier one on a machine that is busy
    assert float(said[2]) == tick / 10
    assert "everything until then is in out" in done.stderr
    content = manifest(tmp_path / "out")
    assert content["status"].startswith(f"aborted: overrun: tick {tick} (t = ")
    assert content["ticks"]["done"] == tick
    assert (content["realtime"]["missed"], content["realtime"]["ticks"]) == (1, tick + 1)
    assert_nothing_left(tmp_path)


@WAYS
def test_stretch_moves_the_schedule(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), faults={2: ("Slow", 0.25)}))
    done = cosim(tmp_path, "net.yaml", "--out", "out", "--realtime", "--overrun", "stretch", *how)
    assert done.returncode == 0, done.stderr
    assert "overrun" not in done.stderr
    content = manifest(tmp_path / "out")
    account = content["realtime"]
    assert account["missed"] >= 1
    assert account["stretched_s"] >= 0.35
    assert content["wall_s"] >= 1.2 + account["stretched_s"]
    assert "the schedule was stretched by " in done.stdout


@WAYS
def test_warn_says_so_and_in_total(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), faults={2: ("Slow", 0.25)}))
    done = cosim(tmp_path, "net.yaml", "--out", "out", "--realtime", "--quiet", *how)
    assert done.returncode == 0, done.stderr
    account = manifest(tmp_path / "out")["realtime"]
    assert account["missed"] >= 4  # half a second of ticks
    lines = done.stderr.splitlines()
    assert re.match(r"overrun: tick \d+ .* ticks missed so far$", lines[0])
    assert lines[-1].startswith(f"{account['missed']} of 13 ticks missed; largest lateness ")


# --- to stop, and to lose somebody, within a long period --------------------------------------------------------------
@WAYS
def test_interrupt_within_a_long_period(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(2, ring(2)))
    with subprocess.Popen(
        command("net.yaml", "--realtime", "0.0001", "--out", "long", *how),  # 1000 s per tick
        cwd=tmp_path,
        env=environment(tmp_path),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as run:
        deadline = time.monotonic() + 60
        while not (tmp_path / "long" / "manifest.json").exists():
            assert time.monotonic() < deadline
        run.send_signal(signal.SIGINT)
        _, error = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "interrupted at t = 0 s" in error
    assert manifest(tmp_path / "long")["status"] == "aborted: interrupted at t = 0 s"
    assert_nothing_left(tmp_path)


@WAYS
def test_request_to_stop_is_heard_while_the_clock_is_waited_for(how: list[str], scratch: Path) -> None:
    plan = planned(scenario(2, ring(2)))
    record, asked, pacer = Record(), count(), Pacer(plan, Fraction(1, 10_000))

    def stop() -> bool:
        return bool(record.ticks) and next(asked) > 5

    with pytest.raises(Interrupted):
        play(how, plan, [record], pacer, stop)
    assert len(record.ticks) == 1


def test_a_loss_is_noticed_while_the_clock_is_waited_for(scratch: Path) -> None:
    plan = planned(scenario(2, ring(2)))
    record, pacer = Record(), Pacer(plan, Fraction(1, 10_000))
    with pytest.raises(ClusterError, match=r"^worker-2 \(agent 2\) was killed by signal 9 .* at tick 0 "):
        cluster.run(plan, 2, [record, At(0, lambda: os.kill(child("worker-2"), signal.SIGKILL))], pacer=pacer)
    assert len(record.ticks) == 1
    assert_nothing_left(scratch)


def test_waiting_for_the_clock_is_no_hang(scratch: Path) -> None:
    plan = planned(scenario(2, ring(2), ticks=1))
    record, pacer = Record(), Pacer(plan, Fraction(1, 50))  # 5 s per tick
    cluster.run(plan, 2, [record], step_deadline=3.0, pacer=pacer)
    assert len(record.ticks) == 2


# --- arguments --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["net.yaml", "--realtime", "0"], "argument --realtime: '0' must be finite and above 0: FACTOR is simulated"),
        (["net.yaml", "--realtime=-2"], "argument --realtime: '-2' must be finite and above 0"),
        (["--realtime", "net.yaml"], "argument --realtime: 'net.yaml' is no number: "),
        (["net.yaml", "--realtime", "1e9"], "the factor can be at most 100000"),
        (["net.yaml", "--overrun", "abort"], "--overrun abort is for runs that are paced; add --realtime"),
        (["net.yaml", "--realtime", "--overrun", "ignore"], "invalid choice: 'ignore' (choose from"),
    ],
)
def test_mistakes_are_said_before_anything_starts(arguments: list[str], said: str, tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(1, []))
    done = cosim(tmp_path, *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()
