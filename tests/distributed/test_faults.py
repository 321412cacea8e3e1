"""What a user learns when something breaks: who is to blame, at which tick, and who waits for whom."""

from __future__ import annotations

import os
import random
import re
import resource
import shutil
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from time import sleep

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.distributed import cluster
from cosim.distributed.assignment import divide
from cosim.distributed.standing import Standing, waits
from cosim.distributed.survey import Lost
from cosim.errors import ClusterError, RunError
from cosim.running.pacing import Pacer
from network.envelope import Streams
from network.transport import Kind
from network.zenoh import LEASE
from tests.components.probe import FAILS
from tests.distributed.loopback import Loopback
from tests.distributed.networks import Record, in_process, planned, ring, scenario
from tests.distributed.nodes import HARMS
from tests.distributed.processes import (
    At,
    assert_begins,
    assert_nothing_left,
    child,
    command,
    cosim,
    environment,
    harm_at_birth,
    manifest,
)
from tests.distributed.started import started


# --- messages that are lost -------------------------------------------------------------------------------------------
@settings(deadline=None, max_examples=25)
@given(tick=st.integers(0, 11), mail=st.booleans(), channel=st.sampled_from(["ideal", "slack"]), seed=st.integers(0))
def test_message_that_is_lost_is_found_by_asking(tick: int, mail: bool, channel: str, seed: int) -> None:
    plan = planned(scenario(4, ring(4), channel))
    ends = ("emulator", "worker-2") if mail else ("worker-2", "emulator")
    kind = Kind.MAIL if mail else Kind.SAMPLES
    there = Streams("loopback", ends[1])
    first_lost: int | None = None

    def tamper(sender: str, receiver: str, frame: bytes) -> Sequence[bytes]:
        nonlocal first_lost
        if (sender, receiver) != ends:
            return [frame]
        if first_lost is None:
            message = there.decode(sender, frame).expect(kind)
            n_ticks = int.from_bytes(message.body[:8], "little")
            first_lost = message.tick if message.tick + n_ticks > tick else None
        return [] if first_lost is not None else [frame]  # what follows is lost as well: else the gap shows at once

    loop = Loopback(plan, 2, [Record()], random.Random(seed), tamper)
    try:
        loop.run()
    except AssertionError:
        for _ in range(2):
            assert loop.orchestration.lost_message() is None
            loop.ask()
        assert loop.orchestration.lost_message() == Lost(kind, first_lost, *ends)
    else:
        assert (channel, mail, first_lost) == ("slack", False, 11)  # nobody needs it


def test_nobody_is_suspected_while_all_goes_well() -> None:
    plan = planned(scenario(4, ring(4)))
    loop = Loopback(plan, 3, [Record()], random.Random(1))
    loop.run()
    for _ in range(3):
        loop.ask()
        assert loop.orchestration.lost_message() is None
    assert loop.orchestration.settled(())


def test_worker_that_failed_has_lost_no_message() -> None:
    """It takes its mail, and does nothing with it."""
    loop = Loopback(planned(scenario(4, ring(4), faults={3: ("Failing", 0.35)})), 2, [Record()], random.Random(1))
    with pytest.raises(RunError):
        loop.run()
    for _ in range(3):
        with suppress(RunError):  # again with every message
            loop.ask()
        assert loop.orchestration.lost_message() is None


def test_many_that_wait_for_the_same_are_told_together() -> None:
    plan = planned(scenario(12, ring(12)))
    loop = Loopback(plan, 12, [Record()], random.Random(1), lambda s, r, f: [] if s == "worker-5" else [f])
    with pytest.raises(AssertionError):
        loop.run()
    loop.ask()
    lines = waits(plan, loop.orchestration.workers, loop.orchestration.standing(), ["worker-5"], cut_off=False)
    assert lines == [
        "the emulator waits for all to be ready",
        "11 workers (worker-1..4, worker-6..12) wait for all to be ready",
    ]


