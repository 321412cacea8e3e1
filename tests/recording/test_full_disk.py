"""When the disk fills up, what was computed stays readable and the manifest says what happened."""

import errno
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cosim.errors import ConfigError
from cosim.recording import table
from cosim.recording.recorder import Recorder, RecordingError
from cosim.recording.table import TableFile, allocate, float_array
from cosim.results import load
from tests.recording.networks import make_plan
from tests.recording.test_recorder import digest_of, some_fates

N_AGENTS = 20
TICKS = 3000
BLOCK_BYTES = 400_000


def fill(folder: Path) -> None:
    """Record numbers that do not compress until the run, or the disk, ends."""
    plan, rng = make_plan(N_AGENTS, TICKS), np.random.default_rng(1)
    recorder = Recorder(plan, folder, block_bytes=BLOCK_BYTES)
    recorder.open()
    status = "complete"
    try:
        for tick in range(TICKS + 1):
            recorder.tick(tick, rng.normal(size=N_AGENTS * 11))
            recorder.fates(some_fates(5, N_AGENTS, rng))
    except RecordingError as error:
        status = f"aborted: {error}"
    try:
        recorder.close(status)
    except RecordingError as error:
        sys.exit(f"close: {error}")
    if status != "complete":
        sys.exit(status)


def check(folder: Path, reason: str) -> int:
    """Everything that the folder holds is consistent; the number of recorded ticks."""
    results = load(folder)
    assert results.manifest["status"].startswith("aborted: cannot write ")
    assert reason in results.manifest["status"]
    assert results.manifest["ticks"] == {"planned": TICKS, "done": results.n_ticks - 1}
    assert results.manifest["digest"] == digest_of(folder)
    first = np.random.default_rng(1).normal(size=(N_AGENTS, 11))
    assert np.array_equal(results.array("plant.p")[0], first[:, :2])
    assert not list(folder.glob(".*"))
    return results.n_ticks


def run_limited(folder: Path, *prelude: str) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).parents[2]
    lines = [*prelude, "from pathlib import Path", "from tests.recording.test_full_disk import fill"]
    code = "; ".join([*lines, f"fill(Path({str(folder)!r}))"])
    return subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)


@pytest.mark.skipif(os.name != "posix", reason="needs RLIMIT_FSIZE")
@pytest.mark.parametrize("limit", [1_000_000, 1_234_567, 3_000_000])
def test_limit_on_the_size_of_files(tmp_path: Path, limit: int) -> None:
    folder = tmp_path / "run"
    prelude = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, resource.RLIM_INFINITY))"
    done = run_limited(folder, prelude)
    assert "File too large" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
    n_ticks = check(folder, "File too large")
    size = (folder / "trajectories.parquet").stat().st_size
    assert 0.8 * limit < size <= limit  # the block that did not fit whole was written in part
    assert n_ticks > 400


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MB."""
    mount = tmp_path / "disk"
    mount.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(mount)]
    if sys.platform != "linux" or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("this user may not mount a file system")
    yield mount
    subprocess.run(["umount", "--lazy", str(mount)], check=True)


def test_full_file_system(small_disk: Path) -> None:
    folder = small_disk / "run"
    done = run_limited(folder)
    assert "No space left on device" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
    check(folder, "No space left on device")
    used = sum(path.stat().st_size for path in folder.iterdir())
    assert used > 3_000_000


def leave(disk: Path, blocks: int) -> None:
    """Fill a disk but for a few blocks."""
    free = os.statvfs(disk)
    with (disk / "ballast").open("xb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, (free.f_bavail - blocks) * free.f_bsize)


def test_disk_that_is_full_from_the_start(small_disk: Path) -> None:
    leave(small_disk, 1)
    folder = small_disk / "run"
    with pytest.raises(ConfigError, match="cannot write the run folder: No space left on device"):
        Recorder(make_plan(2, 5), folder).open()
    assert not folder.exists() or not list(folder.iterdir())


def test_disk_that_is_full_at_the_end(small_disk: Path) -> None:
    """The whole run is one block: the spool has kept room for it."""
    folder = small_disk / "run"
    recorder = Recorder(make_plan(2, 2000), folder)
    recorder.open()
    for tick in range(2001):
        recorder.tick(tick, np.random.default_rng(tick).normal(size=22))
    leave(small_disk, 0)
    recorder.close("complete")
    results = load(folder)
    assert results.n_ticks == 2001
    assert results.manifest["digest"] == digest_of(folder)
    assert not list(folder.glob(".*"))


def test_complete_becomes_aborted_when_the_last_block_does_not_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(make_plan(2, 10, record={"plant.x": ((), None)}), tmp_path / "run")
    recorder.open()
    for tick in range(10):
        recorder.tick(tick, np.ones(2))

    def full(descriptor: int, start: int, end: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(table, "allocate", full)
    with pytest.raises(RecordingError, match=r"trajectories\.parquet: No space left on device; the run is recorded"):
        recorder.close("complete")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["status"].startswith("aborted: cannot write ")
    assert pq.read_table(tmp_path / "run" / "trajectories.parquet").num_rows == 0


def test_space_is_reserved_beyond_what_any_group_needs(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for kind, values in {"noise": rng.normal(size=50_000), "constant": np.ones(50_000), "one": np.ones(1)}.items():
        columns = [(f"{kind}.x[{i}]", "float64") for i in range(30)]
        file = TableFile(tmp_path / f"{kind}.parquet", columns)
        for _ in range(20):
            assert file.append([float_array(values)] * 30) == len(values)
            reserved = file.path.stat().st_size
        file.close()
        assert file.path.stat().st_size < reserved
        assert pq.ParquetFile(file.path).num_row_groups == 20


def test_platforms_without_fallocate_write_zeros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    with (tmp_path / "file").open("xb", buffering=0) as file:
        file.write(b"abc")
        allocate(file.fileno(), 3, 200_000)
        file.write(b"def")
    assert (tmp_path / "file").read_bytes() == b"abcdef" + bytes(200_000 - 6)


@pytest.mark.skipif(os.name != "posix", reason="needs RLIMIT_FSIZE")
def test_platforms_without_fallocate_notice_a_full_disk(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    prelude = "import os, resource; del os.posix_fallocate; "
    prelude += "resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))"
    done = run_limited(folder, prelude)
    assert "File too large" in done.stderr, done.stderr
    check(folder, "File too large")
