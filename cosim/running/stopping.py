"""Ctrl-C and other requests to stop, obeyed where the work can be left in order."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

REQUESTS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""The signals that ask for an end."""


class StopRequest:
    """The first signal asks for an orderly end at the next opportunity; a second one ends at once, as Python does it.

    Attributes:
        number: of the signal, 0 while there was none.
        count: of signals that Python has seen.
    """

    def __init__(self) -> None:
        self.number = self.count = 0

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
        previous = {number: signal.signal(number, self._handle) for number in REQUESTS}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.number:
            signal.default_int_handler(number, frame)
        self.number = number
        os.write(screen(), b"\nstopping as soon as everything is in order; once more to stop at once\n")


def screen() -> int:
    """The descriptor of standard error, wherever it is."""
    try:
        return sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):
        return 2
