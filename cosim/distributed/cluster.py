"""The orchestrator's side of a distributed run on this host: starts the processes, watches them, drives the clock."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from cosim.distributed.assignment import EMULATOR, carried, divide
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.serving import FLUSH_SECONDS, send
from cosim.errors import ClusterError, CosimError
from cosim.inline import Interrupted, Observer
from cosim.plan import Plan
from cosim.scratch import Scratch
from network.transport import Hub, Kind, PeerLost, TransportError, TransportTimeout, WireError
from network.units import to_seconds

PER_AGENT = "per-agent"
STEP_DEADLINE = 30.0
"""Seconds in which some process must get further."""

_START_SECONDS = 60.0
_START_SECONDS_PER_AGENT = 0.1
_WATCH_SECONDS = 0.02
_SETTLE_SECONDS = 4 * FLUSH_SECONDS
_EXIT_SECONDS = 1.0
_FAREWELL_SECONDS = 10.0
_FAULT_FAREWELL_SECONDS = 1.0


def count_workers(wanted: str | None, n_agents: int) -> int:
    """How many workers to start.

    Args:
        wanted: a number, `per-agent`, or None for one per core.
        n_agents: more workers than agents are never started.

    Raises:
        CosimError: not a number of workers.
    """
    if wanted == PER_AGENT:
        return n_agents
    if wanted is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return min(cores, n_agents)
    if not wanted.isascii() or not wanted.isdigit() or int(wanted) == 0:
        raise CosimError(f"--workers {wanted}: write a number from 1, or {PER_AGENT!r}")
    return min(int(wanted), n_agents)


def run(
    plan: Plan,
    n_workers: int,
    observers: Sequence[Observer],
    stop_requested: Callable[[], bool] = lambda: False,
    step_deadline: float = STEP_DEADLINE,
) -> None:
    """Play a plan in processes of their own: an emulator and workers.

    Args:
        plan: what to run.
        n_workers: how many workers carry the agents.
        observers: told of every tick and every fate, in order, as by `cosim.inline.run`.
        stop_requested: asked a few times a second.
        step_deadline: seconds in which some process must get further.

    Raises:
        RunError: a component failed.
        ClusterError: a process was lost, or hangs.
        Interrupted: `stop_requested` said so.
    """
    workers = divide(len(plan.agents), n_workers)
    with Scratch() as scratch, _hub(scratch) as (run_id, hub), _Processes((EMULATOR, *workers)) as processes:
        processes.start(run_id, hub.endpoints[0], scratch)
        orchestration = Orchestration(plan, workers, observers)
        supervisor = Supervisor(plan, workers, hub, processes, orchestration, stop_requested, step_deadline)
        supervisor.run()


@contextmanager
def _hub(scratch: Path) -> Iterator[tuple[str, Hub]]:
    from network.zenoh import open_hub

    run_id = secrets.token_hex(8)
    try:
        hub = open_hub(run_id, listen=[f"unixsock-stream/{scratch / 'hub'}"])
    except TransportError as error:
        raise ClusterError(str(error)) from error
    with hub:
        yield run_id, hub


class _Processes:
    """The processes of a run; none of them outlives the `with`."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> _Processes:
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


