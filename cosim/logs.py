"""What components log and print, in files under `logs/` of the run folder, however much it is.

A file appears when there is something to write. When it has `LIMIT` bytes it becomes `<name>.1.log`, in the place of an
older one, and begins anew: of a flood, the latest is kept, and never more than twice the limit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

LOG_FOLDER = "logs"
"""Of a run folder."""

LIMIT = 4 << 20
_MOST_OPEN = 64

Sink = Callable[[bytes], None]
"""Takes what is to be logged: whole lines, or pieces of them."""


def discard(_data: bytes) -> None:
    """The sink of who wants no log."""


class Logs:
    """The log files of a process. Any thread may write; what cannot be written is lost, for a run is worth more.

    Args:
        folder: for the files; it is made when the first of them is. None for no files at all.
        limit: bytes of a file before it begins anew.
    """

    def __init__(self, folder: Path | None, limit: int = LIMIT) -> None:
        self.folder = folder
        self._limit = limit
        self._lock = threading.Lock()
        self._open: OrderedDict[str, BinaryIO] = OrderedDict()

    def sink(self, name: str) -> Sink:
        """That of `<name>.log`; of a component, the name is `<agent>.<component>`."""
        folder = self.folder
        if folder is None:
            return discard

        def write(data: bytes) -> None:
            with self._lock, suppress(OSError):
                self._write(folder, name, data)

        return write

    def __enter__(self) -> Logs:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files; who writes again opens one again."""
        with self._lock:
            for file in self._open.values():
                file.close()
            self._open.clear()

    def _write(self, folder: Path, name: str, data: bytes) -> None:
        file = self._file(folder, name)
        if file.tell() and file.tell() + len(data) > self._limit:
            self._open.pop(name).close()
            (folder / f"{name}.log").replace(folder / f"{name}.1.log")
            file = self._file(folder, name)
        file.write(data[-self._limit :])

    def _file(self, folder: Path, name: str) -> BinaryIO:
        """The file, opened again if it had to give way to others."""
        if name not in self._open:
            if len(self._open) >= _MOST_OPEN:
                self._open.popitem(last=False)[1].close()
            folder.mkdir(parents=True, exist_ok=True)
            self._open[name] = (folder / f"{name}.log").open("ab", buffering=0)
        self._open.move_to_end(name)
        return self._open[name]


NO_LOGS = Logs(None)
"""For who has no run folder."""
