"""A run folder follows the contract, whatever is recorded and however it is cut into row groups."""

import hashlib
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.errors import ConfigError
from cosim.plan import Plan
from cosim.recording.columns import Columns, scalar_names
from cosim.recording.recorder import Recorder
from network.messages import NEVER, Fate, Fates
from tests.recording.networks import VARIABLES, Record, make_plan, record

Folders = Callable[[], Path]
FATES = ["delivered", "superseded", "lost", "in_flight"]


def digest_of(folder: Path) -> str:
    """The digest as `cosim.recording.digest` defines it, from the files alone and one number at a time."""
    manifest = json.loads((folder / "manifest.json").read_text())
    names = [agent["name"] for agent in manifest["agents"]]
    rows, fates = hashlib.sha256(), hashlib.sha256()
    recorded: dict[str, list[str]] = {}
    table = pq.read_table(folder / "trajectories.parquet")
    for row in table.to_pylist():
        recorded[row["agent"]] = [name for name in table.column_names[3:] if row[name] is not None]
        for name in recorded[row["agent"]]:
            rows.update(struct.pack("<d", row[name]))
    for row in pq.read_table(folder / "deliveries.parquet").to_pylist():
        indices = names.index(row["sender"]), names.index(row["receiver"])
        code = FATES.index(row["fate"])
        fates.update(struct.pack("<6q", *indices, row["stamp"], row["sent"], row["arrival_ns"], code))
    header = {
        "agents": [[name, recorded[name]] for name in names],
        "format": 1,
        "period_ns": manifest["period_ns"],
    }
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    return hashlib.sha256(text + rows.digest() + fates.digest()).hexdigest()


def some_fates(n: int, n_agents: int, rng: np.random.Generator) -> Fates:
    fate = rng.integers(0, len(Fate), n)
    arrival = np.where(fate == Fate.LOST, NEVER, rng.integers(0, 10**12, n))
    agents = rng.integers(0, n_agents, (2, n))
    return Fates(agents[0], agents[1], rng.integers(0, 99, n), rng.integers(0, 99, n), arrival, fate)


def test_schema(folders: Folders) -> None:
    folder = folders()
    record(make_plan(3, 20), folder)
    trajectories = pq.ParquetFile(folder / "trajectories.parquet").schema_arrow
    scalars = ["plant.p[1]", "plant.p[2]", "plant.v[1]", "plant.v[2]", "controller.v_hat[1]", "controller.v_hat[2]"]
    scalars += [f"controller.theta_hat[{i}]" for i in range(1, 6)]
    assert trajectories.names == ["tick", "time", "agent", *scalars]
    assert trajectories.types == [pa.int64(), pa.float64(), pa.string(), *[pa.float64()] * len(scalars)]
    deliveries = pq.ParquetFile(folder / "deliveries.parquet").schema_arrow
    assert dict(zip(deliveries.names, deliveries.types, strict=True)) == {
        "sender": pa.string(),
        "receiver": pa.string(),
        "stamp": pa.int64(),
        "sent": pa.int64(),
        "arrival": pa.float64(),
        "arrival_ns": pa.int64(),
        "fate": pa.string(),
    }


def test_rows_are_by_tick_then_agent(folders: Folders) -> None:
    folder = folders()
    record(make_plan(3, 20), folder)
    table = pq.read_table(folder / "trajectories.parquet")
    assert table.column("tick").to_pylist() == [tick for tick in range(21) for _ in range(3)]
    assert table.column("time").to_pylist() == [tick * 100_000_000 / 1e9 for tick in range(21) for _ in range(3)]
    assert table.column("agent").to_pylist() == ["1", "2", "3"] * 21


def test_fates_come_back(folders: Folders) -> None:
    plan, folder, rng = make_plan(4, 1, record={}), folders(), np.random.default_rng(3)
    fates = [some_fates(n, 4, rng) for n in (3, 0, 50, 1)]
    recorder = Recorder(plan, folder)
    recorder.open()
    for tick in range(2):
        recorder.tick(tick, np.empty(0))
    for some in fates:
        recorder.fates(some)
    recorder.close("complete")
    rows = pq.read_table(folder / "deliveries.parquet").to_pylist()
    assert [row["sender"] for row in rows] == [str(i + 1) for some in fates for i in some.sender]
    assert [row["receiver"] for row in rows] == [str(i + 1) for some in fates for i in some.receiver]
    for column in ("stamp", "sent", "arrival_ns"):
        assert [row[column] for row in rows] == [x for some in fates for x in getattr(some, column).tolist()]
    assert [row["fate"] for row in rows] == [FATES[i] for some in fates for i in some.fate]
    for row in rows:
        assert row["arrival"] == (None if row["fate"] == "lost" else row["arrival_ns"] / 1e9)


