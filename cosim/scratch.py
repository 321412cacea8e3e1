"""Temporary folders of a process. What one that was killed left behind, the next removes: nobody holds its lock."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from network.transport import SOCKET_PATH_BYTES

if sys.platform != "win32":  # there an open file cannot be removed: a killed process leaves its folder
    import fcntl

_PREFIX = "cosim-"
_LOCK = "lock"
_SOCKET = "hub"
_own: dict[str, Scratch] = {}
"""By path, with a slash at the end, all that this process, or the one whose fork it is, made and has not removed."""


def holds(path: str) -> bool:
    """Whether a file lies in a folder that this process made: an unpacked FMU's does."""
    return path.startswith(tuple(_own))


class Scratch:
    """A new folder that only this user can read.

    Attributes:
        path: of the folder.

    Args:
        above: folder for it; where temporary files belong, if none is given.
    """

    def __init__(self, above: Path | None = None) -> None:
        above = above or Path(tempfile.gettempdir())
        _sweep(above)
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=above))
        self._process = os.getpid()
        _own[f"{self.path}{os.sep}"] = self
        new = self.path / "new"
        self._lock = new.open("wb")
        if sys.platform != "win32":
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            new.rename(self.path / _LOCK)  # it gets its name once it is locked: no other process can be faster

    def remove(self) -> None:
        """Remove the folder, as far as it is still there."""
        self._lock.close()
        _own.pop(f"{self.path}{os.sep}", None)
        shutil.rmtree(self.path, ignore_errors=True)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.remove()


def remove_all() -> None:
    """Remove the folders of this process, which is about to end at once."""
    for scratch in list(_own.values()):
        if scratch._process == os.getpid():
            scratch.remove()


@contextmanager
def place_for_socket(folder: Path) -> Iterator[Path]:
    """A path for a Unix socket: in the folder, or if that is too long for one, in a folder of its own below /tmp."""
    path = folder / _SOCKET
    if len(os.fsencode(path)) <= SOCKET_PATH_BYTES:
        yield path
        return
    with Scratch(Path("/tmp")) as short:  # noqa: S108 - in a new folder
        yield short / _SOCKET


def _sweep(above: Path) -> None:
    """Remove the folders of this user that nobody holds."""
    if sys.platform == "win32":
        return
    for path in above.glob(f"{_PREFIX}*/{_LOCK}"):
        with contextlib.suppress(OSError), path.open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.stat().st_uid == os.getuid():
                shutil.rmtree(path.parent, ignore_errors=True)
