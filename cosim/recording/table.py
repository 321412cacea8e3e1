"""A Parquet file that is written in row groups and stays readable when the disk fills up.

A footer that names a row group which was cut off makes the whole file unreadable. So the
space for a row group and for the footer that follows it is reserved (`posix_fallocate`) before the first byte of the
group is written: a full disk is known while the file can still be closed properly with what it holds.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from network.messages import Floats, Ints

if sys.platform != "win32":
    import fcntl

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""No space left on the device; over quota; over the process's limit on the size of files (RLIMIT_FSIZE)."""

_MAGIC = b"PAR1"
_NOT_SUPPORTED = frozenset({errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL})


@dataclass(frozen=True)
class Finished:
    """The part of a file that is complete.

    Attributes:
        groups: the metadata of each row group, as `TableFile.new_groups` gave it.
        end: where the last of them ends.
    """

    groups: Sequence[bytes] = ()
    end: int = 0


class TableFile:
    """One Parquet file. pyarrow is imported with the first rows.

    Strings are stored as a dictionary, whole numbers as differences and the bytes of floats as separate streams
    (BYTE_STREAM_SPLIT), all compressed with zstd: on smooth trajectories a fifth smaller than plain, and as fast.

    Every row group has a writer of its own, which gives its metadata at once: whoever knows those, and where the last
    group ends, can go on with a file that was never closed.

    Args:
        path: a file that does not exist yet; it is created at once, with room for its footer.
        columns: name and type (`int64`, `float64` or `string`) of every column.
        finished: go on with an existing file, of which this is finished; what follows in it is dropped.

    Raises:
        OSError: it cannot be created, or the disk is full already.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, str]], finished: Finished | None = None) -> None:
        self.path = path
        self.failure: OSError | None = None
        self._columns = tuple(columns)
        self._end = 0
        self._groups = 0
        self._new_groups: list[bytes] = []
        self._metadata: Any = None
        self._sink: Any = None
        self._file: BinaryIO = path.open("xb" if finished is None else "r+b")
        try:
            if finished is not None:
                self._take_up(finished)
            self._reserved = self._end
            self._reserve(self._end + self._footer_bound())
        except OSError:
            self._file.close()
            raise

    def _take_up(self, finished: Finished) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self._file.seek(0, os.SEEK_END) < finished.end:
            raise OSError(errno.EIO, f"it should have {finished.end} bytes at least", str(self.path))
        self._file.truncate(finished.end)
        self._end = finished.end
        for group in finished.groups:
            self._add_metadata(pq.read_metadata(pa.BufferReader(group)))

    @property
    def end(self) -> int:
        """Where the last row group ends."""
        return self._end

    @property
    def rows(self) -> int:
        """In all row groups."""
        return 0 if self._metadata is None else int(self._metadata.num_rows)

    def new_groups(self) -> list[bytes]:
        """The metadata of each row group since the last call."""
        groups, self._new_groups = self._new_groups, []
        return groups

    def append(self, arrays: Sequence[Any], unit: int = 1, make_room: Callable[[OSError], None] | None = None) -> int:
        """Write rows as a row group.

        Args:
            arrays: one per column, made by the functions below.
            unit: rows that belong together, such as those of one tick.
            make_room: called once if not even a unit fits, before a last attempt.

        Returns:
            How many rows were written: all of them, unless there is a `failure`, after which the file takes no more.
            If the disk is full, they are as many whole units as there was room for. The file can still be closed.
        """
        import pyarrow as pa

        table = pa.Table.from_arrays(list(arrays), names=[name for name, _ in self._columns])
        written = 0
        size = len(table)
        while written < len(table) and self.failure is None:
            size = min(size, len(table) - written)
            part = table.slice(written, size)
            try:
                self._reserve(self._end + bound(part.nbytes, size, len(self._columns)) + self._footer_bound())
            except OSError as error:
                if error.errno in FULL and size > unit:
                    size = max(unit, size // 2 // unit * unit)
                elif error.errno in FULL and make_room is not None:
                    make_room(error)
                    make_room, size = None, len(table)
                else:
                    self.failure = error
                continue
            try:
                self._write(part)
            except OSError as error:
                self.failure = error
            else:
                written += size
        return written

    def close(self) -> None:
        """Write the footer and give back the space that was reserved and not needed.

        Raises:
            OSError: the footer could not be written; the file is lost.
        """
        with self._file:
            sink = self._open_sink()
            try:
                if self._metadata is None:
                    self._open_writer([]).close()
                else:
                    os.lseek(sink.fileno(), self._end, os.SEEK_SET)
                    sink.write(_serialised(self._metadata)[len(_MAGIC) :])
                self._file.truncate(sink.tell())
            finally:
                sink.close()

    def abandon(self) -> None:
        """Close without a footer, so that another process can go on."""
        self._file.close()
        if self._sink is not None:
            self._sink.close()

    def _open_sink(self) -> Any:
        """The file as pyarrow writes it. Its position is that of the descriptor, so that it can be moved."""
        import pyarrow as pa

        if self._sink is None and sys.platform == "win32":
            self._sink = pa.OSFile(str(self.path), "wb")
        elif self._sink is None:
            self._sink = pa.OSFile(str(self.path), "ab")  # the only mode that leaves the file as it is
            flags = fcntl.fcntl(self._sink.fileno(), fcntl.F_GETFL)
            fcntl.fcntl(self._sink.fileno(), fcntl.F_SETFL, flags & ~os.O_APPEND)
        return self._sink

    def _open_writer(self, collector: list[Any]) -> Any:
        """A writer at the beginning of the file: pyarrow's refuse to begin anywhere else."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        sink = self._open_sink()
        os.lseek(sink.fileno(), 0, os.SEEK_SET)
        types = {"int64": pa.int64(), "float64": pa.float64(), "string": pa.dictionary(pa.int32(), pa.string())}
        encodings = {"int64": "DELTA_BINARY_PACKED", "float64": "BYTE_STREAM_SPLIT"}
        return pq.ParquetWriter(
            sink,
            pa.schema([(name, types[kind]) for name, kind in self._columns]),
            compression="zstd",
            compression_level=1,
            use_dictionary=[name for name, kind in self._columns if kind == "string"],
            column_encoding={name: encodings[kind] for name, kind in self._columns if kind in encodings},
            write_statistics=[name for name, kind in self._columns if kind == "int64"],
            store_schema=False,  # else the string columns would be read back as dictionaries
            metadata_collector=collector,
        )

    def _write(self, table: Any) -> None:
        collector: list[Any] = []
        writer = self._open_writer(collector)
        try:
            os.lseek(self._sink.fileno(), max(self._end, len(_MAGIC)), os.SEEK_SET)
            writer.write_table(table, row_group_size=len(table))
            end = self._sink.tell()
        except BaseException:
            with contextlib.suppress(OSError):  # pyarrow tries to finish the group, in vain
                writer.close()
            raise
        writer.close()  # with a footer for this group alone; whatever comes next is written over it
        self._end = end
        self._new_groups.append(_serialised(collector[0]))
        self._add_metadata(collector[0])

    def _add_metadata(self, metadata: Any) -> None:
        self._groups += 1
        if self._metadata is None:
            self._metadata = metadata
        else:
            self._metadata.append_row_groups(metadata)

    def _reserve(self, size: int) -> None:
        """Make sure that the file can grow to `size` bytes."""
        if size > self._reserved:
            allocate(self._file.fileno(), self._reserved, size)
            self._reserved = size

    def _footer_bound(self) -> int:
        """No footer is longer, with one row group more than there are."""
        names = sum(2 * len(name.encode()) + 256 for name, _ in self._columns)
        return 4096 + names * (self._groups + 2)


