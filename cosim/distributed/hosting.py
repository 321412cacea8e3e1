"""`cosim serve`: the orchestrator of a run whose other processes people start by hand, on any host."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cosim.distributed import cluster
from cosim.distributed.assignment import EMULATOR, Share
from cosim.distributed.connecting import Place
from cosim.distributed.lobby import Lobby
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.processes import Processes
from cosim.distributed.replacement import Moment
from cosim.distributed.serving import send
from cosim.distributed.supervision import Supervisor, Tell
from cosim.errors import ClusterError
from cosim.plan import Plan
from cosim.running.command import Play
from cosim.running.inline import Interrupted, Observer, Take
from cosim.running.pacing import Pacer
from cosim.running.stopping import StopRequest
from cosim.running.watching import Watch
from cosim.scenario.names import in_short
from network.codec import encode_object
from network.transport import Envelope, Hub, Kind, PeerLost, TransportError, TransportTimeout, WireError

_WATCH_SECONDS = 0.1
_FAREWELL_SECONDS = 5.0


def main(args: argparse.Namespace) -> int:
    """Wait for all processes, and run `args.config`; the exit codes are those of `cosim run`.

    Raises:
        CosimError: a mistake, somebody who does not come, or a run that failed.
    """
    from cosim.planning import load
    from cosim.running import command

    place = Place.of(args)
    planned = load(args.config, args.set, seed=args.seed, until=args.until)
    for warning in planned.warnings:
        print(warning, file=sys.stderr)
    plan = replace(planned.plan, on_worker_loss="abort")  # nobody here can start another
    shares = cluster.division(plan, args.workers)
    settled = args.keys is not None or (args.workers is None and isinstance(plan.workers, Mapping))
    tell = partial(print, file=sys.stderr, flush=True)
    lobby = Lobby(plan, shares if settled else None, version("netcosim"))
    stop = StopRequest()
    with place.open_hub([EMULATOR, *shares]) as hub, _farewell(hub):
        if not args.quiet:
            print(_instructions(place, plan, shares, named=settled), flush=True)
        try:
            with stop.listening():
                gather(hub, lobby, args.wait, stop, tell if not args.quiet else lambda _: None)
        except Interrupted:
            return stop.exit_code
        return command.record(args, plan, partial(_way_to_play, hub, lobby.workers))


def gather(
    hub: Hub, lobby: Lobby, seconds: float, stop_requested: Callable[[], bool], tell: Callable[[str], object]
) -> None:
    """Wait until everybody is there and prepared.

    Args:
        hub: at which they join.
        lobby: receives them.
        seconds: for all of them together.
        stop_requested: asked a few times a second.
        tell: people what happens.

    Raises:
        ClusterError: somebody has not come in time.
        Interrupted: `stop_requested` said so.
    """
    deadline = time.monotonic() + seconds
    missing: list[str] = []
    while not lobby.complete:
        if stop_requested():
            raise Interrupted(0)
        if lobby.missing != missing:
            missing = lobby.missing
            tell(f"waiting for {', '.join(missing)}" if missing else "all are there; waiting until they are ready")
        if time.monotonic() > deadline:
            raise ClusterError(f"not there after {seconds:g} s: {', '.join(missing) or 'all, but not all are ready'}")
        try:
            _receive(hub, lobby)
        except TransportTimeout:
            pass
        except TransportError as error:
            raise ClusterError(str(error)) from error
        for news in lobby.news:
            tell(news)
        lobby.news.clear()


def _receive(hub: Hub, lobby: Lobby) -> None:
    try:
        envelope = hub.receive(_WATCH_SECONDS)
        send(hub, lobby.handle(envelope))
    except PeerLost as lost:
        lobby.leave(lost.name, "is gone")
        hub.forget(lost.name)
    except WireError as error:
        lobby.leave(error.sender, f"was sent away: {error.what}")
        hub.send(error.sender, Kind.FAILURE, 0, *encode_object({"message": error.what}))
    else:
        if envelope.kind is Kind.BYE:
            hub.forget(envelope.sender)


@contextmanager
def _farewell(hub: Hub) -> Iterator[None]:
    """At the end everybody is sent home who is still there, told why, and waited for."""
    why = "it was stopped"
    try:
        yield
    except Exception as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        raise
    finally:
        for name in hub.peers:
            with suppress(TransportError):
                hub.send(name, Kind.BYE, 0, *encode_object({"message": why}))
        await_departure(hub, hub.peers, _FAREWELL_SECONDS)


def await_departure(hub: Hub, names: Collection[str], seconds: float) -> None:
    """Give processes time to leave in good order."""
    deadline = time.monotonic() + seconds
    while hub.peers.intersection(names) and (left := deadline - time.monotonic()) > 0:
        try:
            hub.receive(min(left, _WATCH_SECONDS))
        except (PeerLost, TransportTimeout, WireError):
            continue
        except TransportError:  # nobody can be heard any more
            return


def _way_to_play(  # noqa: PLR0917
    hub: Hub,
    workers: Mapping[str, Share],
    args: argparse.Namespace,
    plan: Plan,
    pacer: Pacer | None,
    folder: Path,  # noqa: ARG001 - as of `cosim.running.command.Way`
    tell: Tell,
    watch: Watch | None,  # noqa: ARG001 - the components are elsewhere
) -> tuple[Play, dict[str, Any]]:
    """As `cluster.run`, with processes that are there already."""

    def play(observers: Sequence[Observer], stop_requested: Callable[[], bool], take: Take | None = None) -> None:
        guests = (EMULATOR, *workers)
        seers = observers if pacer is None else [*observers, pacer]
        orchestration = Orchestration(plan, workers, seers, take, paced=pacer is not None)
        visitors = Visitors(hub, guests)
        closed = Closed(hub, guests)
        Supervisor(plan, closed, visitors, orchestration, stop_requested, args.step_deadline, tell, pacer).run()

    return play, {"distributed": {"workers": len(workers)}}


class Closed:
    """The hub of a run that has begun: whoever comes now is told so, and who leaves is lost."""

    def __init__(self, hub: Hub, guests: Collection[str]) -> None:
        self.name = hub.name
        self.endpoints = hub.endpoints
        self._hub = hub
        self._guests = frozenset(guests)
        self._dismissed = False

    @property
    def peers(self) -> frozenset[str]:
        return self._hub.peers & self._guests

    def await_peers(
        self, names: Collection[str], timeout: float, waiting: Callable[[list[str]], None] = lambda _: None
    ) -> None:
        self._hub.await_peers(names, timeout, waiting)

    def forget(self, name: str) -> None:
        self._hub.forget(name)

    def send(self, receiver: str, kind: Kind, tick: int, *parts: bytes | bytearray | memoryview) -> None:
        self._dismissed = self._dismissed or kind is Kind.BYE
        self._hub.send(receiver, kind, tick, *parts)

    def receive(self, timeout: float) -> Envelope:
        deadline = time.monotonic() + timeout
        while True:
            try:
                envelope = self._hub.receive(max(0.0, deadline - time.monotonic()))
            except PeerLost as lost:
                if lost.name in self._guests:
                    raise
                self._hub.forget(lost.name)
                continue
            except WireError as error:
                if error.sender in self._guests:
                    raise
                continue
            if envelope.sender in self._guests:
                if envelope.kind is Kind.BYE and not self._dismissed:
                    raise PeerLost(envelope.sender, "it left the run")
                return envelope
            if envelope.kind is Kind.BYE:
                self._hub.forget(envelope.sender)
            elif envelope.kind is Kind.CLAIM:
                self._hub.send(envelope.sender, Kind.FAILURE, 0, *encode_object({"message": "the run has begun"}))

    def close(self) -> None:
        """The hub is somebody else's to close."""

    def __enter__(self) -> Closed:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class Visitors(Processes):
    """Processes that others have started: they are waited for, not ended, and nobody knows how they are."""

    def __init__(self, hub: Hub, names: Sequence[str]) -> None:
        super().__init__("", "", Path())
        self._hub = hub
        self._names = names

    def condition(self, name: str) -> str | None:  # noqa: ARG002 - as of `Processes`
        """Nothing to say."""
        return None

    def moment(self, name: str) -> Moment | None:  # noqa: ARG002 - as of `Processes`
        """Not known."""
        return None

    def dismiss(self, name: str) -> None:
        """It is not this process's to end."""

    def end(self) -> None:
        """They end by themselves."""

    def await_end(self, *names: str) -> None:
        """It is gone as far as can be seen from here."""

    def await_all(self, seconds: float, but: Collection[str] = ()) -> None:
        """Give all of them, but some, time to leave in good order."""
        await_departure(self._hub, [name for name in self._names if name not in but], seconds)


# --- what people are told ---------------------------------------------------------------------------------------------
def _instructions(place: Place, plan: Plan, workers: Mapping[str, Share], *, named: bool) -> str:
    """The commands of all the others."""
    lines = [f"run {place.run} of {plan.name} waits at {', '.join(place.endpoints)}; start the others, in any order:"]
    endpoint = place.for_others()
    for name in (EMULATOR, *workers):
        words = ["cosim", "emulator" if name == EMULATOR else "worker", "--connect", endpoint, *place.options(name)]
        if name in workers:
            agents = in_short(plan.agents[index].name for index in workers[name]).replace(", ", ",")
            if not named:
                words += ["--agents", agents]
            elif place.keys is None:  # which say the name
                words += ["--name", name]
        lines.append(f"  {shlex.join(words)}")
    return "\n".join(lines)
