"""Ctrl-C and other requests to stop, obeyed where the work can be left in order."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NUMBERS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class StopRequest:
    """The first signal asks for an orderly end at the next opportunity; a second one ends at once, as Python does it.

    Attributes:
        number: of the signal, 0 while there was none.
    """

    def __init__(self) -> None:
        self.number = 0

    def __call__(self) -> bool:
        """Whether somebody asked."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """What a shell says of a process that the signal ended: 130 after Ctrl-C."""
        return 128 + self.number

    @contextmanager
    def listening(self) -> Iterator[None]:
        """While inside, signals are requests."""
        previous = {number: signal.signal(number, self._handle) for number in _NUMBERS}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            signal.default_int_handler(number, frame)
        self.number = number
        os.write(_screen(), b"\nstopping as soon as everything is in order; once more to stop at once\n")


def _screen() -> int:
    """The descriptor of standard error, wherever it is."""
    try:
        return sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):
        return 2
