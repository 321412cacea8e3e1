"""A distributed run on this host: starts the processes, and drives them."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from cosim.distributed.assignment import EMULATOR, divide
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.processes import Processes
from cosim.distributed.supervision import Supervisor
from cosim.errors import ClusterError, CosimError
from cosim.inline import Observer
from cosim.plan import Plan
from cosim.scratch import Scratch
from network.transport import Hub, TransportError

PER_AGENT = "per-agent"
STEP_DEADLINE = 30.0
"""Seconds in which some process must get further."""


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
    with Scratch() as scratch, _hub(scratch) as (run_id, hub), Processes((EMULATOR, *workers)) as processes:
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
