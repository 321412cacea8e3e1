"""Standard output and error as people see them, and what becomes of them when nobody is there any more."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from contextlib import suppress
from typing import TextIO


class Screen(io.TextIOWrapper):
    """A stream whose text goes nowhere once its terminal is closed, or whoever read it has gone: no reason to end.

    Args:
        descriptor: of the place. It stays open when the stream is closed.
        like: a stream whose encoding is taken over.
    """

    def __init__(self, descriptor: int, like: TextIO) -> None:
        place = open(descriptor, "wb", closefd=False)  # noqa: SIM115 - whoever prints needs it open
        super().__init__(place, encoding=like.encoding, errors=like.errors, line_buffering=True)

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError:
            discard(self)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError:
            discard(self)


def prepare() -> None:
    """Make a process's standard streams safe to print to: those that were closed lead nowhere."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - as long as the process
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    if isinstance(sys.stderr, io.TextIOWrapper) and sys.stderr.fileno() == 2:
        sys.stderr = Screen(2, sys.stderr)


def discard(stream: TextIO) -> None:
    """Whatever is written to a stream from now on, and what it still holds, goes nowhere."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, stream.fileno())
    os.close(nothing)


def is_gone(stream: TextIO, error: OSError) -> bool:
    """Whether an error says that nobody reads a stream any more: its pipe or its terminal is closed."""
    if error.errno == errno.EIO:
        return True
    if error.errno != errno.EPIPE:
        return False
    if not hasattr(select, "poll"):
        return True
    poll = select.poll()  # the pipe may have been another one
    poll.register(stream.fileno(), 0)
    return any(what & select.POLLERR for _, what in poll.poll(0))


def error_descriptor() -> int:
    """The descriptor of standard error, wherever it is."""
    try:
        return sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):
        return 2


def say_at_once(text: str) -> None:
    """A line on standard error, past all buffers: for signal handlers, and for when all else stands still."""
    with suppress(OSError):  # nobody is there
        os.write(error_descriptor(), f"{text}\n".encode())
