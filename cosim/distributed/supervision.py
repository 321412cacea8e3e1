"""Drives an orchestration over a hub, and says who is to blame when it does not go on."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from cosim.distributed.assignment import EMULATOR, Share, carried
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.processes import Processes
from cosim.distributed.serving import FLUSH_SECONDS, send
from cosim.errors import ClusterError, CosimError
from cosim.inline import Interrupted
from cosim.pacing import Pacer
from cosim.plan import Plan
from network.transport import Hub, Kind, PeerLost, TransportTimeout, WireError
from network.units import to_seconds

_START_SECONDS = 60.0
_START_SECONDS_PER_AGENT = 0.1
_WATCH_SECONDS = 0.02
_SETTLE_SECONDS = 4 * FLUSH_SECONDS
_FAREWELL_SECONDS = 10.0
_FAULT_FAREWELL_SECONDS = 1.0


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
        pacer: says when ticks are released, if the run is paced.
    """

    def __init__(  # noqa: PLR0917
        self,
        plan: Plan,
        workers: Mapping[str, Share],
        hub: Hub,
        processes: Processes,
        orchestration: Orchestration,
        stop_requested: Callable[[], bool],
        step_deadline: float,
        pacer: Pacer | None = None,
    ) -> None:
        self._plan = plan
        self._workers = workers
        self._hub = hub
        self._processes = processes
        self._orchestration = orchestration
        self._stop_requested = stop_requested
        self._step_deadline = step_deadline
        self._pacer = pacer
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
            patience = self._release()
            with suppress(TransportTimeout):
                send(self._hub, orchestration.handle(self._hub.receive(patience)))
            now = time.monotonic()
            if now - watched < _WATCH_SECONDS:
                continue
            watched = now
            self._watch()
            if progress != orchestration.progress or self._waits_for_the_clock:
                progress, since = orchestration.progress, now
            elif now - since > self._deadline:
                raise self._hang()

    def _release(self) -> float:
        """Release the ticks whose time has come; how long to listen, in seconds, until something is to be done."""
        orchestration, pacer = self._orchestration, self._pacer
        if pacer is None or orchestration.unready:
            return _WATCH_SECONDS
        if orchestration.released < 0:
            pacer.start()
        due = min(pacer.released(), self._plan.ticks)
        if due > orchestration.released:
            waited = self._waits_for_the_clock
            send(self._hub, orchestration.release(due))
            if waited:
                pacer.begun(due)
        return min(_WATCH_SECONDS, pacer.remaining(due + 1))

    @property
    def _waits_for_the_clock(self) -> bool:
        """Whether all is done that is released."""
        return self._orchestration.released == self._orchestration.recorded < self._plan.ticks

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
