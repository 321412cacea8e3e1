"""Drives an orchestration over a hub, replaces lost workers, and says who is to blame when a run does not go on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeAlias

from cosim.distributed.assignment import EMULATOR
from cosim.distributed.failure import INITIALISING, OPENING
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.processes import Processes
from cosim.distributed.replacement import Moment, when
from cosim.distributed.serving import send
from cosim.distributed.standing import carried, waits
from cosim.errors import ClusterError, CosimError, RunEndedError
from cosim.plan import Plan
from cosim.running.inline import Interrupted
from cosim.running.pacing import Pacer
from network.transport import Hub, PeerLost, TransportError, TransportTimeout, WireError
from network.units import to_seconds

Tell: TypeAlias = Callable[[str, Mapping[str, Any] | None], None]

_START_SECONDS = 60.0
_START_SECONDS_PER_AGENT = 0.1
_WATCH_SECONDS = 0.02
_FIRST_ASK_SECONDS = 0.1
"""After so long without progress, everybody is asked how far they are: what they had got to by then is no progress
later, and a message that was lost is noticed."""
_ASK_SECONDS = 0.5
"""How often they are asked from then on."""
_ANSWER_SECONDS = 0.2
"""Whoever has not answered after so long is at work, stopped, or cut off."""
_TELL_SECONDS = 5.0
"""How often to say how far replacements are."""
_SETTLE_SECONDS = 1.0
_AHEAD_TICKS = 32
"""Released ticks of a paced run that nobody has got to yet: what is sent to a process that is stopped is bounded."""
_GAP_SECONDS = 4.0
"""Others on other hosts take this process for lost if it does nothing for 5 s."""
_LATELY_SECONDS = 5.0
_FAREWELL_SECONDS = 10.0
_FAULT_FAREWELL_SECONDS = 1.0


class Supervisor:
    """Drives an orchestration over a hub, and finds out who is to blame when it does not go on.

    Args:
        plan: what runs.
        hub: at which the processes join.
        processes: that were started.
        orchestration: what to do with their messages.
        stop_requested: asked a few times a second.
        step_deadline: seconds in which some process must get further.
        tell: is told, in a line, what happens to a worker, and what the manifest says of a restart.
        pacer: says when ticks are released, if the run is paced.
    """

    def __init__(  # noqa: PLR0917
        self,
        plan: Plan,
        hub: Hub,
        processes: Processes,
        orchestration: Orchestration,
        stop_requested: Callable[[], bool],
        step_deadline: float,
        tell: Tell,
        pacer: Pacer | None = None,
    ) -> None:
        self._plan = plan
        self._hub = hub
        self._processes = processes
        self._orchestration = orchestration
        self._stop_requested = stop_requested
        self._step_deadline = step_deadline
        self._pacer = pacer
        self._start_deadline = _START_SECONDS + _START_SECONDS_PER_AGENT * len(plan.agents)
        self._tell = tell
        self._awake = time.monotonic()
        self._gap, self._gap_ended = 0.0, -math.inf

    def run(self) -> None:
        """Until the run is over; see `cosim.distributed.cluster.run`."""
        farewell, why, regular = _FAULT_FAREWELL_SECONDS, "it was stopped", False
        try:
            self._await_joined()
            send(self._hub, self._orchestration.begin())
            self._play()
            farewell, why = _FAREWELL_SECONDS, ""
        except WireError as error:
            why = str(error)
            sent = carried(self._plan, error.sender, self._orchestration.workers)
            text = f"{error}; tick {self._orchestration.recorded} is the last one recorded\n  {sent} sent it"
            raise ClusterError(text) from error
        except TransportError as error:
            why = str(error)
            raise ClusterError(f"{error}; tick {self._orchestration.recorded} is the last one recorded") from error
        except RunEndedError as ended:
            farewell, why, regular = _FAREWELL_SECONDS, str(ended).partition("\n")[0], True
            raise
        except CosimError as error:
            why = str(error).partition("\n")[0]
            raise
        finally:
            self._dismiss(farewell, why, regular=regular)

    def _await_joined(self) -> None:
        deadline = time.monotonic() + self._start_deadline
        while True:
            try:
                self._hub.await_peers(self._orchestration.processes, _WATCH_SECONDS)
            except TransportTimeout:
                self._watch()
                if time.monotonic() > deadline:
                    missing = [name for name in self._orchestration.processes if name not in self._hub.peers]
                    self._resolve(missing, f"did not join within {self._start_deadline:g} s", settled=True)
                    deadline = time.monotonic() + self._start_deadline
            else:
                return

    def _play(self) -> None:
        orchestration = self._orchestration
        progress, since = orchestration.progress, time.monotonic()
        watched = asked = told = since
        while not orchestration.finished:
            patience = self._release()
            with suppress(TransportTimeout):
                self._receive(patience)
            now = time.monotonic()
            if now - watched < _WATCH_SECONDS:
                continue
            watched = now
            self._watch()
            self._employ()
            if now - told > _TELL_SECONDS:
                told = now
                for name, tick, goal in orchestration.behind():
                    self._tell(f"{name} is at tick {tick} of {goal}", None)
            answered = asked > since and orchestration.all_answered(())
            overdue = now - since > self._deadline
            if progress != orchestration.progress or self._waits_for_the_clock:
                progress, since = orchestration.progress, now
            elif overdue and asked > since and (answered or now - asked > _ANSWER_SECONDS):
                self._hang()
                since = time.monotonic()
            elif answered or (now - asked > _ASK_SECONDS if asked > since else now - since > _FIRST_ASK_SECONDS):
                if not self._find_lost_message():
                    send(self._hub, orchestration.ask())
                asked = now

    def _receive(self, timeout: float) -> None:
        """Handle the next message, or the loss of a process.

        Raises:
            TransportTimeout: there is none.
        """
        try:
            envelope = self._hub.receive(timeout)
        except PeerLost as lost:
            self._lose(lost.name, lost.reason)
        else:
            send(self._hub, self._orchestration.handle(envelope))
            for name, tick in self._orchestration.caught_up():
                self._tell(
                    f"{carried(self._plan, name, self._orchestration.workers)} has caught up at tick {tick}", None
                )

    def _release(self) -> float:
        """Release the ticks whose time has come; how long to listen, in seconds, until something is to be done."""
        orchestration, pacer = self._orchestration, self._pacer
        if pacer is None or orchestration.unready:
            return _WATCH_SECONDS
        if orchestration.released < 0:
            pacer.start()
        due = min(pacer.released(), self._plan.ticks)
        if due > orchestration.recorded + _AHEAD_TICKS:  # everybody is late: whatever comes is the signal to go on
            due = orchestration.recorded + _AHEAD_TICKS
            patience = _WATCH_SECONDS
        else:
            patience = min(_WATCH_SECONDS, pacer.remaining(due + 1))
        if due > orchestration.released:
            waited = self._waits_for_the_clock
            send(self._hub, orchestration.release(due))
            if waited:
                pacer.begun(due)
        return patience

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
        self._notice_gap()
        name = self._processes.lost()
        if name is not None:
            self._lose(name, "its process is gone")

    def _notice_gap(self) -> None:
        """Remember when this process did not get to listen."""
        now = time.monotonic()
        if now - self._awake > _GAP_SECONDS:
            self._gap, self._gap_ended = now - self._awake, now
        self._awake = now

    def _employ(self) -> None:
        """Give a job to replacements that have joined."""
        joined = self._hub.peers.intersection(self._orchestration.unemployed)
        if joined:
            send(self._hub, self._orchestration.employ(sorted(joined)))

    # --- faults -----------------------------------------------------------------------------------------------------
    def _lose(self, name: str, reason: str) -> None:
        """A process is gone, or cut off: replace it, or end the run."""
        if name not in self._orchestration.processes:  # it has been replaced
            return
        self._notice_gap()
        self._processes.await_end(name, EMULATOR)
        if self._processes.condition(EMULATOR) is not None:  # with it, all connections may have broken
            name = EMULATOR
        condition = self._processes.condition(name)
        self._resolve([name], condition or "was lost", "" if condition else f": {reason}")

    def _hang(self) -> None:
        """Nobody gets further: replace whoever holds the others up, or end the run."""
        deadline = self._deadline
        if self._find_lost_message():
            return
        culprits = self._orchestration.unready or self._orchestration.standing().culprits()
        if self._processes.condition(EMULATOR) is not None:  # through which all are connected
            culprits = (EMULATOR,)
        stopped = [text for name in culprits if (text := self._processes.condition(name))]
        self._resolve(culprits, stopped[0] if stopped else f"did not get further for {deadline:g} s", settled=True)

    def _find_lost_message(self) -> bool:
        """Replace a worker whose stream has a hole, or end the run; whether there is one."""
        lost = self._orchestration.lost_message()
        if lost is None:
            return False
        worker = lost.receiver if lost.sender == EMULATOR else lost.sender
        way = "from" if lost.sender == EMULATOR else "to"
        hole = f"is cut off (the {lost.kind.name.lower()} of tick {lost.tick} got lost on the way {way} the emulator)"
        self._resolve([worker], hole)
        return True

    def _resolve(self, names: Sequence[str], condition: str, detail: str = "", *, settled: bool = False) -> None:
        """Replace processes, or end the run by an account of who is to blame.

        Args:
            names: of the processes.
            condition: what became of them; the tick will follow.
            detail: that follows the tick.
            settled: whether all that was under way has been taken.

        Raises:
            CosimError: the run is over.
        """
        orchestration = self._orchestration
        moments = {name: self._moment(name) for name in names}
        objections = []
        if self._plan.on_worker_loss == "restart" and EMULATOR not in names:
            for name in names:
                objection = orchestration.why_not_replaced(name, moments[name])
                if objection is None and (obstacle := self._processes.obstacle()) is not None:
                    objection = f"is not replaced: {obstacle}"
                if objection is None:
                    self._replace(name, moments[name], condition)
                else:
                    objections.append((name, objection))
            if not objections:
                return
            names = [name for name, _ in objections]
        if not settled:
            self._settle(names)
        if orchestration.failure is not None:
            raise orchestration.failure.error
        further = [f"{name} {why}" for name, why in objections]
        raise self._account(names, f"{condition} {self._when(moments[names[0]])}{detail}", further)

    def _moment(self, name: str) -> Moment:
        """When it was lost, and at which agent."""
        share = self._orchestration.workers.get(name)
        known = self._processes.moment(name)
        if share is None or known is None:
            begun = name not in self._orchestration.unready
            return Moment(self._orchestration.position(name) if begun else OPENING)
        spot = known.spot
        return known if spot.agent is None else replace(known, spot=replace(spot, agent=share[spot.agent]))

    def _replace(self, name: str, moment: Moment, condition: str) -> None:
        who = carried(self._plan, name, self._orchestration.workers)
        self._processes.dismiss(name)
        new, messages = self._orchestration.replace(name, moment)
        send(self._hub, messages)
        self._processes.start([new])
        entry = {"worker": name, "replaced_by": new, "why": condition, "tick": moment.tick}
        self._tell(f"{who} {condition} {self._when(moment)}; {new} takes its place", entry)

    # --- accounts of faults -----------------------------------------------------------------------------------------
    def _account(self, names: Sequence[str], what: str, further: Sequence[str]) -> ClusterError:
        workers = self._orchestration.workers
        who = " and ".join(carried(self._plan, name, workers) for name in names)
        lines = [f"{who} {what}", *further]
        if time.monotonic() - self._gap_ended < _LATELY_SECONDS:
            lines.append(
                f"the orchestrator itself did not listen for {self._gap:.1f} s before that (stopped, as by Ctrl-Z?)"
            )
        cut_off = self._processes.condition(EMULATOR) is not None
        lines += waits(self._plan, workers, self._orchestration.standing(), names, cut_off=cut_off)
        return ClusterError("\n  ".join(lines))

    def _when(self, moment: Moment) -> str:
        """When it was, and what was being done."""
        seconds = to_seconds(max(0, moment.tick) * self._plan.period_ns)
        text = when(moment) if moment.tick < 0 else f"{when(moment)} (t = {seconds:.9g} s)"
        if moment.spot.agent is not None:
            doing = {OPENING: "opened", INITIALISING: "initialised"}.get(moment.tick, "advanced")
            text += f", while it {doing} {moment.spot.within(self._plan.agents[moment.spot.agent])}"
        return text

    def _settle(self, but: Collection[str] = ()) -> None:
        """Take what is still under way, so that all that is complete is recorded, and learn how far everybody is.

        Args:
            but: of these no answer is expected.
        """
        orchestration = self._orchestration
        send(self._hub, orchestration.ask())
        if orchestration.all_answered(but):  # nobody is there to answer
            return
        cut_off = self._processes.condition(EMULATOR) is not None
        deadline = time.monotonic() + (0.0 if cut_off else _SETTLE_SECONDS)
        while (left := deadline - time.monotonic()) > 0 or cut_off:
            try:
                send(self._hub, orchestration.handle(self._hub.receive(max(0.0, left))))
            except (PeerLost, WireError):
                continue
            except (TransportError, CosimError):
                return
            if orchestration.all_answered(but):
                if orchestration.settled(but):
                    return
                send(self._hub, orchestration.ask())

    def _dismiss(self, seconds: float, why: str, *, regular: bool) -> None:
        """Send everybody home, and wait for them; the emulator, through which all may be connected, goes last."""
        if self._processes.condition(EMULATOR) is not None:  # nobody hears it
            seconds = 0.0
        farewells = self._orchestration.end(why, regular=regular)
        for last in (False, True):
            for message in farewells:
                if (message.receiver == EMULATOR) == last:
                    with suppress(TransportError):
                        send(self._hub, [message])
            self._processes.await_all(seconds, () if last else (EMULATOR,))
        self._processes.end()  # a connection to a process that is stopped would take its time to close
