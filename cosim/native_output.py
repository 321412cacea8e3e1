"""Where native code prints: FMUs call `printf` as they like, and it must neither reach the screen nor be lost."""

from __future__ import annotations

import ctypes
import os
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TextIO

from cosim.logs import Sink
from cosim.scratch import holds
from cosim.screen import Screen

_CHUNK = 1 << 16
_LOOK_SECONDS = 0.5
_DRAIN_SECONDS = 60.0
_BY_LINE = 1  # _IOLBF of glibc, musl and macOS


class Pump:
    """A thread that hands over what arrives at a pipe, until all who write to it have closed it; then it closes it.

    Args:
        descriptor: of the pipe's end to read from.
        sink: takes what arrives.
    """

    def __init__(self, descriptor: int, sink: Sink) -> None:
        self._descriptor = descriptor
        self._sink = sink
        self._leaving = False
        self._drained = threading.Event()
        threading.Thread(target=self._work, name="log", daemon=True).start()

    def drain(self) -> None:
        """Wait until all is handed over that has been written so far, however long the disk takes.

        A process that native code started may have the pipe for longer; it is not waited for.
        """
        self._leaving = True
        if not self._drained.wait(_DRAIN_SECONDS):
            print(
                f"warning: what FMUs printed last is lost: it could not be written within {_DRAIN_SECONDS:g} s",
                file=sys.stderr,
            )

    def _work(self) -> None:
        poll = select.poll()
        poll.register(self._descriptor)
        with suppress(OSError):
            while True:
                leaving = self._leaving  # looked at first: what was written before is then in the pipe
                if not poll.poll(_LOOK_SECONDS * 1e3):
                    if leaving:
                        self._drained.set()
                    continue
                data = os.read(self._descriptor, _CHUNK)
                if not data:
                    break
                self._sink(data)
        os.close(self._descriptor)
        self._drained.set()


@contextmanager
def captured(sink: Sink) -> Iterator[None]:
    """While inside, what FMUs in this process print goes to `sink`. What Python prints stays where it was.

    Python's own streams are set to the old places, so whoever keeps `sys.stdout` must fetch it inside. An FMU may be
    written in Python, too, and runs in this interpreter: what its files print, or others on their behalf, is its own.
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
    pump = Pump(reading, sink)
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
        pump.drain()


def _moved(stream: TextIO, saved: list[int]) -> TextIO:
    """The stream, at the copy of its descriptor; the same one if it is no such stream."""
    try:
        number = stream.fileno()
    except (OSError, AttributeError, ValueError):
        return stream
    if number not in (1, 2):
        return stream
    return _Screen(number, saved[number - 1], stream)


class _Screen(Screen):
    """The old place of a stream; what FMUs written in Python print goes to its new one.

    Args:
        number: descriptor of the new place.
        old: that of the old place.
        stream: which it was.
    """

    def __init__(self, number: int, old: int, stream: TextIO) -> None:
        super().__init__(old, stream)
        self._number = number

    def write(self, text: str) -> int:
        if not _printed_by_an_fmu(sys._getframe(1)):
            return super().write(text)
        data = text.encode(self.encoding, "replace")
        while data:
            data = data[os.write(self._number, data) :]
        return len(text)


def _printed_by_an_fmu(frame: FrameType | None) -> bool:
    """Whether a file of an unpacked FMU is among those that led to this frame."""
    while frame is not None:
        if holds(frame.f_code.co_filename):
            return True
        frame = frame.f_back
    return False


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
