"""The processes of a run on this host: started, watched, ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cosim.errors import ClusterError

_EXIT_SECONDS = 1.0


class Processes:
    """The processes of a run; none of them outlives the `with`."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        return self

    def start(self, run_id: str, endpoint: str, scratch: Path) -> None:
        """Start all of them. They search for modules where this process does, and Ctrl-C reaches only this one.

        Raises:
            ClusterError: the system refuses.
        """
        path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
        environment = {**os.environ, "PYTHONPATH": path}
        previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by what is started
        try:
            for name in self._names:
                command = [sys.executable, "-P", "-m", "cosim", "_process", name, run_id, endpoint, str(scratch)]
                self._running[name] = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE)  # noqa: S603
        except OSError as error:
            raise ClusterError(f"the process {name} cannot be started: {error.strerror or error}") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, previous)

    def ended(self) -> str | None:
        """A process that has ended."""
        return next((name for name, process in self._running.items() if process.poll() is not None), None)

    def condition(self, name: str) -> str | None:
        """How a process ended, or that it is stopped; None if there is nothing to say."""
        process = self._running[name]
        code = process.poll()
        if code is None:
            return _stopped(process.pid)
        if code < 0:
            hint = ", as the system does when memory runs out" if -code == signal.SIGKILL else ""
            return f"was killed by signal {-code} ({_signal_name(-code)}{hint})"
        return f"ended with exit code {code}"

    def await_end(self, name: str) -> None:
        """Give a process whose connection is gone a moment to end."""
        with suppress(subprocess.TimeoutExpired):
            self._running[name].wait(_EXIT_SECONDS)

    def await_all(self, seconds: float) -> None:
        """Give all of them time to end in good order."""
        deadline = time.monotonic() + seconds
        for process in self._running.values():
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            if process.poll() is None:
                process.kill()
        for process in self._running.values():
            process.wait()
            if process.stdin is not None:
                process.stdin.close()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"


def _stopped(pid: int) -> str | None:
    """That a child is stopped, if it is."""
    try:
        state = os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
    except (ChildProcessError, AttributeError):
        return None
    return None if state is None else f"is stopped by signal {state.si_status} ({_signal_name(state.si_status)})"