def test_digest_follows_its_definition(folders: Folders) -> None:
    folder = folders()
    digest = record(make_plan(5, 40), folder)
    assert digest == json.loads((folder / "manifest.json").read_text())["digest"] == digest_of(folder)


def test_agents_may_record_different_things_in_any_order(folders: Folders) -> None:
    first: Record = {"plant.p": ((2,), "rad"), "plant.energy": ((), "J")}
    second: Record = {"controller.gain": ((2, 2), None), "plant.energy": ((), "J"), "plant.p": ((2,), "rad")}
    plan, folder = make_plan(3, 4, record=[first, second, {}]), folders()
    rows = [np.array([1.0, 2.0, 3.0]), np.array([-1.0, -2.0, -3.0, -4.0, 30.0, 10.0, 20.0]), np.empty(0)]
    recorder = Recorder(plan, folder)
    recorder.open()
    for tick in range(5):
        recorder.tick(tick, np.concatenate(rows) + tick)
    digest = recorder.close("complete")
    table = pq.read_table(folder / "trajectories.parquet")
    gains = ["controller.gain[1,1]", "controller.gain[1,2]", "controller.gain[2,1]", "controller.gain[2,2]"]
    names = ["plant.p[1]", "plant.p[2]", "plant.energy", *gains]
    assert table.column_names[3:] == names
    expected = [[1, 2, 3, None, None, None, None], [10, 20, 30, -1, -2, -3, -4], [None] * 7]
    for row, values in zip(table.slice(6, 3).to_pylist(), expected, strict=True):
        assert row["tick"] == 2
        assert [row[name] for name in names] == [None if x is None else x + 2 for x in values]
    assert digest == digest_of(folder)


@settings(max_examples=25, deadline=None)
@given(
    block_bytes=st.integers(1, 20_000),
    ticks=st.integers(0, 60),
    n=st.integers(1, 4),
    keep=st.sets(st.sampled_from([*VARIABLES])),
)
def test_row_groups_change_nothing(
    tmp_path_factory: pytest.TempPathFactory, block_bytes: int, ticks: int, n: int, keep: set[str]
) -> None:
    variables = {name: VARIABLES[name] for name in VARIABLES if name in keep}
    plan = make_plan(n, ticks, record=variables, links=None if n > 1 else make_plan(2).links)
    plan = plan if n > 1 else without_links(plan)
    folder = tmp_path_factory.mktemp("runs")
    digests = {record(plan, folder / "cut", block_bytes=block_bytes), record(plan, folder / "whole")}
    assert len(digests) == 1
    cut, whole = (pq.read_table(folder / name / "trajectories.parquet") for name in ("cut", "whole"))
    assert cut.equals(whole)
    assert cut.num_rows == n * (ticks + 1)


def without_links(plan: Plan) -> Plan:
    """One agent that hears nobody."""
    empty = np.empty(0, dtype=np.int64)
    links = replace(plan.links, agents=plan.links.agents[:1], sender=empty, receiver=empty, slot=empty)
    agent = replace(plan.agents[0], name=links.agents[0], neighbours=(), weights=())
    return replace(plan, links=links, weights=(), link_channel=(), agents=(agent,))