class Supervisor:
    """Drives an orchestration over a hub, and finds out who is to blame when it does not go on.

    Args:
        plan: what runs.
        workers: the agents of every worker.
        hub: at which the processes join.
        processes: that were started.
        orchestration: what to do with their messages.
        stop_requested: asked a few times a second.
        step_deadline: seconds in which some process must get further.
    """

    def __init__(  # noqa: PLR0917
        self,
        plan: Plan,
        workers: Mapping[str, range],
        hub: Hub,
        processes: _Processes,
        orchestration: Orchestration,
        stop_requested: Callable[[], bool],
        step_deadline: float,
    ) -> None:
        self._plan = plan
        self._workers = workers
        self._hub = hub
        self._processes = processes
        self._orchestration = orchestration
        self._stop_requested = stop_requested
        self._step_deadline = step_deadline
        self._start_deadline = _START_SECONDS + _START_SECONDS_PER_AGENT * len(plan.agents)

    def run(self) -> None:
        """Until the run is over; see `cosim.distributed.cluster.run`."""
        farewell = _FAULT_FAREWELL_SECONDS
        try:
            self._await_joined()
            send(self._hub, self._orchestration.begin())
            self._play()
            farewell = _FAREWELL_SECONDS
        except PeerLost as lost:
            self._processes.await_end(lost.name)
            raise self._loss(lost.name, lost.reason) from lost
        except WireError as error:
            raise ClusterError(f"{error}; tick {self._orchestration.recorded} is the last one recorded") from error
        finally:
            self._dismiss(farewell)

    def _await_joined(self) -> None:
        deadline = time.monotonic() + self._start_deadline
        while True:
            try:
                self._hub.await_peers(self._orchestration.processes, _WATCH_SECONDS)
            except TransportTimeout as error:
                self._watch()
                if time.monotonic() > deadline:
                    raise ClusterError(f"{error} (after {self._start_deadline:g} s)") from error
            else:
                return

    def _play(self) -> None:
        orchestration = self._orchestration
        progress, since = orchestration.progress, time.monotonic()
        watched = since
        while not orchestration.finished:
            with suppress(TransportTimeout):
                send(self._hub, orchestration.handle(self._hub.receive(_WATCH_SECONDS)))
            now = time.monotonic()
            if now - watched < _WATCH_SECONDS:
                continue
            watched = now
            self._watch()
            if progress != orchestration.progress:
                progress, since = orchestration.progress, now
            elif now - since > self._deadline:
                raise self._hang()

    @property
    def _deadline(self) -> float:
        """Seconds in which somebody must get further."""
        return self._start_deadline if self._orchestration.unready else self._step_deadline

    def _watch(self) -> None:
        """Look whether somebody asks for the end, and whether all processes are there."""
        if self._stop_requested():
            raise Interrupted(max(0, self._orchestration.recorded))
        name = self._processes.ended()
        if name is not None:
            raise PeerLost(name, "its process ended")

    # --- accounts of faults -----------------------------------------------------------------------------------------
    def _loss(self, name: str, reason: str) -> CosimError:
        """What to say of a process that is gone."""
        self._settle()
        if self._orchestration.failure is not None:
            return self._orchestration.failure.error
        condition = self._processes.condition(name) or f"was lost: {reason}"
        return self._account((name,), condition, self._orchestration.position(name))

    def _hang(self) -> CosimError:
        """What to say when nobody gets further."""
        deadline = self._deadline
        self._settle()
        if self._orchestration.failure is not None:
            return self._orchestration.failure.error
        blockage = self._orchestration.blockage()
        stopped = [text for name in blockage.culprits if (text := self._processes.condition(name))]
        condition = stopped[0] if stopped else f"did not get further for {deadline:g} s"
        return self._account(blockage.culprits, condition, blockage.tick)

    def _account(self, names: Sequence[str], condition: str, tick: int) -> ClusterError:
        who = " and ".join(carried(self._plan, name, self._workers) for name in names)
        time_ = to_seconds(tick * self._plan.period_ns)
        began = not self._orchestration.unready
        when = f"; last heard of at tick {tick} (t = {time_:.9g} s)" if began else " before the first tick"
        others = [name for name in self._orchestration.processes if name not in names]
        waiting = ", ".join(carried(self._plan, name, self._workers) for name in others)
        text = f"{who} {condition}{when}"
        return ClusterError(text + (f"\n  waiting for it: {waiting}" if waiting else ""))

    def _settle(self) -> None:
        """Take what is still under way, so that all that is complete is recorded."""
        with suppress(PeerLost, CosimError):
            self._hub.send(EMULATOR, Kind.PING, 0)
        deadline = time.monotonic() + _SETTLE_SECONDS
        while (left := deadline - time.monotonic()) > 0:
            try:
                send(self._hub, self._orchestration.handle(self._hub.receive(left)))
            except (PeerLost, WireError):
                continue
            except (TransportTimeout, CosimError):
                return

    def _dismiss(self, seconds: float) -> None:
        """Send everybody home, and wait for them."""
        for message in self._orchestration.end():
            with suppress(PeerLost):
                self._hub.send(message.receiver, message.kind, message.tick)
        self._processes.await_all(seconds)