def bound(n_bytes: int, n_rows: int, n_columns: int) -> int:
    """No row group is longer: the numbers themselves, validity, page headers, and what compression may add."""
    return n_bytes * 17 // 16 + (n_rows // 4 + 1024) * n_columns


def _serialised(metadata: Any) -> bytes:
    """A Parquet file without rows: the magic number, then the footer."""
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    metadata.write_metadata_file(sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


# --- arrays ----------------------------------------------------------------------------------------------------------
# By way of their memory: `pyarrow.array` and `to_numpy` import pandas, which takes longer than a short run.
def float_array(values: Floats, valid: NDArray[np.bool_] | None = None) -> Any:
    """A pyarrow array of float64; null where not valid."""
    import pyarrow as pa

    bitmap = None if valid is None else pa.py_buffer(np.packbits(valid, bitorder="little"))
    return pa.Array.from_buffers(pa.float64(), len(values), [bitmap, _buffer(values)])


def int_array(values: Ints) -> Any:
    """A pyarrow array of int64."""
    import pyarrow as pa

    return pa.Array.from_buffers(pa.int64(), len(values), [None, _buffer(values)])


def name_array(indices: Ints, names: Sequence[str]) -> Any:
    """A pyarrow dictionary array: the names with these indices."""
    import pyarrow as pa

    encoded = [name.encode() for name in names]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    known = pa.Array.from_buffers(pa.string(), len(names), [None, _buffer(ends), pa.py_buffer(b"".join(encoded))])
    codes = pa.Array.from_buffers(pa.int32(), len(indices), [None, _buffer(indices.astype(np.int32))])
    return pa.DictionaryArray.from_arrays(codes, known)


def numbers(column: Any) -> NDArray[Any]:
    """The numbers of a column (int64 or float64) that was read; NaN where null."""
    dtype = np.int64 if str(column.type) == "int64" else np.float64
    return np.concatenate([np.empty(0, dtype), *map(_values, column.chunks)])


def indices(column: Any, names: Mapping[str, int]) -> Ints:
    """The index of each name in a column that was read as a dictionary."""
    parts = [np.empty(0, dtype=np.int64)]
    for chunk in column.chunks:
        known = np.array([names[str(name)] for name in chunk.dictionary], dtype=np.int64)
        parts.append(known[_values(chunk.indices)])
    return np.concatenate(parts)


def _values(array: Any) -> NDArray[Any]:
    dtype = {"int32": np.int32, "int64": np.int64, "double": np.float64}[str(array.type)]
    validity, data = array.buffers()
    part = slice(array.offset, array.offset + len(array))
    if not len(array):
        return np.empty(0, dtype)
    values: NDArray[Any] = np.frombuffer(data, dtype)[part]
    if array.null_count:
        valid = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[part]
        values = np.where(valid, values, np.nan)
    return values


def _buffer(values: NDArray[Any]) -> Any:
    import pyarrow as pa

    return pa.py_buffer(np.ascontiguousarray(values))


# --- disk space ------------------------------------------------------------------------------------------------------
def allocate(descriptor: int, start: int, end: int) -> None:
    """Give a file the disk space of the bytes from `start` to `end`, beyond its end so far.

    Raises:
        OSError: there is none (see `FULL`).
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, start, end - start)
        except OSError as error:
            if error.errno not in _NOT_SUPPORTED:
                raise
        else:
            return
    zeros = bytes(1 << 16)  # macOS and Windows have no such call, some file systems do not serve it
    here = os.lseek(descriptor, 0, os.SEEK_CUR)
    try:
        os.lseek(descriptor, start, os.SEEK_SET)
        while start < end:
            start += os.write(descriptor, zeros[: end - start])
    finally:
        os.lseek(descriptor, here, os.SEEK_SET)