def test_fates_in_blocks_change_nothing(folders: Folders, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_plan(5, 60)
    whole, cut = folders(), folders()
    digest = record(plan, whole)
    monkeypatch.setattr("cosim.recording.recorder.FATES_AT_ONCE", 7)
    assert record(plan, cut) == digest
    assert pq.ParquetFile(cut / "deliveries.parquet").num_row_groups > 10
    assert pq.read_table(cut / "deliveries.parquet").equals(pq.read_table(whole / "deliveries.parquet"))


def test_every_bit_counts(folders: Folders) -> None:
    """Signs of zero, signalling NaNs and subnormals survive, and change the digest."""
    patterns = np.array([0, 1 << 63, 0x7FF0_0000_0000_0001, 0xFFF8_0000_0000_0123, 1, 0x7FF0 << 48], dtype=np.uint64)
    plan = make_plan(2, 0, record={"plant.x": ((6,), None)})
    digests = set()
    for flipped in range(7):
        values = patterns.copy()
        values[:flipped] ^= np.uint64(1)
        folder = folders()
        recorder = Recorder(plan, folder)
        recorder.open()
        recorder.tick(0, np.tile(values.view(np.float64), 2))
        digests.add(recorder.close("complete"))
        table = pq.read_table(folder / "trajectories.parquet")
        read = np.concatenate([table.column(name).to_numpy() for name in scalar_names("plant.x", (6,))])
        assert np.array_equal(read.view(np.uint64), np.repeat(values, 2))
    assert len(digests) == 7


def test_names_and_period_are_bound_into_the_digest(folders: Folders) -> None:
    plan = make_plan(2, 5)
    renamed = replace(plan, agents=(replace(plan.agents[0], name="other"), plan.agents[1]))
    slower = replace(plan, period_ns=plan.period_ns + 1)
    digests = set()
    for variant in (plan, renamed, slower):
        recorder = Recorder(variant, folders())
        recorder.open()
        for tick in range(6):
            recorder.tick(tick, np.tile(np.arange(11.0), 2))
        digests.add(recorder.close("complete"))
    assert len(digests) == 3


def test_rows_are_copied(folders: Folders) -> None:
    plan, folder = make_plan(2, 2, record={"plant.x": ((), None)}), folders()
    recorder = Recorder(plan, folder)
    recorder.open()
    row = np.zeros(2)
    for tick in range(3):
        row[:] = tick
        recorder.tick(tick, row)
    recorder.close("complete")
    assert pq.read_table(folder / "trajectories.parquet").column("plant.x").to_pylist() == [0, 0, 1, 1, 2, 2]


def test_ticks_come_in_order(folders: Folders) -> None:
    recorder = Recorder(make_plan(2, 5, record={}), folders())
    recorder.open()
    recorder.tick(0, np.empty(0))
    with pytest.raises(ValueError, match="tick 2 was recorded after tick 0"):
        recorder.tick(2, np.empty(0))
    recorder.close("aborted: by the test")


def test_manifest_while_running_and_after(folders: Folders) -> None:
    plan, folder = make_plan(3, 20), folders()
    recorder = Recorder(plan, folder, {"processes": 4})
    recorder.open()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["status"], manifest["digest"], manifest["processes"]) == ("running", None, 4)
    assert manifest["ticks"] == {"planned": 20, "done": 0}
    assert (folder / "scenario.yaml").read_text() == plan.scenario
    recorder.close("aborted: by the test")
    finished = folders()
    digest = record(plan, finished)
    manifest = json.loads((finished / "manifest.json").read_text())
    assert (manifest["status"], manifest["digest"]) == ("complete", digest)
    assert (manifest["name"], manifest["title"], manifest["seed"]) == ("arms", plan.title, 7)
    assert manifest["ticks"] == {"planned": 20, "done": 20}
    assert manifest["simulated_s"] == 2.0
    assert 0 < manifest["start_s"] <= manifest["wall_s"]
    assert manifest["speed"] == pytest.approx(2.0 / manifest["wall_s"], rel=1e-2)
    assert manifest["config_sha256"] == hashlib.sha256(plan.scenario.encode()).hexdigest()
    assert {"python", "numpy", "fmpy", "pyarrow"} <= set(manifest["versions"])
    assert [entry["instances"] for entry in manifest["components"]] == [3, 3]
    assert manifest["links"]["weight"] == list(plan.weights)
    assert manifest["channels"]["paper"]["age_bound_ns"] == 1_300_000_000
    assert manifest["analysis"]["lambda"] == {"1": 13.0, "2": 13.0, "3": 13.0}
    assert sorted(path.name for path in finished.iterdir()) == [
        "deliveries.parquet",
        "manifest.json",
        "scenario.yaml",
        "trajectories.parquet",
    ]


def test_aborted_run_keeps_what_it_has(folders: Folders) -> None:
    plan = make_plan(3, 50)
    folder, shorter = folders(), folders()
    digest = record(plan, folder, status="aborted: interrupted at t = 3.1 s", ticks=31)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["status"] == "aborted: interrupted at t = 3.1 s"
    assert manifest["ticks"] == {"planned": 50, "done": 31}
    assert digest == digest_of(folder) == record(replace(plan, ticks=31), shorter)


def test_aborted_before_the_first_tick(folders: Folders) -> None:
    folder = folders()
    recorder = Recorder(make_plan(3, 50), folder)
    recorder.open()
    recorder.close("aborted: agent 2 did not start")
    assert pq.read_table(folder / "trajectories.parquet").num_rows == 0
    assert pq.read_table(folder / "deliveries.parquet").num_rows == 0
    assert json.loads((folder / "manifest.json").read_text())["ticks"]["done"] == 0


def test_occupied_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match="not empty; remove it, or choose another one with --out"):
        Recorder(make_plan(2, 5), tmp_path).open()
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_path_that_cannot_be_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ConfigError, match="cannot write the run folder"):
            Recorder(make_plan(2, 5), folder).open()


@given(shape=st.lists(st.integers(0, 4), max_size=3).map(tuple))
def test_scalar_names_are_row_major_from_one(shape: tuple[int, ...]) -> None:
    names = scalar_names("a.x", shape)
    expected = [f"a.x[{','.join(str(i + 1) for i in index)}]" for index in np.ndindex(shape)] if shape else ["a.x"]
    assert names == expected


def test_columns_of_equal_agents_need_no_reordering() -> None:
    columns = Columns.of(make_plan(4, 1).agents)
    assert columns.source is None
    assert columns.positions.T.reshape(-1).tolist() == list(range(columns.width))
