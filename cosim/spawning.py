"""What processes that this one starts have in common: where they look for modules, how they end, how that reads."""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

_DEATH_SECONDS = 10.0


def search_path() -> str:
    """For `PYTHONPATH`: they search for modules where this process does."""
    return os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)


def await_death(process: subprocess.Popen[bytes], what: str) -> None:
    """Wait for the end of a process that was killed.

    One that waits for a device or a file system ends when that answers, which may be never: it is left behind, and the
    user is told.
    """
    try:
        process.wait(_DEATH_SECONDS)
    except subprocess.TimeoutExpired:
        print(
            f"warning: {what} (process {process.pid}) was killed, but has not ended within {_DEATH_SECONDS:g} s: "
            "it waits for a device or a file system, and ends when that answers",
            file=sys.stderr,
        )


def how_it_ended(code: int) -> str:
    """A return code of `subprocess`, in words."""
    if code < 0:
        hint = ", as the system does when memory runs out" if -code == signal.SIGKILL else ""
        return f"was killed by signal {-code} ({signal_name(-code)}{hint})"
    hint = f" ({signal_name(code - 128)})" if code > 128 else ""
    return f"ended with exit code {code}{hint}"


def signal_name(number: int) -> str:
    """Such as SIGSEGV."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"


def end_with_parent(clear: Callable[[], None]) -> None:
    """End this process once the one that started it is gone, whatever it is doing, even if it hangs in native code.

    Standard input must be a pipe that only the other process holds open; from here on it is empty.

    Args:
        clear: called before the end.
    """
    parent = os.dup(0)
    with Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)

    def guard() -> None:
        while os.read(parent, 1):
            pass
        try:
            clear()
        finally:
            end_group(1)

    threading.Thread(target=guard, name="guard", daemon=True).start()


def end_group(code: int) -> NoReturn:
    """End at once, with all that this process has started if it leads a group."""
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(code)


def kill_group(process: subprocess.Popen[bytes], what: str) -> None:
    """End a process that leads a group, with all that it has started; see `await_death`."""
    if sys.platform == "win32":
        process.kill()
    else:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    await_death(process, what)


def leave(code: int) -> NoReturn:
    """End the process as Python does, but without the destructors of native code: some FMUs do not survive theirs."""
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
