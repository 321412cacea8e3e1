"""The folder of a run, and the files in it: whose they are, and what they look like to others."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cosim.recording.atomic import remove_left, write_atomically
from cosim.recording.lock import RUN, FolderLock
from cosim.results import load
from cosim.running.folder import run_folder
from tests.components.misbehaving import cosim, scenario


def test_runs_of_one_second_have_a_folder_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though nothing is in them yet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda _: "2026-01-01T00-00-00")
    with run_folder("net", None) as one, run_folder("net", None) as other:
        assert [folder.name for folder in (one, other)] == ["2026-01-01T00-00-00", "2026-01-01T00-00-00-1"]
        (one / "manifest.json").touch()
    assert [path.name for path in (tmp_path / "runs" / "net").iterdir()] == [one.name]
    with run_folder("other", Path("out")) as out:
        assert not out.exists()


def test_a_mistake_leaves_no_folder(tmp_path: Path) -> None:
    text = scenario(Path("none.fmu"), "nothing")
    assert cosim(tmp_path, "run", "net.yaml", text=text).returncode == 2
    assert cosim(tmp_path, "run", "channel_sine", "--workers", "9").returncode == 2
    assert not (tmp_path / "runs").exists()


def test_a_folder_that_another_run_has_begun_to_fill(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    lock = FolderLock(tmp_path / "out", RUN)
    try:
        done = cosim(tmp_path, "run", "channel_sine", "--until", "1 s", "--out", "out")
    finally:
        lock.release()
    assert done.returncode == 2
    assert "out: error: a run is being recorded here; choose another folder with --out" in done.stderr


def test_whoever_writes_a_file_writes_all_of_it(tmp_path: Path) -> None:
    file, texts = tmp_path / "report.html", {letter: letter * 100_000 for letter in "abc"}
    written = threading.Event()

    def write(text: str) -> None:
        for _ in range(100):
            write_atomically(file, text)
            written.set()

    with ThreadPoolExecutor() as pool:
        writers = [pool.submit(write, text) for text in texts.values()]
        written.wait(60)
        while not all(writer.done() for writer in writers):
            assert file.read_text() in texts.values()
        for writer in writers:
            writer.result()
    assert list(tmp_path.iterdir()) == [file]


def test_what_a_writer_left_that_was_killed_can_be_removed(tmp_path: Path) -> None:
    file, other = tmp_path / "manifest.json", tmp_path / ".other.json.1.new"
    for path in (tmp_path / ".manifest.json.1.new", file, other):
        path.touch()
    remove_left(file)
    assert set(tmp_path.iterdir()) == {file, other}


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"none/report\.html") as caught:
        write_atomically(tmp_path / "none" / "report.html", "")
    assert caught.value.filename == str(tmp_path / "none" / "report.html")


def test_an_fmu_that_prints_while_the_error_is_estimated(probes: dict[int, Path], tmp_path: Path) -> None:
    text = scenario(probes[3], "step_prints")
    done = cosim(tmp_path, "run", "net.yaml", "--estimate-error", "--out", "out", "--no-report", text=text)
    assert done.returncode == 0, done.stderr
    assert "coupling_error" in load(tmp_path / "out").manifest
    assert (tmp_path / "out" / "logs" / "output.log").read_text()


def test_an_fmu_that_fails_while_the_error_is_estimated(probes: dict[int, Path], tmp_path: Path) -> None:
    text = scenario(probes[3], "step_crashes")
    done = cosim(tmp_path, "run", "net.yaml", "--estimate-error", "--out", "out", "--no-report", text=text)
    assert done.returncode == 3
    assert "error: agent bad, component probe, at t = 0.3" in done.stderr
    assert load(tmp_path / "out").manifest["status"].startswith("aborted: agent bad, component probe, at t = 0.3")
    assert (tmp_path / "out" / "logs" / "output.log").read_text()
