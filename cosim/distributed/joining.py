"""`cosim emulator` and `cosim worker`: a process of a run that somebody starts by hand, on any host."""

from __future__ import annotations

import argparse
import os
import re
import socket
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from cosim.distributed.assignment import EMULATOR, Job
from cosim.distributed.connecting import Place
from cosim.distributed.failure import OPENING, Failure
from cosim.distributed.files import Offer, Procurement
from cosim.distributed.lobby import Claim
from cosim.distributed.serving import send, serve
from cosim.errors import ClusterError, ConfigError, CosimError
from cosim.logs import LOG_FOLDER, Logs
from cosim.native_output import captured
from cosim.plan import Plan
from cosim.scratch import Scratch
from network import access
from network.codec import decode_object
from network.transport import HUB, Endpoint, Envelope, Kind, Part, PeerLost, TransportTimeout, WireError

_IDLE_SECONDS = 1.0


def main(args: argparse.Namespace) -> int:
    """Take part in a run until it is over.

    Returns:
        The exit code, 0.

    Raises:
        CosimError: a mistake, or the orchestrator has no use for this process.
        ClusterError: the orchestrator does not come, or the run ended before its end.
    """
    name, agents = (EMULATOR, None) if args.role == EMULATOR else _worker(args)
    place = Place.of(args, name)
    if args.files is not None and not args.files.is_dir():
        raise CosimError(f"--files {args.files}: there is no such folder")
    folders = [folder for folder in (args.files, Path()) if folder is not None]
    claim = Claim(version("netcosim"), f"process {os.getpid()} on {socket.gethostname()}", agents)
    with Scratch() as store, place.join(name, args.wait, tell) as endpoint:
        try:
            _take_part(Witness(endpoint), claim, folders, store)
        except PeerLost as lost:
            raise ClusterError(f"the orchestrator is gone: {lost.reason}") from lost
    return 0


def tell(text: str) -> None:
    """A line on standard error, wherever that is by now."""
    print(text, file=sys.stderr, flush=True)


def _worker(args: argparse.Namespace) -> tuple[str, str | None]:
    """The worker's name and the agents that it asks for."""
    if args.name is None and args.keys is not None:
        args.name = access.name_in(args.keys)
    if args.agents is None and args.name is None:
        raise CosimError(
            "say which agents this worker carries, such as --agents 1..5, or which worker it is with --name"
        )
    host = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname()).strip("-")
    return args.name or f"{host or 'worker'}-{os.getpid()}", args.agents


def _take_part(endpoint: Witness, claim: Claim, folders: Sequence[Path], store: Path) -> None:
    offer, located, plan = prepare(endpoint, claim, folders, store)
    tell(f"{endpoint.name} is ready; waiting for the others")

    def planned(job: Job) -> Plan:
        tell("the run begins")
        same = (job.scenario, job.sha256) == (offer.job.scenario, offer.job.sha256)
        return plan if same else job.plan(located)

    started = time.strftime("%Y-%m-%dT%H-%M-%S")
    folder = Path("runs") / plan.name / f"{started}-{endpoint.name}" / LOG_FOLDER
    place = folder.absolute()  # FMUs may change the current folder
    with Logs(place) as logs, captured(logs.sink("output")):
        serve(endpoint, planned=planned, logs=logs)
    if place.exists():
        tell(f"what its components logged is in {folder}")
    if endpoint.regular:
        tell(f"the run is over{endpoint.reason}")
        return
    if endpoint.failure is not None:
        raise endpoint.failure
    if not endpoint.done:
        raise ClusterError(f"the orchestrator ended the run before its end{endpoint.reason}")
    tell("the run is over")


def prepare(
    endpoint: Endpoint, claim: Claim, folders: Sequence[Path], store: Path
) -> tuple[Offer, dict[str, Path], Plan]:
    """Claim a part, get hold of all files, plan.

    Args:
        endpoint: that has joined.
        claim: of this process.
        folders: where the user keeps files.
        store: a folder for those that are fetched.

    Returns:
        What was offered, where its FMUs are, and the plan.

    Raises:
        CosimError: it cannot be; the orchestrator is told.
        PeerLost: the orchestrator is gone.
    """
    send(endpoint, [claim.message()])
    offer = Offer.decode(_next(endpoint))
    try:
        procurement = Procurement(offer, folders, store)
        send(endpoint, procurement.ask())
        while not procurement.done:
            send(endpoint, procurement.take(_next(endpoint)))
        plan = offer.job.plan(procurement.located)
    except (CosimError, WireError) as error:
        fault = error if isinstance(error, ConfigError) else CosimError(str(error))
        endpoint.send(HUB, Kind.FAILURE, 0, *Failure(OPENING, 0, fault).encode())
        raise fault from error
    endpoint.send(HUB, Kind.PREPARED, 0)
    return offer, procurement.located, plan


def _next(endpoint: Endpoint) -> Envelope:
    """The next message, unless the orchestrator sends this process away.

    Raises:
        CosimError: it does.
    """
    while True:
        try:
            envelope = endpoint.receive(_IDLE_SECONDS)
        except TransportTimeout:
            continue
        if envelope.kind is Kind.FAILURE:
            raise CosimError(f"the orchestrator refuses: {decode_object(envelope).get('message')}")
        if envelope.kind is Kind.BYE:
            raise ClusterError(f"the orchestrator ended the run before it began{_reason(envelope)}")
        return envelope


class Witness:
    """An endpoint that remembers how the run ended for its process.

    Attributes:
        done: this process said that the last tick is behind it.
        failure: that it reported.
        reason: that the orchestrator gave with its farewell, for the end of a sentence.
        regular: whether an agent had asked for the end.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self.name = endpoint.name
        self.done = False
        self.failure: CosimError | None = None
        self.reason = ""
        self.regular = False
        self._endpoint = endpoint

    def send(self, receiver: str, kind: Kind, tick: int, *parts: Part) -> None:
        if kind is Kind.DONE:
            self.done = True
        elif kind is Kind.FAILURE:
            frame = Envelope(self.name, receiver, kind, tick, 0, memoryview(b"".join(parts)))
            self.failure = Failure.decode(frame).error
        self._endpoint.send(receiver, kind, tick, *parts)

    def receive(self, timeout: float) -> Envelope:
        envelope = self._endpoint.receive(timeout)
        if envelope.kind is Kind.BYE:
            self.reason = _reason(envelope)
            self.regular = len(envelope.body) > 0 and decode_object(envelope).get("regular") is True
        return envelope

    def close(self) -> None:
        self._endpoint.close()

    def __enter__(self) -> Witness:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


def _reason(farewell: Envelope) -> str:
    return f": {decode_object(farewell).get('message')}" if len(farewell.body) else ""
