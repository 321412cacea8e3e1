"""Code that never returns, or crashes, in the process of a run: somebody must say so, and keep what there is.

While components are being called, a thread looks on. It sees how long the same agent has been at the same tick, which
signals have come that Python cannot obey before a call returns, and what `cosim/kernel/crash.c` tells of crashes. Where
the run cannot go on, it has the run folder closed and ends the process.

An FMU that leaves memory in disorder can take this thread with it; then the process ends as the system lets it.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn, Protocol, Self

from cosim import native_loading, scratch
from cosim.attention import TICK, Spot, idle
from cosim.errors import ConfigError, CosimError, RunError
from cosim.running.stopping import REQUESTS, StopRequest
from cosim.screen import error_descriptor, say_at_once
from cosim.spawning import signal_name
from network.units import to_seconds

if TYPE_CHECKING:
    from cosim.agents.group import Agents
    from cosim.plan import AgentPlan

LOOK_SECONDS = 0.25
GRACE_SECONDS = 0.5
"""So long Python may take to see a signal."""

PATIENCE_SECONDS = 5.0
"""So long a crash waits for the thread, and the thread for whoever is at the record."""

_CRASHES = {getattr(signal, name, 0) for name in ("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT")}
_EXITED = 255
"""What `cosim/kernel/crash.c` says in place of a signal where native code called `exit`."""

_FAILED = 3

_DEBUGGERS = {"bdb", "pdb", "IPython", "debugpy", "pydevd", "_pydevd_bundle"}


class Record(Protocol):
    """What is to be kept of a run."""

    def keep(self, error: CosimError, *, in_order: bool) -> None:
        """Say what ended the run, and leave what was computed until then; `in_order`: nobody else is at it."""


class _AtComponents:
    """Inside, the run's own thread leaves the record alone."""

    def __init__(self, at_record: threading.Lock) -> None:
        self._at_record = at_record

    def __enter__(self) -> None:
        self._at_record.release()

    def __exit__(self, *_: object) -> None:
        self._at_record.acquire()


