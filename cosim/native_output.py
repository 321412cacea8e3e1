"""Where native code prints: FMUs call `printf` as they like, and it must neither reach the screen nor be lost."""

from __future__ import annotations

import ctypes
import io
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from cosim.logs import Sink

_CHUNK = 1 << 16
_DRAIN_SECONDS = 2.0
_BY_LINE = 1  # _IOLBF of glibc, musl and macOS


def pump(descriptor: int, sink: Sink) -> threading.Thread:
    """A thread that hands over what arrives at a pipe, until all who write to it have closed it; then it closes it."""

    def work() -> None:
        with suppress(OSError):
            while data := os.read(descriptor, _CHUNK):
                sink(data)
        os.close(descriptor)

    thread = threading.Thread(target=work, name="log", daemon=True)
    thread.start()
    return thread


@contextmanager
def captured(sink: Sink) -> Iterator[None]:
    """While inside, what native code of this process prints goes to `sink`. What Python prints stays where it was.

    Python's own streams are set to the old places, so whoever keeps `sys.stdout` must fetch it inside.
    """
    print_by_lines()
    _flush()
    saved = [os.dup(number) for number in (1, 2)]
    streams = {name: _moved(getattr(sys, name), saved) for name in ("stdout", "stderr")}
    previous = {name: getattr(sys, name) for name in streams}
    reading, writing = os.pipe()
    for number in (1, 2):
        os.dup2(writing, number)
    os.close(writing)
    thread = pump(reading, sink)
    for name, stream in streams.items():
        setattr(sys, name, stream)
    try:
        yield
    finally:
        _flush()
        for number, kept in zip((1, 2), saved, strict=True):
            os.dup2(kept, number)
        for name, stream in previous.items():
            setattr(sys, name, stream)
        for kept in saved:
            os.close(kept)
        thread.join(_DRAIN_SECONDS)  # longer only if a process that native code started still has the pipe


def _moved(stream: io.TextIOBase, saved: list[int]) -> io.TextIOBase:
    """The stream, at the copy of its descriptor; the same one if it is no such stream."""
    try:
        number = stream.fileno()
    except (OSError, AttributeError, ValueError):
        return stream
    if number not in (1, 2):
        return stream
    return open(
        saved[number - 1],
        "w",
        encoding=stream.encoding,
        errors=stream.errors,
        buffering=1,
        closefd=False,
    )


def _flush() -> None:
    """Python's streams and those of the C library, which native code prints through."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, AttributeError, ValueError):
            stream.flush()
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).fflush(None)


def print_by_lines() -> None:
    """Have the C library hand over what is printed line by line, as to a screen: a crash then costs no line."""
    name = "__stdoutp" if sys.platform == "darwin" else "stdout"
    with suppress(OSError, AttributeError, TypeError, ValueError):
        library = ctypes.CDLL(None)
        library.setvbuf(ctypes.c_void_p.in_dll(library, name), None, _BY_LINE, ctypes.c_size_t(0))
