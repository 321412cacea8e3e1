"""What a worker on this host is doing, for the orchestrator to see even if it hangs in native code or was killed."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np

from cosim.attention import SIZE, TICK, Spot
from cosim.distributed.failure import OPENING
from cosim.distributed.replacement import Moment
from network.messages import Ints

_BYTES = 8 * SIZE


def write_to(scratch: Path, name: str) -> Ints:
    """Numbers of `cosim.attention` in memory that is shared with a file of the run's folder."""
    path = _path(scratch, name)
    path.write_bytes(np.array([OPENING, -1, -1]).tobytes())
    with path.open("r+b") as file:
        return np.frombuffer(mmap.mmap(file.fileno(), _BYTES), np.int64)


def read(scratch: Path, name: str) -> Moment | None:
    """What the process is doing, or was when it ended, the agent by its place among its own; None if not begun."""
    try:
        attended = np.frombuffer(_path(scratch, name).read_bytes(), np.int64)
        return Moment(int(attended[TICK]), Spot.of(attended), known=True)
    except (OSError, ValueError, IndexError):
        return None


def _path(scratch: Path, name: str) -> Path:
    return scratch / f"{name}.whereabouts"