# --- processes --------------------------------------------------------------------------------------------------------
def probes_scenario(probe: Path, fails: str) -> str:
    """Three agents, of which the second has a fault at t = 0.35 s; all native."""
    component = f"components: {{probe: {{fmu: {probe}, start: {{fails: %d}}}}}}"
    return "\n".join(
        [
            "name: probes",
            "period: 100 ms",
            "duration: 2 s",
            "agents:",
            f"  1: {{{component % 0}}}",
            f"  2: {{{component % FAILS.index(fails)}}}",
            f"  3: {{{component % 0}}}",
            "coupling: {method: joint, step: 20 ms}",
        ]
    )


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        ("derivative_hangs", "did not get further for 5 s"),
        ("derivative_crashes", "was killed by signal 11 (SIGSEGV)"),
    ],
)
def test_native_code_that_hangs_or_crashes(fails: str, said: str, probes: dict[int, Path], scratch: Path) -> None:
    """All agents of the worker are advanced by one native call: which one it is, is known all the same."""
    plan = planned(probes_scenario(probes[3], fails))
    with pytest.raises(ClusterError) as caught:
        cluster.run(plan, 1, [Record()], step_deadline=5.0)
    lines = str(caught.value).splitlines()
    assert (
        lines[0] == f"worker-1 (agents 1..3) {said} at tick 3 (t = 0.3 s), while it advanced agent 2, component probe"
    )
    assert re.fullmatch(r"  the emulator waits for the samples of tick \d from worker-1 \(agents 1..3\)", lines[1])
    assert_nothing_left(scratch)


def test_emulator_that_is_stopped(scratch: Path) -> None:
    plan = planned(scenario(3, ring(3), "slack", ticks=20_000))
    record = Record()
    with pytest.raises(ClusterError) as caught:
        cluster.run(plan, 2, [record, At(20, lambda: os.kill(child("emulator"), signal.SIGSTOP))])
    lines = str(caught.value).splitlines()
    assert re.fullmatch(r"the emulator is stopped by signal 19 \(SIGSTOP\) at tick \d+ \(t = \S+ s\)", lines[0])
    assert re.fullmatch(
        r"  worker-1 \(agent 1\) and worker-2 \(agents 2, 3\) wait for mail from the emulator", lines[1]
    )
    assert len(lines) == 2
    assert_nothing_left(scratch)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        ("lost", r"message \d+ was lost or overtaken: \d+ came in its place"),
        ("overtaken", r"message \d+ was lost or overtaken: \d+ came in its place"),
        ("twice", r"message \d+ came again or too late, \d+ was next"),
        ("damaged", "damaged or cut off: the checksum does not match"),
        ("cut off", "damaged or cut off: .*"),
    ],
)
def test_message_that_comes_to_harm_on_the_wire(harm: str, said: str, scratch: Path) -> None:
    """Whoever notices, the emulator or the orchestrator: the sender is named, and all that was recorded is right."""
    tick = random.Random(harm).randrange(10, 900)  # the same in every process that collects the tests
    text = scenario(4, ring(4), "slack", ticks=1000, faults={3: ("Tampering", tick / 10, {"harm": HARMS.index(harm)})})
    expected, _ = in_process(planned(scenario(4, ring(4), "slack", ticks=1000)))
    record = Record()
    with pytest.raises(ClusterError) as caught:
        cluster.run(planned(text), 2, [record])
    pattern = (
        rf"(emulator failed: )?message from worker-2: {said}; tick (-?\d+) is the last one recorded\n"
        r"  worker-2 \(agents 3, 4\) sent it"
    )
    found = re.fullmatch(pattern, str(caught.value))
    assert found is not None, str(caught.value)
    assert int(found[2]) == len(record.ticks) - 1
    assert_begins(record, expected)
    assert_nothing_left(scratch)


def test_socket_that_is_gone_when_a_worker_is_to_be_replaced(scratch: Path) -> None:
    plan = planned(scenario(4, ring(4), ticks=20_000, on_worker_loss="restart"))

    def harm() -> None:
        for socket in scratch.glob("cosim-*/hub"):
            socket.unlink()
        os.kill(child("worker-2"), signal.SIGKILL)

    with pytest.raises(ClusterError) as caught:
        cluster.run(plan, 2, [At(20, harm)])
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("worker-2 (agents 3, 4) was killed by signal 9 ")
    assert re.fullmatch(r"  worker-2 is not replaced: the socket of the run is gone: \S+/hub", lines[1])
    assert_nothing_left(scratch)


