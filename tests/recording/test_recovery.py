"""Whatever moment the recording process is killed at, all that was complete can be read."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.errors import ConfigError
from cosim.plan import Plan
from cosim.recording import spool
from cosim.recording.lock import RECOVERY, FolderLock
from cosim.recording.recorder import Recorder
from cosim.results import load
from network.messages import Fates, Floats
from tests.recording.networks import VARIABLES, Record, make_plan
from tests.recording.test_full_disk import leave, small_disk  # noqa: F401 - a fixture
from tests.recording.test_recorder import digest_of, some_fates

Call = tuple[int, Floats] | Fates
Folders = Callable[[], Path]


def calls(plan: Plan, seed: int) -> Iterator[Call]:
    """What a recorder is told: rows and fates, turn and turn about."""
    rng = np.random.default_rng(seed)
    width = sum(port.variable.size for agent in plan.agents for _, port in agent.record)
    for tick in range(plan.ticks + 1):
        yield tick, rng.normal(size=width)
        yield some_fates(int(rng.integers(0, 9)), len(plan.agents), rng)


def tell(recorder: Recorder, call: Call) -> None:
    if isinstance(call, Fates):
        recorder.fates(call)
    else:
        recorder.tick(*call)


def killed(folder: Path, target: Path) -> None:
    """What is left of a run folder if its process is killed now."""
    shutil.copytree(folder, target)


def assert_same(recovered: Path, stopped: Path, digest: str) -> None:
    """All that a run which was stopped holds is there, and nothing else."""
    results = load(recovered)
    assert results.manifest["digest"] == digest
    for name in ("trajectories", "deliveries"):
        assert pq.read_table(recovered / f"{name}.parquet").equals(pq.read_table(stopped / f"{name}.parquet"))
    ended, manifest = (json.loads((folder / "manifest.json").read_text()) for folder in (stopped, recovered))
    for key in ended.keys() - {"status", "wall_s", "start_s", "speed", "created"}:
        assert manifest[key] == ended[key]
    assert list(manifest) == list(ended)
    reached = f"; recorded until t = {ended['simulated_s']:.9g} s" if results.n_ticks else " before the first tick"
    assert manifest["status"] == f"aborted: the process that recorded it was killed{reached}"
    assert sorted(path.name for path in recovered.iterdir()) == sorted(path.name for path in stopped.iterdir())


DIFFERENT: list[Record] = [
    {"plant.p": ((2,), "rad"), "plant.energy": ((), "J")},
    {"controller.gain": ((2, 2), None), "plant.energy": ((), "J"), "plant.p": ((2,), "rad")},
    {},
]


@settings(max_examples=25, deadline=None)
@given(
    record=st.sampled_from([VARIABLES, DIFFERENT]),
    block_bytes=st.sampled_from([300, 1000, 1 << 20]),
    seed=st.integers(0, 99),
    n_calls=st.integers(0, 82),
)
def test_killed_after_any_record(record: Any, block_bytes: int, seed: int, n_calls: int) -> None:
    plan = make_plan(3, 40, record=record)
    with TemporaryDirectory() as name:
        folder = Path(name)
        stopped = Recorder(plan, folder / "stopped", block_bytes=block_bytes)
        stopped.open()
        interrupted = Recorder(plan, folder / "interrupted")  # at the last tick that was told of
        interrupted.open()
        last = n_calls - (n_calls % 2 == 0)
        for i, call in enumerate(itertools.islice(calls(plan, seed), n_calls)):
            tell(stopped, call)
            if i < last:
                tell(interrupted, call)
        killed(folder / "stopped", folder / "killed")
        stopped.close("aborted: by the test")
        assert_same(folder / "killed", folder / "interrupted", interrupted.close("aborted: by the test"))


@settings(max_examples=25, deadline=None)
@given(
    record=st.sampled_from([VARIABLES, DIFFERENT]),
    block_bytes=st.sampled_from([300, 1000, 1 << 20]),
    seed=st.integers(0, 99),
    sizes=st.lists(st.integers(1, 30), max_size=8),
)
def test_several_ticks_at_once_are_what_they_are_one_by_one(
    record: Any, block_bytes: int, seed: int, sizes: list[int]
) -> None:
    plan = make_plan(3, 40, record=record)
    told = list(calls(plan, seed))
    with TemporaryDirectory() as name:
        folder = Path(name)
        at_once = Recorder(plan, folder / "at_once", block_bytes=block_bytes)
        one_by_one = Recorder(plan, folder / "one_by_one")
        for recorder in (at_once, one_by_one):
            recorder.open()
        tick = 0
        for size in sizes:
            pieces = told[2 * tick : 2 * (tick + size)]
            rows = [call[1] for call in pieces if isinstance(call, tuple)]
            fates = [call for call in pieces if isinstance(call, Fates)]
            if not rows:
                break
            at_once.course(tick, np.array(rows), Fates.joined(fates), [*map(len, fates)])
            tick += len(rows)
        for call in told[: max(0, 2 * tick - 1)]:  # the fates after the last tick are of a period that is not over
            tell(one_by_one, call)
        killed(folder / "at_once", folder / "killed")
        if tick:
            tell(one_by_one, told[2 * tick - 1])
        digest = one_by_one.close("aborted: by the test")
        assert at_once.close("aborted: by the test") == digest
        for which in ("trajectories", "deliveries"):
            one, other = (pq.read_table(folder / run / f"{which}.parquet") for run in ("at_once", "one_by_one"))
            assert one.equals(other)
        recovered = load(folder / "killed")
        assert recovered.n_ticks == max(0, tick)
        n_fates = sum(len(call) for call in told[: max(0, 2 * tick - 1)] if isinstance(call, Fates))
        rows_there = pq.read_table(folder / "killed" / "deliveries.parquet").num_rows
        in_group = sum(len(call) for call in told[: 2 * tick] if isinstance(call, Fates))
        assert rows_there in (n_fates, in_group)  # a row group may have taken the last ones as well


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_spool_that_ends_at_any_byte(data: st.DataObject) -> None:
    """As many whole records as were handed over, whether the rest is missing, zero or of an earlier round."""
    plan = make_plan(3, 40)
    block_bytes, n_calls = data.draw(st.sampled_from([2000, 1 << 20])), data.draw(st.integers(1, 82))
    with TemporaryDirectory() as name:
        folder = Path(name)
        recorder = Recorder(plan, folder / "run", block_bytes=block_bytes)
        recorder.open()
        states: list[tuple[int, int]] = []  # length of the spool, and calls, after each tick since the last row group
        begun = 0
        for told, call in enumerate(itertools.islice(calls(plan, 1), n_calls), start=1):
            before = recorder._spool._seed
            tell(recorder, call)
            if recorder._spool._seed != before:
                states, begun = [], told
            elif not isinstance(call, Fates):
                states.append((recorder._spool._end, told))
        cut = data.draw(st.integers(0, recorder._spool._end))
        killed(folder / "run", folder / "killed")
        recorder.close("aborted: by the test")
        path = folder / "killed" / ".spool"
        content = bytearray(path.read_bytes())
        match data.draw(st.sampled_from(["missing", "zero", "noise"])):
            case "missing":
                del content[cut:]
            case "zero":
                content[cut:] = bytes(len(content) - cut)
            case "noise":
                content[cut:] = np.random.default_rng(cut).bytes(len(content) - cut)
        path.write_bytes(content)
        whole = max([begun, *(told for length, told in states if length <= cut)])
        stopped = Recorder(plan, folder / "stopped")
        stopped.open()
        for call in itertools.islice(calls(plan, 1), whole):
            tell(stopped, call)
        assert_same(folder / "killed", folder / "stopped", stopped.close("aborted: by the test"))


MOMENTS = {
    "row groups written": (spool.Spool, "finish"),
    "all written": (Recorder, "_close_files"),
    "files closed": (Recorder, "_write_manifest"),
    "manifest written": (spool.Spool, "remove"),
    "spool removed": (FolderLock, "release"),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_between_two_steps_of_the_recorder(
    moment: str, folders: Folders, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, folder, left = make_plan(3, 40), folders(), folders()
    recorder = Recorder(plan, folder, block_bytes=3000)
    recorder.open()
    owner, name = MOMENTS[moment]
    original = getattr(owner, name)

    def step(self: Any, *args: Any) -> Any:
        if recorder._tables.ticks >= 20 and not left.exists():
            killed(folder, left)
        return original(self, *args)

    monkeypatch.setattr(owner, name, step)
    for call in list(calls(plan, 1))[:61]:
        tell(recorder, call)
    digest = recorder.close("aborted: by the test")
    results, whole = load(left), load(folder)
    assert not list(left.glob(".*"))
    assert results.manifest["digest"] == digest_of(left)
    if moment != "row groups written":
        assert results.manifest["digest"] == digest
    assert results.n_ticks >= 20
    assert np.array_equal(results.array("plant.p"), whole.array("plant.p")[: results.n_ticks])


def test_every_bit_survives(folders: Folders) -> None:
    patterns = np.array([0, 1 << 63, 0x7FF0_0000_0000_0001, 0xFFF8_0000_0000_0123, 1, 0x7FF0 << 48], dtype=np.uint64)
    folder, left = folders(), folders()
    recorder = Recorder(make_plan(2, 0, record={"plant.x": ((6,), None)}), folder)
    recorder.open()
    recorder.tick(0, np.tile(patterns.view(np.float64), 2))
    killed(folder, left)
    assert load(left).manifest["digest"] == recorder.close("complete")


def test_recovery_that_was_killed_is_done_again(folders: Folders, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, folder, left = make_plan(3, 40), folders(), folders()
    recorder = Recorder(plan, folder, block_bytes=3000)
    recorder.open()
    for call in list(calls(plan, 1))[:61]:
        tell(recorder, call)
    killed(folder, left)
    digest = recorder.close("aborted: by the test")

    class Killed(BaseException):
        pass

    def kill(*_: object) -> None:
        raise Killed

    for place in ("tables.RunTables.append", "tables.RunTables.close", "recovery.digest_of", "recovery.to_json"):
        with monkeypatch.context() as patched:
            patched.setattr(f"cosim.recording.{place}", kill)
            with pytest.raises(Killed):
                load(left)
        assert json.loads((left / "manifest.json").read_text())["status"] == "running"
    assert_same(left, folder, digest)


def test_read_by_several_at_once(folders: Folders) -> None:
    plan, folder, left = make_plan(3, 40), folders(), folders()
    recorder = Recorder(plan, folder)
    recorder.open()
    for call in list(calls(plan, 1))[:-1]:
        tell(recorder, call)
    killed(folder, left)
    digest = recorder.close("aborted: by the test")
    code = f"from cosim.results import load; print(load({str(left)!r}).manifest['digest'])"
    readers = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
        for _ in range(3)
    ]
    assert [reader.communicate(timeout=60)[0].strip() for reader in readers] == [digest] * 3
    assert_same(left, folder, digest)


def test_reader_waits_for_a_recovery(folders: Folders) -> None:
    plan, folder, left = make_plan(3, 5), folders(), folders()
    recorder = Recorder(plan, folder)
    recorder.open()
    killed(folder, left)
    recorder.close("aborted: by the test")
    lock = FolderLock(left, RECOVERY)
    code = f"from cosim.results import load; print('begin', flush=True); print(load({str(left)!r}).n_ticks)"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    ) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "begin\n"
        lock.release()
        assert reader.communicate(timeout=60)[0] == "0\n"


# --- what cannot be recovered -----------------------------------------------------------------------------------------
def left_behind(folders: Folders, n_calls: int = 21) -> Path:
    """A folder whose process was killed."""
    plan, folder, left = make_plan(3, 40), folders(), folders()
    recorder = Recorder(plan, folder)
    recorder.open()
    for call in list(calls(plan, 1))[:n_calls]:
        tell(recorder, call)
    killed(folder, left)
    recorder.close("aborted: by the test")
    return left


@pytest.mark.parametrize("name", [".spool", ".groups", "trajectories.parquet"])
def test_file_that_is_missing(name: str, folders: Folders) -> None:
    left = left_behind(folders)
    (left / name).unlink()
    said = rf"{name}: error: the run's process was killed, and what it recorded cannot be recovered: No such file"
    with pytest.raises(ConfigError, match=said):
        load(left)


@pytest.mark.parametrize("content", [b"", b"no spool at all, and long enough for a record"])
def test_file_that_is_damaged(content: bytes, folders: Folders) -> None:
    left = left_behind(folders)
    (left / ".groups").write_bytes(content)
    with pytest.raises(ConfigError, match=r"cannot be recovered: \.groups does not begin as it should"):
        load(left)


def test_no_room_to_recover(small_disk: Path, folders: Folders) -> None:  # noqa: F811
    left = left_behind(folders)
    there = small_disk / "run"
    killed(left, there)
    (there / ".reserve").unlink()
    leave(small_disk, 0)
    with pytest.raises(ConfigError, match="cannot be recovered: No space left on device"):
        load(there)
    (small_disk / "ballast").unlink()
    assert load(there).manifest["digest"] == load(left).manifest["digest"]


def test_new_run_into_the_folder_of_a_dead_one(folders: Folders) -> None:
    left, plan = left_behind(folders), make_plan(3, 5)
    said = r"holds a run whose process was killed \(`cosim report .*` recovers what it had recorded\); remove it, or"
    with pytest.raises(ConfigError, match=said):
        Recorder(plan, left).open()
    assert load(left).n_ticks == 11
    with pytest.raises(ConfigError, match=r"holds a run \(aborted: the process .* was killed.*\); remove it, or"):
        Recorder(plan, left).open()
    recorder = Recorder(plan, folders())
    recorder.open()
    with pytest.raises(ConfigError, match="a run is being recorded here; choose another folder with --out"):
        Recorder(plan, recorder.folder).open()
    recorder.close("aborted: by the test")


# --- real runs --------------------------------------------------------------------------------------------------------
ROOT = Path(__file__).parents[2]


def cosim(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "cosim", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, cwd=folder, env=environment, text=True, capture_output=True, check=False, timeout=120
    )


@pytest.mark.parametrize("tick", [2, 9])
def test_run_that_is_killed(tick: int, tmp_path: Path) -> None:
    from tests.distributed.networks import ring, scenario

    (tmp_path / "net.yaml").write_text(scenario(3, ring(3), faults={2: ("Killed", tick / 10 + 0.05)}))
    done = cosim(tmp_path, "run", "net.yaml", "--out", "dead", "--no-report")
    assert done.returncode == -signal.SIGKILL
    (tmp_path / "net.yaml").write_text(scenario(3, ring(3)))
    assert cosim(tmp_path, "run", "net.yaml", "--out", "whole", "--no-report").returncode == 0
    if tick % 2:
        again = cosim(tmp_path, "run", "net.yaml", "--out", "dead", "--no-report")
        assert again.returncode == 2
        assert "dead: error: the folder holds a run whose process was killed" in again.stderr
    report = cosim(tmp_path, "report", "dead")
    assert report.returncode == 0, report.stderr
    assert "was killed" in (tmp_path / "dead" / "report.html").read_text()
    dead, whole = load(tmp_path / "dead"), load(tmp_path / "whole")
    assert dead.manifest["status"] == (
        f"aborted: the process that recorded it was killed; recorded until t = {tick / 10:g} s"
    )
    assert dead.n_ticks == tick + 1
    assert np.array_equal(dead.array("node.x"), whole.array("node.x")[: tick + 1])
    known = [len(results.fates) for results in (dead, whole)]
    assert pq.read_table(tmp_path / "dead" / "deliveries.parquet").equals(
        pq.read_table(tmp_path / "whole" / "deliveries.parquet").slice(0, known[0])
    )
    assert dead.manifest["digest"] == digest_of(tmp_path / "dead")
    assert not list((tmp_path / "dead").glob(".*"))
