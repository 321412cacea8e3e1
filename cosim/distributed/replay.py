"""What a replacement of a lost worker is given: all the mail since tick 0, and a check that it says the same again."""

from __future__ import annotations

import os
import zlib
from array import array
from collections.abc import Callable, Sequence
from typing import BinaryIO

from cosim.errors import ClusterError
from network.transport import Part

Spill = Callable[[], BinaryIO]
"""Opens a new file to keep bytes in; it may keep them in memory."""


class Replay:
    """The mail of one worker, tick by tick, and a checksum of each of its samples. Pure, given its file.

    Args:
        file: empty, to write and to read.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._ends = array("q", [0])  # where the mail of each tick begins, and the end
        self._samples = array("L")

    def keep(self, mail: Sequence[Part]) -> None:
        """Keep the mail of the next tick.

        Raises:
            ClusterError: the file takes no more.
        """
        try:
            self._file.seek(0, os.SEEK_END)
            size = sum(self._file.write(part) for part in mail)
        except OSError as error:
            reason = error.strerror or error
            raise ClusterError(
                f"no room to keep the mail for a replacement of a lost worker: {reason}; free some space, let TMPDIR "
                "name a folder on another disk, or run with 'on_worker_loss: abort'"
            ) from error
        self._ends.append(self._ends[-1] + size)

    def mail(self, tick: int) -> bytes:
        """The mail of a tick."""
        self._file.seek(self._ends[tick])
        return self._file.read(self._ends[tick + 1] - self._ends[tick])

    def size(self, first: int, stop: int) -> int:
        """Bytes of mail of the ticks from `first` to before `stop`."""
        return self._ends[stop] - self._ends[first]

    def says(self, tick: int, samples: Part) -> bool:
        """Whether samples of a tick are the first ones of it, or equal to those."""
        checksum = zlib.crc32(samples)
        if tick == len(self._samples):
            self._samples.append(checksum)
        return self._samples[tick] == checksum

    def close(self) -> None:
        """Give the file back."""
        self._file.close()
