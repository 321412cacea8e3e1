"""The lock of a run folder: held by the process that writes it, and free as soon as that process is gone, however."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import BinaryIO

if sys.platform != "win32":  # there nothing tells a run whose process was killed from one that goes on
    import fcntl

LOCK = ".lock"
RUN = "run"
RECOVERY = "recovery"


class Held(Exception):  # noqa: N818 - it is a finding, not an error
    """Somebody else writes the folder.

    Attributes:
        purpose: what for: `RUN` or `RECOVERY`.
    """

    def __init__(self, purpose: str) -> None:
        self.purpose = purpose
        super().__init__(f"held for {purpose!r}")


class FolderLock:
    """Hold a run folder.

    Args:
        folder: that exists.
        purpose: for those who find it held.

    Raises:
        Held: somebody else does.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, purpose: str) -> None:
        self._path = folder / LOCK
        while True:
            try:
                self._file = self._path.open("a+b", buffering=0)
            except OSError:
                look(folder)
                raise
            try:
                _lock(self._file)
                if self._is_current():
                    with contextlib.suppress(OSError):  # such as a full disk
                        self._file.truncate(0)
                        self._file.write(purpose.encode())
                    return
            except BaseException:
                self._file.close()
                raise
            self._file.close()  # its holder removed it after it was opened here

    def _is_current(self) -> bool:
        """Whether the file that is locked is the one in the folder."""
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), self._path.stat())
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Nobody needs the folder to be held any more."""
        if sys.platform == "win32":
            self._file.close()
        self._path.unlink(missing_ok=True)
        self._file.close()


def look(folder: Path) -> None:
    """See whether somebody writes a folder, without the right to do so oneself.

    Raises:
        Held: somebody does.
    """
    with contextlib.suppress(OSError), (folder / LOCK).open("rb", buffering=0) as file:
        _lock(file)


def _lock(file: BinaryIO) -> None:
    if sys.platform == "win32":
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        raise Held(file.read().decode(errors="replace")) from None
