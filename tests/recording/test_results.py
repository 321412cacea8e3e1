"""A run folder is read back as it was written; what is no run folder is refused in words."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cosim.errors import ConfigError
from cosim.recording.recorder import Recorder
from cosim.results import load
from network.messages import Fate, Fates
from tests.recording.networks import Record, make_plan, record

Folders = Callable[[], Path]


def test_arrays_and_frames_agree(folders: Folders) -> None:
    plan, folder = make_plan(4, 30), folders()
    record(plan, folder, block_bytes=3000)
    results = load(folder)
    positions = results.array("plant.p")
    assert positions.shape == (31, 4, 2)
    assert results.agents == ("1", "2", "3", "4")
    assert results.n_ticks == len(results.time) == 31
    assert results.time[30] == 3.0
    frame = results.trajectories
    for k in range(2):
        table = frame.pivot(index="tick", columns="agent", values=f"plant.p[{k + 1}]")
        assert np.array_equal(table.to_numpy(), positions[:, :, k])
        assert np.array_equal(results.array(f"plant.p[{k + 1}]"), positions[:, :, k])
    assert np.array_equal(frame["time"], np.repeat(results.time, 4))
    assert list(frame["agent"].cat.categories) == list(results.agents)


@pytest.mark.parametrize("every", [1, 2, 7, 30, 100])
@pytest.mark.parametrize("stop", [None, 0, 1, 16, 99])
def test_part_of_the_ticks(folders: Folders, every: int, stop: int | None) -> None:
    folder = folders()
    record(make_plan(2, 30), folder, block_bytes=1000)
    results = load(folder)
    assert np.array_equal(results.array("plant.v", every, stop), results.array("plant.v")[:stop:every])
    assert np.array_equal(results.times(every), results.time[::every])


def test_shapes(folders: Folders) -> None:
    variables: Record = {"plant.x": ((), None), "plant.m": ((2, 3), "kg"), "plant.one": ((1,), None)}
    folder = folders()
    recorder = Recorder(make_plan(2, 1, record=[variables, {"plant.m": ((1, 3), "kg")}]), folder)
    recorder.open()
    for tick in range(2):
        recorder.tick(tick, np.concatenate([np.arange(8.0) + 10 * tick, -np.arange(3.0)]))
    recorder.close("complete")
    results = load(folder)
    assert results.array("plant.x").tolist()[1][0] == 10.0
    assert np.isnan(results.array("plant.x")[:, 1]).all()
    assert results.array("plant.m")[1, 0].tolist() == [[11, 12, 13], [14, 15, 16]]
    assert results.array("plant.m")[1, 1, 0].tolist() == [0, -1, -2]
    assert np.isnan(results.array("plant.m")[1, 1, 1]).all()
    assert results.array("plant.one").shape == (2, 2, 1)
    assert results.array("plant.m[2,3]")[0].tolist()[0] == 6.0
    assert (results.unit("plant.m"), results.unit("plant.x")) == ("kg", None)


def test_fates_agree_with_the_frame(folders: Folders) -> None:
    folder = folders()
    record(make_plan(4, 40), folder)
    results = load(folder)
    fates, frame = results.fates, results.deliveries
    assert len(fates) == len(frame) > 50
    for column in ("stamp", "sent", "arrival_ns"):
        assert np.array_equal(getattr(fates, column), frame[column])
    assert [results.agents[i] for i in fates.sender] == frame["sender"].tolist()
    assert [results.agents[i] for i in fates.receiver] == frame["receiver"].tolist()
    assert [Fate(i).name.lower() for i in fates.fate] == frame["fate"].tolist()
    arrived = ~frame["fate"].isin(["lost"])
    assert np.allclose(frame["arrival"][arrived], frame["arrival_ns"][arrived] / 1e9)


def test_first_fates_are_whole_row_groups(folders: Folders, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.recording.recorder.FATES_AT_ONCE", 20)
    folder = folders()
    record(make_plan(4, 40), folder)
    results = load(folder)
    for limit in (0, 1, 50, 10**9):
        some: Fates = results.first_fates(limit)
        assert np.array_equal(some.stamp, results.fates.stamp[: len(some)])
        assert 0 < len(some) <= max(limit, 40)
    assert len(results.first_fates(10**9)) == results.n_fates


def test_links_and_roles_come_from_the_manifest(folders: Folders) -> None:
    plan, folder = make_plan(5, 2), folders()
    record(plan, folder)
    results = load(folder)
    for name in ("sender", "receiver", "slot"):
        assert np.array_equal(getattr(results.links, name), getattr(plan.links, name))
    assert results.weights.tolist() == list(plan.weights)
    assert results.age_bound(0) == 1.3
    assert results.analysis["position"] == "plant.p"
    assert results.analysis["leaders"] == ["1", "4"]
    assert results.scenario == plan.scenario
    assert results.complete


def test_reading_arrays_imports_no_pandas(folders: Folders) -> None:
    folder = folders()
    record(make_plan(3, 5), folder)
    code = f"""
