"""`external.parquet`: which values a run took from outside, at which tick; enough to replay it.

While the run goes on, what is taken lies in `.external`, handed to the kernel before anybody uses it, so that it
survives the process. `convert` makes the table of it, at the end of the run or after its process was killed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cosim.plan import EXTERNAL, Subscription
from cosim.recording.frames import frame, frames, write
from cosim.recording.table import float_array, int_array, name_array
from network.messages import Floats

LOG = ".external"

_HEAD, _TAKEN = 1, 2
_FORMAT = 1
_ROWS_AT_ONCE = 1 << 16


class ExternalLog:
    """The writing end.

    Args:
        folder: the run folder.
        subscribe: the keys; at least one.

    Raises:
        OSError: the file cannot be created, or the disk is full already.
    """

    def __init__(self, folder: Path, subscribe: Sequence[Subscription]) -> None:
        self._file = (folder / LOG).open("xb", buffering=0)
        keys = {subscription.key: subscription.size for subscription in subscribe}
        try:
            self._append(_HEAD, json.dumps(keys).encode())
        except OSError:
            self.close()
            raise

    def add(self, tick: int, taken: Mapping[int, Floats]) -> None:
        """Record what was taken at a tick.

        Raises:
            OSError: the disk is full.
        """
        for index, values in sorted(taken.items()):
            self._append(_TAKEN, np.array([tick, index], "<i8").tobytes() + values.astype("<f8").tobytes())

    def _append(self, kind: int, content: bytes) -> None:
        write(self._file.fileno(), frame(kind, _FORMAT, len(content), content))

    def close(self) -> None:
        """Leave the file as it is."""
        self._file.close()


def convert(folder: Path) -> None:
    """Make the table of what a run has taken, if it takes anything and that is not done yet.

    Raises:
        OSError: the table cannot be written; it can be tried again.
        ValueError: what is there does not begin as it should.
    """
    log = folder / LOG
    if not log.exists():
        return
    import pyarrow as pa
    import pyarrow.parquet as pq

    records = frames(memoryview(log.read_bytes()), _FORMAT)
    kind, head = next(records, (0, memoryview(b"")))
    if kind != _HEAD:
        raise ValueError(f"{LOG} does not begin as it should")
    sizes: dict[str, int] = json.loads(bytes(head))
    width = max(sizes.values())
    columns = ["tick", "key", *(f"value[{i + 1}]" for i in range(width))]
    new = folder / f".{EXTERNAL}.new"
    groups = _groups(records, list(sizes), width)
    first = pa.Table.from_arrays(next(groups), names=columns)
    with pq.ParquetWriter(new, first.schema, compression="zstd", store_schema=False) as writer:
        writer.write_table(first)
        for arrays in groups:
            writer.write_table(pa.Table.from_arrays(arrays, names=columns))
    new.replace(folder / EXTERNAL)
    log.unlink()


def _groups(records: Iterator[tuple[int, memoryview]], keys: Sequence[str], width: int) -> Iterator[list[Any]]:
    """The columns of one row group after the other: tick, key, and values, null beyond the last; at least one group."""
    empty = True
    while (group := list(islice(records, _ROWS_AT_ONCE))) or empty:
        empty = False
        numbers = np.full((len(group), width), np.nan)
        places = np.zeros((2, len(group)), np.int64)
        for row, (_, content) in enumerate(group):
            places[:, row] = np.frombuffer(content, "<i8", 2)
            values = np.frombuffer(content, "<f8", offset=16)
            numbers[row, : len(values)] = values
        arrays = [float_array(column, ~np.isnan(column)) for column in numbers.T]
        yield [int_array(places[0]), name_array(places[1], keys), *arrays]
