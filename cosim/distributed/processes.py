"""The processes of a run on this host: started, watched, ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from cosim.distributed import whereabouts
from cosim.distributed.inheritance import EXIT_ORPHANED, EXIT_OUTSIDE
from cosim.distributed.replacement import Moment
from cosim.errors import ClusterError
from cosim.spawning import await_death, how_it_ended, search_path, signal_name

_EXIT_SECONDS = 1.0
_STOPPED_SECONDS = 2.0
"""After so long, a stopped process is lost."""


class Processes:
    """The processes of a run; none of them outlives the `with`.

    Args:
        run_id: of the run.
        endpoint: at which the emulator listens, and all others connect.
        scratch: folder of the run.
    """

    def __init__(self, run_id: str, endpoint: str, scratch: Path) -> None:
        self._run_id = run_id
        self.endpoint = endpoint
        self._scratch = scratch
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._stopped_since: dict[str, float] = {}

    def __enter__(self) -> Processes:
        return self

    def start(self, names: Iterable[str]) -> None:
        """Start processes. They search for modules where this process does, and Ctrl-C reaches only this one.

        Raises:
            ClusterError: the system refuses.
        """
        environment = {**os.environ, "PYTHONPATH": search_path()}
        previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by what is started
        try:
            for name in names:
                command = [sys.executable, "-P", "-m", "cosim", "_process", name, self._run_id, self.endpoint]
                command.append(str(self._scratch))
                self._running[name] = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE)  # noqa: S603
        except OSError as error:
            raise ClusterError(f"the process {name} cannot be started: {error.strerror or error}") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, previous)

    def lost(self) -> str | None:
        """A process that has ended, or has been stopped for a while."""
        now = time.monotonic()
        for name, process in self._running.items():
            if process.poll() is not None:
                return name
            if _stopped(process.pid) is None:
                self._stopped_since.pop(name, None)
            elif now - self._stopped_since.setdefault(name, now) > _STOPPED_SECONDS:
                return name
        return None

    def obstacle(self) -> str | None:
        """Why another process could not join; None if it can."""
        path = self.endpoint.partition("/")[2]
        return None if Path(path).exists() else f"the socket of the run is gone: {path}"

    def condition(self, name: str) -> str | None:
        """How a process ended, or that it is stopped; None if there is nothing to say."""
        process = self._running[name]
        code = process.poll()
        if code is None:
            return _stopped(process.pid)
        if code == EXIT_ORPHANED:
            return "ended because it had lost its connection to the others"
        if code == EXIT_OUTSIDE:
            return "could not join the run (it says why above)"
        return how_it_ended(code)

    def moment(self, name: str) -> Moment | None:
        """What a worker is doing, or was when it ended; None if it is not known."""
        return whereabouts.read(self._scratch, name)

    def await_end(self, *names: str) -> None:
        """Give processes whose connections are gone a moment, until one of them has ended or is stopped."""
        deadline = time.monotonic() + _EXIT_SECONDS
        while all(self.condition(name) is None for name in names) and time.monotonic() < deadline:
            time.sleep(_EXIT_SECONDS / 500)

    def dismiss(self, name: str) -> None:
        """Kill a process, if it has not ended, and forget it."""
        self._stopped_since.pop(name, None)
        _end({name: self._running.pop(name)})

    def await_all(self, seconds: float, but: Collection[str] = ()) -> None:
        """Give all of them, but some and those that are stopped, time to end in good order."""
        deadline = time.monotonic() + seconds
        for process in (process for name, process in self._running.items() if name not in but):
            if _stopped(process.pid) is not None:
                continue
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))

    def end(self) -> None:
        """Kill all that have not ended."""
        _end(self._running)

    def __exit__(self, *_: object) -> None:
        self.end()


def _end(processes: Mapping[str, subprocess.Popen[bytes]]) -> None:
    for process in processes.values():
        if process.poll() is None:
            process.kill()
    for name, process in processes.items():
        await_death(process, name)
        if process.stdin is not None:
            process.stdin.close()


def _stopped(pid: int) -> str | None:
    """That a child is stopped, if it is."""
    try:
        state = os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
    except (ChildProcessError, AttributeError):
        return None
    return None if state is None else f"is stopped by signal {state.si_status} ({signal_name(state.si_status)})"
