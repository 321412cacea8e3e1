"""Records one after another in a file that may end, or be overwritten, anywhere: each says its kind and its length.

    kind (8 bytes) ‖ length (8) ‖ the record ‖ CRC-32 of all that (4), little-endian

The CRC starts from a seed. Where a file is written again from its beginning with another seed, what is left of the
earlier records cannot be taken for new ones. Kind 0 is none, so that a tail of zeros ends the records.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from typing import Any

_HEAD = struct.Struct("<QQ")
_TAIL = struct.Struct("<I")
HEAD = _HEAD.size
OVERHEAD = _HEAD.size + _TAIL.size


def frame(kind: int, seed: int, size: int, *parts: Any) -> bytes:
    """A record of `size` bytes, given as buffers."""
    body = b"".join((_HEAD.pack(kind, size), *parts))
    if len(body) != HEAD + size:
        raise ValueError(f"a record of {size} bytes was announced, and {len(body) - HEAD} came")
    return body + _TAIL.pack(zlib.crc32(body, seed))


def write(descriptor: int, data: bytes) -> None:
    """Write all of it.

    Raises:
        OSError: as `os.write`; part of it may be written.
    """
    written = os.write(descriptor, data)
    while written < len(data):  # the disk fills up: the next call says so
        written += os.write(descriptor, data[written:])


def frames(data: memoryview, seed: int) -> Iterator[tuple[int, memoryview]]:
    """Kind and content of every record up to the first one that is not whole."""
    at = 0
    while at + OVERHEAD <= len(data):
        kind, size = _HEAD.unpack_from(data, at)
        end = at + HEAD + size
        if (
            not kind
            or end + _TAIL.size > len(data)
            or zlib.crc32(data[at:end], seed) != _TAIL.unpack_from(data, end)[0]
        ):
            return
        yield kind, data[at + HEAD : end]
        at = end + _TAIL.size