import sys
from cosim.results import load
results = load({str(folder)!r})
results.array("plant.p"), results.fates, results.n_ticks
assert "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


# --- what is no run folder --------------------------------------------------------------------------------------------
def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such folder"):
        load(tmp_path / "nothing")


def test_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="this is a file, not a run folder"):
        load(tmp_path / "file")


def test_another_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"this is no run folder: it has no manifest\.json$"):
        load(tmp_path)


def test_the_folder_above(tmp_path: Path) -> None:
    record(make_plan(2, 2), tmp_path / "run7")
    with pytest.raises(ConfigError, match=r"did you mean '.*run7'\?"):
        load(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 99}', "null"])
def test_manifest_that_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ConfigError, match=r"cannot be read|format .* is not the one"):
        load(tmp_path)


def test_run_that_goes_on(tmp_path: Path) -> None:
    recorder = Recorder(make_plan(2, 2), tmp_path / "run")
    recorder.open()
    with pytest.raises(ConfigError, match="the run is still going on; there is nothing to read yet"):
        load(tmp_path / "run")
    recorder.close("aborted: by the test")
    assert not load(tmp_path / "run").complete


@pytest.mark.parametrize("name", ["trajectories.parquet", "deliveries.parquet"])
def test_tables_that_are_missing_or_broken(folders: Folders, name: str) -> None:
    folder = folders()
    record(make_plan(2, 2), folder)
    (folder / name).write_bytes(b"PAR1 no more")
    with pytest.raises(ConfigError, match=f"{name}: error: cannot be read"):
        read_both(folder)
    (folder / name).unlink()
    with pytest.raises(ConfigError, match=f"{name}: error: the run folder lacks this file"):
        read_both(folder)


def read_both(folder: Path) -> None:
    results = load(folder)
    results.array("plant.p")
    assert len(results.fates)


def test_unknown_variable(folders: Folders) -> None:
    folder = folders()
    record(make_plan(2, 2), folder)
    with pytest.raises(ConfigError, match=r"'plant.pp' was not recorded \(did you mean 'plant.p'\?\)"):
        load(folder).array("plant.pp")


def test_manifest_is_json_with_one_agent_per_line(folders: Folders) -> None:
    folder = folders()
    record(make_plan(3, 2), folder)
    text = (folder / "manifest.json").read_text()
    assert json.loads(text)["agents"][2]["name"] == "3"
    assert sum(line.startswith('    {"name": ') for line in text.splitlines()) == 3


def test_pandas_reads_the_files_directly(folders: Folders) -> None:
    folder = folders()
    record(make_plan(3, 2), folder)
    frame = pd.read_parquet(folder / "trajectories.parquet", columns=["agent", "plant.p[2]"])
    assert frame["agent"].tolist() == ["1", "2", "3"] * 3
    assert np.array_equal(frame["plant.p[2]"], load(folder).array("plant.p")[:, :, 1].ravel())
