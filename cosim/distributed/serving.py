"""The life of a process of a distributed run, other than the orchestrator: join, take a job, serve until the end.

It ends by itself, and leaves nothing behind, as soon as the orchestrator is gone: its connection breaks, and the pipe
that is its standard input, which only the orchestrator holds open, ends. The latter is noticed even while a component
hangs in native code.
"""

from __future__ import annotations

import argparse
import gc
import os
import shutil
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import BinaryIO, NoReturn, Protocol, cast

from cosim.distributed.assignment import EMULATOR, ORCHESTRATOR, Job, Message
from cosim.distributed.emulation import Emulation
from cosim.distributed.failure import OPENING, Failure
from cosim.distributed.inheritance import EXIT_ORPHANED, EXIT_OUTSIDE, bequest, inherit, run_folder
from cosim.distributed.worker import Worker
from cosim.errors import ClusterError, CosimError
from cosim.logs import LOG_FOLDER, NO_LOGS, Logs
from cosim.plan import Plan
from network.channel import ChannelError
from network.messages import Ints
from network.transport import Endpoint, Envelope, Kind, PeerLost, Refused, TransportTimeout, WireError

FLUSH_SECONDS = 0.05
"""How long rows and fates may be held back."""

_MOST_TICKS = 64
_TOGETHER_SECONDS = 0.0005
"""How long ticks are worked on before they travel: some times what it costs to send a message."""

_TOGETHER_AT_EMULATOR = 0.005
"""The same for the emulator, whose work costs by the worker more than by the tick."""

_IDLE_SECONDS = 1.0
_ONE_THREAD = "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))"
"""Of Zenoh, for a process that relays nothing: fewer threads to wake. A router would block itself with it."""

_JOIN_SECONDS = 120.0
_GRACE_SECONDS = 0.5
_MAIL_BYTES = 32 << 20
"""Kept in memory for replacements of lost workers; more goes to a file."""


class Machine(Protocol):
    """What a worker and the emulator have in common.

    The call order is `prepare`, then `take`, `act` and `flush` as they come until `finished`, then `close`. Between
    what comes in and what goes out, as many ticks are gathered as there are: how many changes no result.
    """

    finished: bool

    @property
    def tick(self) -> int:
        """How far it is."""

    @property
    def busy(self) -> bool:
        """Whether `act` would do something."""

    @property
    def holds_back(self) -> bool:
        """Whether `flush` would send something."""

    def prepare(self) -> list[Message]:
        """Before anything else."""

    def take(self, envelope: Envelope) -> list[Message]:
        """Hand over a message; what is to be said to it at once."""

    def act(self, most: int) -> list[Message]:
        """Go on by `most` ticks at most, as far as what was taken allows."""

    def flush(self) -> list[Message]:
        """What is held back."""

    def close(self) -> None:
        """At the end."""


def machine(
    name: str,
    job: Job,
    whereabouts: Ints | None = None,
    planned: Callable[[Job], Plan] = Job.plan,
    logs: Logs = NO_LOGS,
) -> Machine:
    """The state machine of the process of that name, its job `planned`; see `serve`."""
    plan = planned(job)
    if name == EMULATOR:
        in_memory = _MAIL_BYTES // len(job.workers)
        return Emulation(plan, job.workers, lambda: cast(BinaryIO, SpooledTemporaryFile(in_memory)))
    return Worker(plan, name, job.workers, whereabouts, logs)


def send(endpoint: Endpoint, messages: Sequence[Message]) -> None:
    """Send messages in their order."""
    for message in messages:
        endpoint.send(message.receiver, message.kind, message.tick, *message.parts)


def serve(
    endpoint: Endpoint,
    whereabouts: Ints | None = None,
    planned: Callable[[Job], Plan] = Job.plan,
    logs: Logs = NO_LOGS,
) -> None:
    """Take a job from the orchestrator and carry it out until its BYE.

    Args:
        endpoint: of this process.
        whereabouts: see `Worker`.
        planned: plans the job.
        logs: where what components log goes.

    Raises:
        PeerLost: the orchestrator is gone.
    """
    served: Machine | None = None
    hold_back = FLUSH_SECONDS
    try:
        while served is None:
            envelope = _next(endpoint, _IDLE_SECONDS)
            if envelope is not None and envelope.kind is Kind.BYE:
                return
            if envelope is not None:
                job = Job.decode(envelope)
                served = machine(endpoint.name, job, whereabouts, planned, logs)
                hold_back = 0.0 if job.paced else FLUSH_SECONDS
        send(endpoint, served.prepare())
        gc.enable()
        _carry_out(endpoint, served, hold_back)
    except PeerLost:
        raise
    except Exception as error:
        if isinstance(error, (ChannelError, CosimError, WireError, OSError)):
            text = str(error)
        elif isinstance(error, MemoryError):
            text = f"memory ran out{': ' if str(error) else ''}{error}"
        else:
            text = f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
        about = error.sender if isinstance(error, WireError) else ""
        failure = Failure(OPENING, 0, ClusterError(text.rstrip()), about)
        endpoint.send(ORCHESTRATOR, Kind.FAILURE, 0, *failure.encode())
        _await_farewell(endpoint)
    finally:
        if served is not None:
            served.close()


