"""A thread that calls when a deadline has passed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable


class Alarm:
    """Calls `ring` when a deadline has passed, in a thread of its own.

    The thread is woken only for a deadline earlier than the one it sleeps for; setting later ones costs next to
    nothing, and it finds out when it wakes.
    """

    def __init__(self, ring: Callable[[], None]) -> None:
        self._ring = ring
        self._changed = threading.Condition()
        self._deadline = math.inf
        self._sleeps_until = math.inf
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="alarm", daemon=True)
        self._thread.start()

    def set(self, deadline: float) -> None:
        """Ring at `deadline` (of `time.monotonic`) instead of any earlier setting; infinity for never."""
        self._deadline = deadline
        if deadline < self._sleeps_until:
            with self._changed:
                self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        with self._changed:
            while not self._closed:
                self._sleeps_until = math.inf  # from here until it waits, `set` always asks for the lock
                left = self._deadline - time.monotonic()
                if left <= 0:
                    self._deadline = math.inf
                    self._ring()
                    continue
                self._sleeps_until = time.monotonic() + left
                self._changed.wait(None if left == math.inf else left)
