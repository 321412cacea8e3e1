"""Does a long distributed run grow? Memory, threads and file descriptors of all its processes over 200,000 steps.

    python -m benchmarks.soak [--steps 200000] [--workers 2] [--agents 4]

The run is `cosim run --distributed` in a fresh process. Once a second the resident memory (without file pages, which
come and go with the page cache), the threads and the descriptors of each of its processes are read from /proc. What
counts is the trend once everything has been touched: the median of the last quarter beside that of the second. Run it
from the repository's root, on Linux.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.distributed import ROOT
from benchmarks.peers.exchange import AGE
from benchmarks.scaling import PERIOD_MS, scenario

DEADLINE = 3600.0
SECONDS_BETWEEN = 1.0


@dataclass(frozen=True)
class Reading:
    """Of one process at one time: resident memory in MiB, and counts."""

    memory: float
    threads: int
    descriptors: int


def processes(pid: int) -> Iterator[tuple[str, int]]:
    """A process of a run and its children: what each is, and its number."""
    yield "orchestrator", pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        if b"_process" in words:
            yield words[words.index(b"_process") + 1].decode(), int(child)


def read(pid: int) -> Reading:
    """A reading of one process."""
    status = dict(
        line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":\t" in line
    )
    memory = int(status["RssAnon"].split()[0]) / 1024
    return Reading(memory, int(status["Threads"]), len(list(Path(f"/proc/{pid}/fd").iterdir())))


def watch(command: Sequence[str]) -> dict[str, list[Reading]]:
    """Readings of every process of a run until it ends.

    Raises:
        RuntimeError: it failed, or took too long.
    """
    readings: dict[str, list[Reading]] = {}
    deadline = time.monotonic() + DEADLINE
    run = subprocess.Popen(command, cwd=ROOT)
    try:
        while True:
            try:
                run.wait(SECONDS_BETWEEN)
                break
            except subprocess.TimeoutExpired:
                if time.monotonic() > deadline:
                    raise RuntimeError(f"the run has not ended after {DEADLINE:g} s") from None
            try:
                now = {name: read(pid) for name, pid in processes(run.pid)}
            except (FileNotFoundError, ProcessLookupError, KeyError):  # it ended while we looked
                continue
            for name, reading in now.items():
                readings.setdefault(name, []).append(reading)
    finally:
        run.kill()
        run.wait()
    if run.returncode:
        raise RuntimeError(f"the run ended with exit code {run.returncode}")
    return readings


def quarters(readings: Sequence[Reading]) -> tuple[Reading, Reading]:
    """Medians of the second and of the last quarter."""
    n = len(readings)
    parts = readings[n // 4 : n // 2], readings[n - n // 4 :]

    def median(part: Sequence[Reading]) -> Reading:
        return Reading(
            statistics.median(r.memory for r in part),
            round(statistics.median(r.threads for r in part)),
            round(statistics.median(r.descriptors for r in part)),
        )

    return median(parts[0]), median(parts[1])


def main() -> None:
    """Run, watch and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--agents", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config, out = folder / "soak.yaml", folder / "run"
        config.write_text(scenario("talker", args.agents, args.steps, Path(), AGE * PERIOD_MS), encoding="utf-8")
        command = [sys.executable, "-m", "cosim", "run", str(config), "--out", str(out), "--quiet", "--no-report"]
        started = time.perf_counter()
        readings = watch([*command, "--distributed", "--workers", str(args.workers)])
        seconds = time.perf_counter() - started
        manifest = json.loads((out / "manifest.json").read_text())
    n = len(readings["emulator"])
    print(f"{manifest['ticks']['done']} steps in {seconds:.0f} s; second and last quarter of {n} readings")
    print("process         memory / MiB        threads    descriptors")
    for process, of_it in readings.items():
        a, b = quarters(of_it)
        print(
            f"{process:<14} {a.memory:7.1f} -> {b.memory:<7.1f} {a.threads:4} -> {b.threads:<4} "
            f"{a.descriptors:4} -> {b.descriptors}"
        )


if __name__ == "__main__":
    main()
