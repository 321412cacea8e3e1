"""A distributed run on this host: starts the processes, and drives them."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from cosim.distributed.assignment import EMULATOR, Share, divide, share_of
from cosim.distributed.inheritance import leave_word
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.processes import Processes
from cosim.distributed.standing import carried
from cosim.distributed.supervision import Supervisor, Tell
from cosim.errors import ClusterError, CosimError
from cosim.plan import Plan, Workers
from cosim.running.inline import Interrupted, Observer, Take
from cosim.running.pacing import Pacer
from cosim.scratch import Scratch, place_for_socket
from network.transport import Hub, TransportError

PER_AGENT: Final = "per-agent"
STEP_DEADLINE = 30.0
"""Seconds in which some process must get further."""

_ROUTER_SECONDS = 60.0
_TRY_SECONDS = 1.0


def division(plan: Plan, wanted: str | None) -> dict[str, Share]:
    """Which worker carries which agents.

    Args:
        plan: its `workers` count unless something else is wanted; if it has none, one worker per core.
        wanted: a number or `per-agent`; None for what the plan says.

    Raises:
        CosimError: not a number of workers.
    """
    n_agents = len(plan.agents)
    workers: Workers = plan.workers if wanted is None else _parsed(wanted)
    if isinstance(workers, Mapping):
        return {name: share_of(agents) for name, agents in workers.items()}
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return divide(n_agents, n_agents if workers == PER_AGENT else workers)


def _parsed(wanted: str) -> Workers:
    """The number, or `per-agent`, on the command line."""
    if wanted == PER_AGENT:
        return PER_AGENT
    if not wanted.isascii() or not wanted.isdigit() or int(wanted) == 0:
        raise CosimError(f"--workers {wanted}: write a number from 1, or {PER_AGENT!r}")
    return int(wanted)


def run(  # noqa: PLR0917
    plan: Plan,
    workers: int | Mapping[str, Share],
    observers: Sequence[Observer],
    stop_requested: Callable[[], bool] = lambda: False,
    take: Take | None = None,
    tell: Tell = lambda _text, _restart: None,
    step_deadline: float = STEP_DEADLINE,
    pacer: Pacer | None = None,
    folder: Path | None = None,
) -> None:
    """Play a plan in processes of their own: an emulator and workers.

    Args:
        plan: what to run.
        workers: how many workers carry the agents, or the agents of each.
        observers: told of every tick and every fate, in order, as by `cosim.running.inline.run`.
        stop_requested: asked a few times a second.
        take: gives the values from outside that are new at a tick, as in `cosim.running.inline.run`.
        tell: is told, in a line, what happens to a worker, and what the manifest says of a restart.
        step_deadline: seconds in which some process must get further.
        pacer: holds the run back to the pace of the wall; without one, it runs as fast as it can.
        folder: the run folder, for the emulator to bring in order if this process is killed.

    Raises:
        RunError: a component failed, or (`RunEndedError`) asked for the end.
        ClusterError: a process was lost, or hangs.
        Interrupted: `stop_requested` said so.
        OverrunError: the pacer said so.
    """
    if isinstance(workers, int):
        workers = divide(len(plan.agents), workers)
    run_id = secrets.token_hex(8)
    with (
        Scratch() as scratch,
        place_for_socket(scratch) as socket,
        Processes(run_id, f"unixsock-stream/{socket}", scratch) as processes,
    ):
        if folder is not None:
            leave_word(scratch, folder)
        processes.start((EMULATOR, *workers))
        seers = observers if pacer is None else [*observers, pacer]
        orchestration = Orchestration(plan, workers, seers, take, paced=pacer is not None)
        with _hub(run_id, plan, workers, processes, stop_requested) as hub:
            Supervisor(plan, hub, processes, orchestration, stop_requested, step_deadline, tell, pacer).run()


def _hub(
    run_id: str,
    plan: Plan,
    workers: Mapping[str, Share],
    processes: Processes,
    stop_requested: Callable[[], bool],
) -> Hub:
    """The hub, as soon as the emulator's process, which is the router, is there to connect to.

    A worker that is lost meanwhile is replaced later, if it is to be.
    """
    from network.zenoh import WATCHED, open_hub

    deadline = time.monotonic() + _ROUTER_SECONDS
    while True:
        try:
            return open_hub(run_id, connect=[processes.endpoint], settings=WATCHED, timeout=_TRY_SECONDS)
        except TransportError as error:
            if stop_requested():
                raise Interrupted(0) from error
            lost = processes.lost()
            if lost == EMULATOR or (lost is not None and plan.on_worker_loss == "abort"):
                who = carried(plan, lost, workers)
                raise ClusterError(
                    f"{who} {processes.condition(lost)} before the first tick\n  all others wait for all to be ready"
                ) from error
            if time.monotonic() > deadline:
                raise ClusterError(f"the emulator did not begin to listen within {_ROUTER_SECONDS:g} s") from error
