"""What instances log."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import weakref
from collections import deque
from typing import Any

from cosim.components.fmu.library.imported import (
    defaultCallbacks,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from cosim.logs import Sink, discard

LOG_LINES = 100
"""How many of the latest lines that an instance logged are kept."""

_LINE_BYTES = 10_000
"""How much of each."""

STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")


def status_name(status: int) -> str:
    """What the standard calls a status."""
    return STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)


class Log:
    """What one instance logs: the latest lines, and all of it for `sink`."""

    def __init__(self, sink: Sink = discard) -> None:
        self.lines: deque[str] = deque(maxlen=LOG_LINES)
        self._sink = sink

    @property
    def last(self) -> str | None:
        return self.lines[-1] if self.lines else None

    def add(self, status: int, message: bytes | None) -> None:
        """Called by the FMU, from native code: must not raise."""
        text = message or b""
        self._sink(b"[%b] %b\n" % (status_name(status).encode(), text.strip()))
        self.lines.append(f"[{status_name(status)}] {text[:_LINE_BYTES].decode(errors='replace').strip()}")


_logs: weakref.WeakValueDictionary[int, Log] = weakref.WeakValueDictionary()
_log_numbers = itertools.count(1)


def _receive_fmi2(environment: int | None, _name: bytes, status: int, _category: bytes, message: bytes) -> None:
    log = _logs.get(environment or 0)
    if log is not None:
        log.add(status, message)


_fmi2_logger = fmi2CallbackLoggerTYPE(_receive_fmi2)


def fmi2_callbacks(log: Log) -> Any:
    """Callbacks that lead to `log`. FMPy's proxy formats the variadic message; it knows one receiver per process."""
    number = next(_log_numbers)
    _logs[number] = log
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = _fmi2_logger
    callbacks.allocateMemory = defaultCallbacks.allocateMemory
    callbacks.freeMemory = defaultCallbacks.freeMemory
    callbacks.componentEnvironment = number
    with contextlib.suppress(ImportError, OSError):  # no proxy for this platform: messages keep their placeholders
        from fmpy.logging import addLoggerProxy

        addLoggerProxy(ctypes.byref(callbacks))
    return callbacks