class Watch:
    """Looks on while a run's components are called in this process. To be entered by the main thread.

    Args:
        agents: that run.
        period_ns: T.
        deadline: seconds of wall time that a component may take for an agent's period, or to be opened or initialised.
        stop: of the run.
        record: that the run leaves.

    Attributes:
        attended: what the agents keep up to date; see `cosim.attention`.
        agents: those that are watched, once they are open.
        at_components: to be entered whenever components are called.
    """

    def __init__(
        self, agents: Sequence[AgentPlan], period_ns: int, deadline: float, stop: StopRequest, record: Record
    ) -> None:
        self.attended = idle()
        self.agents: Agents | None = None
        self._plans = agents
        self._period_ns = period_ns
        self._deadline = deadline
        self._stop = stop
        self._record = record
        self._at_record = threading.Lock()
        self.at_components = _AtComponents(self._at_record)
        self._asked: list[float] = []  # when signals came that ask for the end
        self._number = 0  # of the latest of them
        self._told = False
        self._kernel = _kernel()

    def __enter__(self) -> Self:
        self._obeyed = self._stop.count
        self._at_record.acquire()
        self._here, there = socket.socketpair()
        there.setblocking(False)
        self._there = there
        self._previous = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)
        if self._kernel is not None:
            self._kernel.cosim_watch_crashes(there.fileno(), int(1000 * PATIENCE_SECONDS), error_descriptor())
        self._thread = threading.Thread(target=self._look, name="watch", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._kernel is not None:
            self._kernel.cosim_ignore_crashes()
        signal.set_wakeup_fd(self._previous)
        self._there.close()
        self._thread.join()
        self._here.close()

    # --- the thread -------------------------------------------------------------------------------------------------
    def _look(self) -> None:
        at: tuple[int, Spot] | None = None
        held, looked = 0.0, time.monotonic()
        while True:
            if select.select([self._here], [], [], LOOK_SECONDS)[0]:
                numbers = self._here.recv(64)
                if not numbers:
                    return
                self._take(numbers)
            now, before = time.monotonic(), at
            spot = Spot.of(self.attended)
            at = None if spot.agent is None else (int(self.attended[TICK]), spot)
            # A process that was stopped for a while, or is looked at with a debugger, does not hang.
            held = held + min(now - looked, 2 * LOOK_SECONDS) if at is not None and at == before else 0.0
            looked = now
            if at is None or not self._is_here(spot):
                continue
            if held > self._deadline:
                where = "" if self._is_native(spot) else self._line(spot)
                if where is None:
                    held = 0.0
                    continue
                longer = "--step-deadline gives it longer, if it is only slow"
                self._end(self._failure(spot, f"has not returned for {self._deadline:g} s{where}; {longer}"), _FAILED)
            if self._is_native(spot):  # Python is interrupted by the signal itself
                self._see_to_requests(spot, now)

    def _take(self, numbers: bytes) -> None:
        for number in numbers:
            if number in REQUESTS:
                self._asked.append(time.monotonic())
                self._number = number
            elif number in _CRASHES or number == _EXITED:
                self._crashed(number)

    def _crashed(self, number: int) -> NoReturn:
        spot = Spot.of(self.attended)
        how = "ended the process that it runs in" if number == _EXITED else f"crashed ({signal_name(number)})"
        if spot.agent is None:
            self._end(CosimError(f"native code {how} outside of the components"), _FAILED)
        text = f"{how}; `isolate: true` gives it a process of its own"
        self._end(self._failure(spot, text), _FAILED)

    def _see_to_requests(self, spot: Spot, now: float) -> None:
        """Those that Python cannot obey, as native code does not return."""
        if len(self._asked) <= self._stop.count - self._obeyed or now - self._asked[0] < GRACE_SECONDS:
            return
        who = spot.within(self._plans[spot.agent or 0])
        if len(self._asked) > 1:
            seconds = to_seconds(max(0, int(self.attended[TICK])) * self._period_ns)
            text = f"interrupted at t = {seconds:.9g} s: no call returned from {who}"
            self._end(CosimError(text), 128 + self._number)
        if not self._told:
            self._told = True
            say_at_once(f"stopping as soon as a call returns from {who}; once more to stop at once")

    def _is_here(self, spot: Spot) -> bool:
        """Whether what is called runs in this process; others are watched there."""
        if spot.agent is None or spot.component is None:
            return False
        return self._plans[spot.agent].components[spot.component].isolation is None

    def _is_native(self, spot: Spot) -> bool:
        """Whether it is an FMU that is called."""
        if spot.agent is None or spot.component is None:
            return False
        return self._plans[spot.agent].components[spot.component].path is not None

    def _line(self, spot: Spot) -> str | None:
        """Where in its module a Python component is, in words that follow others; None where a debugger has it."""
        frame = sys._current_frames().get(threading.main_thread().ident or 0)
        stack = [] if frame is None else list(traceback.walk_stack(frame))
        modules = [str(each.f_globals.get("__name__")) for each, _ in stack]
        if any(module.partition(".")[0] in _DEBUGGERS for module in modules):
            return None
        own = (self._plans[spot.agent or 0].components[spot.component or 0].python or "").partition(":")[0]
        places = [f" (it is at {each.f_code.co_filename}:{line})" for each, line in stack]
        return next((place for place, module in zip(places, modules, strict=True) if module == own), "")

    def _failure(self, spot: Spot, text: str) -> CosimError:
        assert spot.agent is not None
        if self.agents is not None:
            return self.agents.failure(spot, text)
        agent = self._plans[spot.agent]
        return RunError(agent.name, spot.names(agent), 0.0, text)

    def _end(self, error: CosimError, code: int) -> NoReturn:
        # While a library is being loaded no other one can be, and closing the record takes some.
        in_order = not native_loading.under_way and self._at_record.acquire(timeout=PATIENCE_SECONDS)
        say_at_once("")
        self._record.keep(error, in_order=in_order)
        say_at_once(f"error: {error}" if code == _FAILED else str(error))
        scratch.remove_all()
        sys.stdout.flush()
        os._exit(code)


def _kernel() -> ctypes.CDLL | None:
    """What tells of crashes; runs without the native loop can do without it."""
    from cosim.kernel.layout import library

    try:
        return library()
    except ConfigError:
        return None