@pytest.mark.parametrize(
    ("name", "number", "said"),
    [
        ("worker-2", signal.SIGKILL, r"worker-2 \(agents 3, 4\) was killed by signal 9 .*"),
        ("worker-2", signal.SIGSTOP, r"worker-2 \(agents 3, 4\) is stopped by signal 19 \(SIGSTOP\)"),
        ("emulator", signal.SIGTERM, r"the emulator was killed by signal 15 \(SIGTERM\)|.* code 143 \(SIGTERM\)"),
        ("emulator", signal.SIGSTOP, r"the emulator is stopped by signal 19 \(SIGSTOP\)"),
    ],
)
def test_process_that_is_lost_before_it_has_joined(
    name: str, number: signal.Signals, said: str, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    harm_at_birth(monkeypatch, name, number)
    record = Record()
    with pytest.raises(ClusterError) as caught:
        cluster.run(planned(scenario(4, ring(4))), 2, [record])
    first, *others = str(caught.value).splitlines()
    assert re.fullmatch(rf"({said}) before the first tick", first)
    assert all(line.endswith((" waits for all to be ready", " wait for all to be ready")) for line in others)
    assert others
    assert record == Record()
    assert_nothing_left(scratch)


def test_orchestrator_that_is_stopped_for_a_while(tmp_path: Path) -> None:
    """As by Ctrl-Z and fg."""
    (tmp_path / "net.yaml").write_text(scenario(4, ring(4), "slack", ticks=40))
    run = ("run", "net.yaml", "--distributed", "--workers", "2", "--out", "out", "--no-report", "--realtime")
    with started(tmp_path, *run) as orchestrator:
        orchestrator.hear("s simulated")
        orchestrator.signal(signal.SIGSTOP)
        sleep(LEASE + 1)  # longer than a connection to another host may be silent
        orchestrator.signal(signal.SIGCONT)
        orchestrator.succeed()
    assert manifest(tmp_path / "out")["status"] == "complete"


def test_emulator_that_is_stopped_while_ticks_are_released(scratch: Path) -> None:
    """What is sent to it must not fill its connection: who waits for room there notices nothing for long."""
    plan = planned(scenario(3, ring(3), ticks=100_000))
    record, pacer = Record(), Pacer(plan, Fraction(200))
    with pytest.raises(ClusterError, match=r"^the emulator is stopped by signal 19 \(SIGSTOP\) at tick \d+ "):
        cluster.run(plan, 1, [record, At(20, lambda: os.kill(child("emulator"), signal.SIGSTOP))], pacer=pacer)
    assert_nothing_left(scratch)


def test_who_waits_for_the_clock_waits_for_nobody_else() -> None:
    plan = planned(scenario(4, ring(4)))
    workers = divide(4, 2)
    at = Standing(True, 5, 5, {"worker-1": 5, "worker-2": 4}, {"worker-1": 5, "worker-2": 5}, frozenset())
    assert waits(plan, workers, at, ["worker-2"], cut_off=False) == [
        "the emulator waits for the orchestrator to release tick 6",
        "worker-1 (agents 1, 2) waits for the mail of tick 5 from the emulator",
    ]


def test_memory_that_runs_out(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), faults={2: ("Greedy", 0.35)}))
    done = cosim(tmp_path, "net.yaml", "--distributed", "--workers", "3", "--out", "out")
    assert done.returncode == 3
    assert "agent 2, component node, at t = 0.3" in done.stderr
    assert "MemoryError" in done.stderr
    assert manifest(tmp_path / "out")["status"].startswith("aborted: ")
    assert_nothing_left(tmp_path)


@pytest.mark.parametrize("what", ["socket", "folder"])
def test_files_of_the_run_that_vanish_are_not_needed_any_more(what: str, scratch: Path) -> None:
    plan = planned(scenario(4, ring(4), ticks=300))
    expected, _ = in_process(plan)
    record = Record()

    def vanish() -> None:
        for folder in scratch.glob("cosim-*"):
            shutil.rmtree(folder) if what == "folder" else (folder / "hub").unlink()

    cluster.run(plan, 2, [record, At(20, vanish)])
    assert record == expected
    assert_nothing_left(scratch)


@pytest.mark.skipif(os.name != "posix", reason="needs RLIMIT_FSIZE")
def test_disk_that_is_full(tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(4, ring(4), "slack", ticks=100_000))
    done = subprocess.run(
        command("net.yaml", "--distributed", "--workers", "2", "--out", "out"),
        cwd=tmp_path,
        env=environment(tmp_path),
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY)),
    )
    assert done.returncode == 3, done.stderr
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert manifest(tmp_path / "out")["status"].startswith("aborted: cannot write ")
    assert_nothing_left(tmp_path)
