"""A Parquet file that is written in row groups and stays readable when the disk fills up.

A Parquet file without its footer is lost, and a footer that names a row group which was cut off is no better. So the
space for a row group and for the footer that follows it is reserved (`posix_fallocate`) before the first byte of the
group is written: a full disk is known while the file can still be closed properly with what it holds.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from network.messages import Floats, Ints

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""No space left on the device; over quota; over the process's limit on the size of files (RLIMIT_FSIZE)."""

_NOT_SUPPORTED = frozenset({errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL})


class TableFile:
    """One Parquet file. pyarrow is imported with the first rows.

    Strings are stored as a dictionary, whole numbers as differences and the bytes of floats as separate streams
    (BYTE_STREAM_SPLIT), all compressed with zstd: on smooth trajectories a fifth smaller than plain, and as fast.

    Args:
        path: a file that does not exist yet; it is created at once, with room for its footer.
        columns: name and type (`int64`, `float64` or `string`) of every column.

    Raises:
        OSError: it cannot be created, or the disk is full already.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, str]]) -> None:
        self.path = path
        self.failure: OSError | None = None
        self._lost = False
        self._columns = tuple(columns)
        self._writer: Any = None
        self._groups = 0
        self._reserved = 0
        self._file: BinaryIO = path.open("xb")
        try:
            self._reserve(self._footer_bound())
        except OSError:
            self._file.close()
            raise

    def append(self, arrays: Sequence[Any], unit: int = 1) -> int:
        """Write rows as a row group.

        Args:
            arrays: one per column, made by the functions below.
            unit: rows that belong together, such as those of one tick.

        Returns:
            How many rows were written: all of them, unless there is a `failure`, after which the file takes no more. If
            the disk is full, they are as many whole units as there was room for, and the file can still be closed. If
            writing failed although there was room, the file is lost.
        """
        import pyarrow as pa

        table = pa.Table.from_arrays(list(arrays), names=[name for name, _ in self._columns])
        if self._writer is None:
            self._open_writer()
        written = 0
        size = len(table)
        while written < len(table) and self.failure is None:
            size = min(size, len(table) - written)
            part = table.slice(written, size)
            try:
                self._reserve(self._file.tell() + _group_bound(part) + self._footer_bound())
            except OSError as error:
                if error.errno not in FULL or size <= unit:
                    self.failure = error
                size = max(unit, size // 2 // unit * unit)
                continue
            try:
                self._write(part)
            except OSError as error:
                self.failure, self._lost = error, True
                return 0
            written += size
        return written

    def close(self) -> None:
        """Write the footer and give back the space that was reserved and not needed.

        Raises:
            OSError: the footer could not be written; the file is lost.
        """
        if self._lost:
            with contextlib.suppress(OSError, ValueError):  # pyarrow tries to finish the group, in vain
                self._writer.close()
            with contextlib.suppress(OSError):
                self._file.close()
            return
        with self._file:
            if self._writer is None:
                self._open_writer()
            self._writer.close()
            self._file.flush()
            self._file.truncate(self._file.tell())

    def _open_writer(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        types = {"int64": pa.int64(), "float64": pa.float64(), "string": pa.dictionary(pa.int32(), pa.string())}
        encodings = {"int64": "DELTA_BINARY_PACKED", "float64": "BYTE_STREAM_SPLIT"}
        self._writer = pq.ParquetWriter(
            self._file,
            pa.schema([(name, types[kind]) for name, kind in self._columns]),
            compression="zstd",
            compression_level=1,
            use_dictionary=[name for name, kind in self._columns if kind == "string"],
            column_encoding={name: encodings[kind] for name, kind in self._columns if kind in encodings},
            write_statistics=[name for name, kind in self._columns if kind == "int64"],
            store_schema=False,  # else the string columns would be read back as dictionaries
        )

    def _write(self, table: Any) -> None:
        self._writer.write_table(table, row_group_size=len(table))
        self._groups += 1
        self._file.flush()

    def _reserve(self, size: int) -> None:
        """Make sure that the file can grow to `size` bytes."""
        if size > self._reserved:
            allocate(self._file.fileno(), self._reserved, size)
            self._reserved = size

    def _footer_bound(self) -> int:
        """No footer is longer, with one row group more than there are."""
        names = sum(2 * len(name.encode()) + 256 for name, _ in self._columns)
        return 4096 + names * (self._groups + 2)


def _group_bound(table: Any) -> int:
    """No row group is longer: the numbers themselves, validity, page headers, and what compression may add."""
    return int(table.nbytes) * 17 // 16 + (len(table) // 4 + 1024) * int(table.num_columns)


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
