"""Ctrl-C and other requests to stop, obeyed where the work can be left in order."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from cosim.screen import say_at_once

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
        """While inside, signals are requests; but not the end of a terminal that is ignored (`nohup`)."""
        nohup = hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        numbers = [number for number in REQUESTS if not (nohup and number == signal.SIGHUP)]
        previous = {number: signal.signal(number, self._handle) for number in numbers}
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
        say_at_once("\nstopping as soon as everything is in order; once more to stop at once")
