"""What was taken from outside is on disk before it is used, and a recording that is not one is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.bridge.replay import Replay
from cosim.errors import ConfigError
from cosim.plan import BridgePlan, Subscription
from cosim.recording.recorder import Recorder
from cosim.results import load
from network.payload import Encoding
from tests.bridge.labs import planned, scenario

SUBSCRIBE = tuple(Subscription(key, Encoding.JSON, size, -9.0, 9.0, False) for key, size in (("a", 1), ("b", 2)))
ROWS = {"tick": [0, 2, 2], "key": ["b", "a", "b"], "value[1]": [1.0, 2.0, 3.0], "value[2]": [4.0, None, 5.0]}


def test_it_survives_the_process(tmp_path: Path) -> None:
    """A copy of the folder is what a process that is killed now would leave."""
    plan = planned(tmp_path, scenario("tcp/127.0.0.1:7447"))
    recorder = Recorder(plan, tmp_path / "run")
    recorder.open()
    keys = [subscription.key for subscription in plan.bridge.subscribe]
    recorder.external(0, {keys.index("lab/2/u"): np.array([0.1, -0.2]), keys.index("lab/1/u"): np.array([7.0, 8.0])})
    recorder.external(3, {})
    recorder.external(4, {keys.index("lab/never"): np.array([1e-300, 5.0])})
    shutil.copytree(tmp_path / "run", tmp_path / "killed")
    load(tmp_path / "killed")
    recorder.close("complete")
    for folder in ("run", "killed"):
        table = pq.read_table(tmp_path / folder / "external.parquet")
        assert table.to_pydict() == {
            "tick": [0, 0, 4],
            "key": ["lab/1/u", "lab/2/u", "lab/never"],
            "value[1]": [7.0, 0.1, 1e-300],
            "value[2]": [8.0, -0.2, 5.0],
        }
        assert not (tmp_path / folder / ".external").exists()


def replay(tmp_path: Path, **changes: object) -> Replay:
    pq.write_table(pa.table({**ROWS, **changes}), tmp_path / "x.parquet")
    return Replay(BridgePlan(subscribe=SUBSCRIBE, replay=tmp_path / "x.parquet"))


def test_a_recording_is_replayed(tmp_path: Path) -> None:
    found = replay(tmp_path)
    assert [{i: v.tolist() for i, v in found.take(tick).items()} for tick in range(4)] == [
        {1: [1.0, 4.0]},
        {},
        {0: [2.0], 1: [3.0, 5.0]},
        {},
    ]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"key": ["b", "a", "c"]}, "nothing subscribes to 'c'"),
        ({"value[1]": [1.0, float("nan"), 3.0]}, "at tick 2, 'a' has other than 1 finite number"),
        ({"value[1]": [1.0, 99.0, 3.0]}, "at tick 2, 'a' has a number that is not from -9 to 9"),
        ({"value[2]": [4.0, 4.0, 5.0]}, "at tick 2, 'a' has other than 1 finite number"),
        ({"value[2]": [4.0, None, None]}, "at tick 2, 'b' has other than 2 finite numbers"),
        ({"value[1]": ["1", "2", "3"]}, "it is no table of ticks, keys and values"),
        ({"tick": [0.0, 0.5, 2.0]}, "it is no table of ticks, keys and values"),
        ({"tick": [0, None, 2]}, "it is no table of ticks, keys and values"),
        ({"key": [1, 2, 3]}, "nothing subscribes to"),
    ],
)
def test_what_is_no_recording(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        replay(tmp_path, **changes)
    assert str(caught.value).startswith(f"{tmp_path / 'x.parquet'}: error: cannot be replayed: ")
    assert said in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PAR1", b"tick,key\n"])
def test_a_file_of_another_kind(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.parquet").write_bytes(content)
    with pytest.raises(ConfigError, match="it is no table of ticks, keys and values"):
        Replay(BridgePlan(subscribe=SUBSCRIBE, replay=tmp_path / "x.parquet"))
