"""What a run has recorded and no finished Parquet file holds yet, kept so that it survives the process.

Two hidden files lie beside the tables of a run that goes on:

- `.spool` has the ticks since the last row group, handed to the kernel as soon as they are known: a record has the rows
  of one or several, and the fates before the last of them. Later ones belong to a period that is not complete;
- `.groups` has the layout, the metadata of every row group, and where each table stood after it.

A row group counts once `.groups` says so; `.spool` then begins anew, with another seed for its records (see `frames`),
so that a process killed between the two leaves nothing that could be read twice. Space for `.spool` is taken ahead of
its records, as much as their row group will need: when the disk is full, dropping it makes room for what it held.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.recording.frames import frame, frames, write
from cosim.recording.manifest import GROUPS, SPOOL
from cosim.recording.table import FULL, Finished, allocate
from cosim.recording.tables import FATE_BYTES, Layout, RunTables
from network.messages import Floats, Ints

_FORMAT = 2
_SLACK_BYTES = 1 << 16
_HEAD_BYTES = 8  # how many ticks


_LAYOUT, _TICKS, _GROUP, _STAND = range(1, 5)


class Spool:
    """The writing end. `record` records; `finish` tells that all of it is in the tables.

    Args:
        folder: the run folder.
        layout: of what will come.
        tables: to which it will go.

    Raises:
        OSError: the files cannot be created, or the disk is full already.
    """

    def __init__(self, folder: Path, layout: Layout, tables: RunTables) -> None:
        self._paths = folder / SPOOL, folder / GROUPS
        self._groups = self._paths[1].open("xb", buffering=0)
        try:
            self._spool = self._paths[0].open("xb", buffering=0)
        except BaseException:
            self._groups.close()
            raise
        self._descriptor = self._spool.fileno()
        self._unsaved: list[bytes] = []
        self._seed = 0
        self._end = 0
        self._allocated = 0
        self._least = tables.room(0, 0) + _SLACK_BYTES
        per_tick = (tables.room(1000, 0) - tables.room(0, 0)) / 1000 / max(8, 8 * layout.width)
        self._per_byte = max(1.0, per_tick, (tables.room(0, 1000) - tables.room(0, 0)) / 1000 / FATE_BYTES)
        try:
            head = layout.encode()
            write(self._groups.fileno(), frame(_LAYOUT, _FORMAT, len(head), head))
            self.take_room()
        except BaseException:
            self.close()
            raise

    def record(self, values: Floats, fates: Sequence[Ints]) -> None:
        """Hand ticks to the kernel.

        Args:
            values: (n_ticks, width) as they arrived; contiguous.
            fates: (6, n) each; since the last tick that was recorded, and before the last of these.

        Raises:
            OSError: the disk is full.
        """
        if len(fates) > 1:
            fates = (stacked(fates),)
        head = len(values).to_bytes(_HEAD_BYTES, "little")
        size = _HEAD_BYTES + values.nbytes + sum(table.nbytes for table in fates)
        record = frame(_TICKS, self._seed, size, head, *fates, values)
        end = self._end + len(record)
        if end > self._limit:
            self._grow(end)
        write(self._descriptor, record)
        self._end = end

    def finish(self, tables: RunTables) -> None:
        """All that was recorded is in row groups: note where the tables stand, and begin anew.

        Raises:
            OSError: the disk is full. Nothing has changed, and it may be called again.
        """
        self._unsaved += [
            frame(_GROUP, _FORMAT, len(group) + 1, bytes((i,)), group)
            for i, table in enumerate(tables.files)
            for group in table.new_groups()
        ]
        stand = np.array([table.end for table in tables.files], dtype="<i8")
        here = os.lseek(self._groups.fileno(), 0, os.SEEK_CUR)
        try:
            write(self._groups.fileno(), b"".join((*self._unsaved, frame(_STAND, _FORMAT, stand.nbytes, stand))))
        except OSError:
            os.ftruncate(self._groups.fileno(), here)
            os.lseek(self._groups.fileno(), here, os.SEEK_SET)
            raise
        self._unsaved = []
        self._seed += 1
        self._end = 0
        os.lseek(self._spool.fileno(), 0, os.SEEK_SET)

    def drop(self) -> None:
        """Give the space back. What is not in a row group yet is then in the caller's hands alone."""
        os.ftruncate(self._spool.fileno(), 0)
        self._end = self._allocated = 0

    def take_room(self) -> None:
        """Have space for some records at least.

        Raises:
            OSError: the disk is full.
        """
        self._grow(_SLACK_BYTES)

    def close(self) -> None:
        """Leave the files as they are."""
        self._spool.close()
        self._groups.close()

    def remove(self) -> None:
        """Remove the files: everything is where it belongs."""
        self.close()
        for path in self._paths:
            path.unlink(missing_ok=True)

    def _grow(self, end: int) -> None:
        """Have space for records up to `end`, and half as much again if there is some."""
        needed = self._least + int(self._per_byte * end)
        for size in (needed * 3 // 2, needed):
            try:
                allocate(self._spool.fileno(), self._allocated, size)
            except OSError as error:
                if error.errno not in FULL or size == needed:
                    raise
            else:
                self._allocated = size
                break
        self._limit = int((self._allocated - self._least) / self._per_byte)


@dataclass(frozen=True)
class Left:
    """What a killed process left.

    Attributes:
        layout: of the tables.
        finished: the row groups of trajectories and deliveries that count.
        values: (n_ticks, width) of the ticks after those, as they arrived.
        fates: (6, n) after those.
    """

    layout: Layout
    finished: tuple[Finished, Finished]
    values: Floats
    fates: Ints


def read(folder: Path) -> Left:
    """The reading end, for when the process that wrote is gone.

    Raises:
        OSError: the files cannot be read.
        ValueError: they do not hold what they should.
    """
    records = list(frames(memoryview((folder / GROUPS).read_bytes()), _FORMAT))
    if not records or records[0][0] != _LAYOUT:
        raise ValueError(f"{GROUPS} does not begin as it should")
    layout = Layout.decode(bytes(records[0][1]))
    groups: tuple[list[bytes], list[bytes]] = ([], [])
    finished, seed = (Finished(), Finished()), 0
    for kind, content in records[1:]:
        if kind == _GROUP:
            groups[content[0]].append(bytes(content[1:]))
        else:
            ends = np.frombuffer(content, dtype="<i8").tolist()
            finished = (Finished(tuple(groups[0]), ends[0]), Finished(tuple(groups[1]), ends[1]))
            seed += 1
    row_bytes = 8 * layout.width
    rows: list[memoryview] = []
    fates: list[Ints] = []
    n_ticks = 0
    for _, content in frames(memoryview((folder / SPOOL).read_bytes()), seed):
        n = int.from_bytes(content[:_HEAD_BYTES], "little")
        fates_end = len(content) - n * row_bytes
        fates.append(np.frombuffer(content[_HEAD_BYTES:fates_end], dtype="<i8").reshape(6, -1))
        rows.append(content[fates_end:])
        n_ticks += n
    values = np.frombuffer(b"".join(rows), dtype="<f8").reshape(n_ticks, layout.width)
    return Left(layout, finished, values, stacked(fates))


def stacked(tables: Sequence[Ints]) -> Ints:
    """(6, n) one after another."""
    return np.concatenate([np.empty((6, 0), dtype=np.int64), *tables], axis=1)
