"""Temporary folders of a process. What one that was killed left behind, the next removes: nobody holds its lock."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

if sys.platform != "win32":  # there an open file cannot be removed: a killed process leaves its folder
    import fcntl

_PREFIX = "cosim-"
_LOCK = "lock"
_own: dict[str, Scratch] = {}
"""By path, with a slash at the end, all that this process, or the one whose fork it is, made and has not removed."""


def holds(path: str) -> bool:
    """Whether a file lies in a folder that this process made: an unpacked FMU's does."""
    return path.startswith(tuple(_own))


class Scratch:
    """A new folder that only this user can read.

    Attributes:
        path: of the folder.
    """

    def __init__(self) -> None:
        _sweep()
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX))
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


def _sweep() -> None:
    """Remove the folders of this user that nobody holds."""
    if sys.platform == "win32":
        return
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*/{_LOCK}"):
        with contextlib.suppress(OSError), path.open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.stat().st_uid == os.getuid():
                shutil.rmtree(path.parent, ignore_errors=True)