def _carry_out(endpoint: Endpoint, served: Machine, hold_back: float) -> None:
    """Take all that has come, act on it, until the end; rows and fates go out after at most `hold_back` seconds."""
    together = _TOGETHER_AT_EMULATOR if endpoint.name == EMULATOR else _TOGETHER_SECONDS
    flushed, per_tick = time.monotonic(), together / _MOST_TICKS
    while not served.finished:
        envelope = _next(endpoint, 0 if served.busy else hold_back if served.holds_back else _IDLE_SECONDS)
        idle = envelope is None
        while envelope is not None and not served.finished:
            send(endpoint, served.take(envelope))
            envelope = _next(endpoint, 0)
        if served.busy:
            tick, began = served.tick, time.monotonic()
            messages = served.act(max(1, min(_MOST_TICKS, int(together / per_tick))))
            took = (time.monotonic() - began) / max(1, served.tick - tick)
            per_tick = min(took, 2 * per_tick)  # so that a single delay, as of a busy host, does not count for much
            send(endpoint, messages)
        now = time.monotonic()
        if now - flushed >= hold_back or (idle and not served.busy):
            send(endpoint, served.flush())
            flushed = now


def _next(endpoint: Endpoint, timeout: float) -> Envelope | None:
    """The next message, None if there is none in time."""
    try:
        return endpoint.receive(timeout)
    except TransportTimeout:
        return None


def _await_farewell(endpoint: Endpoint) -> None:
    said_farewell = False
    while not said_farewell:
        with suppress(WireError):  # one failure is enough
            envelope = _next(endpoint, _IDLE_SECONDS)
            said_farewell = envelope is not None and envelope.kind is Kind.BYE and envelope.sender == ORCHESTRATOR


# --- the process ------------------------------------------------------------------------------------------------------


def main(args: argparse.Namespace) -> NoReturn:
    """What `cosim` starts for every worker and for the emulator; see `cosim.distributed.cluster`."""
    tempfile.tempdir = str(args.scratch)
    orphaned, folder = threading.Event(), bequest(args.scratch, args.name)
    guard = threading.Thread(target=_guard, args=(args, folder, orphaned), name="guard", daemon=True)
    guard.start()
    listen = args.name == EMULATOR  # half the way for samples and mail: the router is where they go
    if not listen:
        os.environ.setdefault("ZENOH_RUNTIME", _ONE_THREAD)
    from cosim.distributed import whereabouts
    from network.zenoh import WATCHED, connect

    code = 0
    try:
        with _logs(args) as logs:
            where = [args.endpoint]
            endpoint = connect(args.run, args.name, where, settings=WATCHED, timeout=_JOIN_SECONDS, listen=listen)
            serve(endpoint, whereabouts.write_to(args.scratch, args.name), logs=logs)
    except PeerLost:
        code = EXIT_ORPHANED
        if orphaned.wait(_GRACE_SECONDS):  # else it is the router that is gone, and the orchestrator clears up
            _clear_up(args)
    except (Refused, TransportTimeout) as error:
        print(f"error: {args.name} cannot join the run: {error}", file=sys.stderr)
        code = EXIT_OUTSIDE
    if code and folder is not None and orphaned.wait(_GRACE_SECONDS):
        guard.join()  # it ends the process, when it has done all that is to be done
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # closing a session can take seconds while others of the run close theirs, and nothing needs it


@contextmanager
def _logs(args: argparse.Namespace) -> Iterator[Logs]:
    """Where what this worker's components log and print goes: not to the screen."""
    folder = None if args.name == EMULATOR else run_folder(args.scratch)
    if folder is None:
        yield NO_LOGS
        return
    from cosim.native_output import captured

    with Logs(folder / LOG_FOLDER) as logs, captured(logs.sink(f"{args.name}.output")):
        yield logs


def _clear_up(args: argparse.Namespace) -> None:
    """Remove the run's temporary folder, and that of its socket: the orchestrator cannot do it any more."""
    for folder in (args.scratch, Path(args.endpoint.partition("/")[2]).parent):
        shutil.rmtree(folder, ignore_errors=True)


def _guard(args: argparse.Namespace, folder: Path | None, orphaned: threading.Event) -> None:
    """End the process once the orchestrator is gone, whatever its main thread is doing."""
    while os.read(0, 1):
        pass
    if folder is None:
        time.sleep(_GRACE_SECONDS)
    orphaned.set()
    with suppress(Exception):  # nobody is left to be told
        if folder is not None:
            inherit(folder, EXIT_ORPHANED)
    _clear_up(args)
    os._exit(EXIT_ORPHANED)
