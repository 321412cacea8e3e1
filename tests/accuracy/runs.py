"""Runs of the real command, to be compared with the exact solution."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.reference.network_ode import Solution
from tests.reference.run_folder import RunFolder

ROOT = Path(__file__).parents[2]
CONTROLLER = "templates.arm.components.controller.start"


@dataclass(frozen=True)
class Finished:
    """What a run left: its exit code, what it printed, and its folder."""

    code: int
    message: str
    folder: RunFolder


def cosim_run(config: str, out: Path, *changes: str, until: str | None = None) -> Finished:
    """`cosim run` in a process of its own, with `--set` for each change."""
    command = [sys.executable, "-m", "cosim", "run", config, "--out", str(out), "--quiet", "--no-report"]
    command += [part for change in changes for part in ("--set", change)]
    command += ["--until", until] if until else []
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return Finished(done.returncode, done.stderr, RunFolder(out))


def completed(config: str, out: Path, *changes: str, until: str | None = None) -> RunFolder:
    """The folder of a run that must succeed."""
    run = cosim_run(config, out, *changes, until=until)
    if run.code != 0:
        raise RuntimeError(f"cosim run {config} {' '.join(changes)}: {run.message}")
    return run.folder


def position_error(run: RunFolder, exact: Solution) -> float:
    """Largest difference of an angle from the exact solution, over all arms and the ticks that both have, rad."""
    ticks = min(len(exact.p), run.ticks + 1)
    return float(np.abs(run.recorded("plant.p")[:ticks] - exact.p[:ticks]).max())


def same_network(run: RunFolder, other: RunFolder) -> bool:
    """Whether two runs, of which the first may be shorter, had the same agents and deliveries."""
    end = run.ticks * run.period_ns

    def rows(folder: RunFolder) -> set[tuple[int, ...]]:
        columns = (folder.log.sender, folder.log.receiver, folder.log.stamp, folder.log.arrival_ns)
        return {row for row in zip(*(column.tolist() for column in columns), strict=True) if row[3] <= end}

    return run.agents == other.agents and rows(run) == rows(other)
