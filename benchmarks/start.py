"""From the command to the first tick of a distributed run, start of Python included.

    python -m benchmarks.start [--repetitions 7] [--workers 2 9]

`cosim run paper_leaders --distributed`, ten agents in so many workers; with the emulator's and its own they are two
processes more. The first tick is when the command says how far it is, which it does at once. Beside it, the processor
time of all processes of a run of one second: on a machine that others use as well, the wall says little. Yardstick: a
Python that imports NumPy and pydantic, in turns with the others.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

DEADLINE = 120.0


def processor_seconds() -> float:
    """Of all children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


COMMAND = """
import sys, time
from cosim import cli
from cosim.recording.recorder import Recorder
take = Recorder._take_rows
def first(self, *rows):
    print(time.monotonic(), flush=True)
    Recorder._take_rows = take
    take(self, *rows)
Recorder._take_rows = first
sys.exit(cli.main(sys.argv[1:]))
"""
"""`cosim`, which says when the first tick is recorded."""


def first_tick(workers: int, folder: Path) -> tuple[float, float]:
    """Seconds until the first tick, and of processor time until the end."""
    arguments = ["run", "paper_leaders", "--until", "1 s", "--no-report", "--quiet"]
    arguments += ["--distributed", "--workers", str(workers), "--out", str(folder / f"{time.monotonic_ns()}")]
    before, start = processor_seconds(), time.monotonic()
    command = [sys.executable, "-c", COMMAND, *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=DEADLINE)
    return float(done.stdout.split()[0]) - start, processor_seconds() - before


def imports() -> tuple[float, float]:
    """The same of the yardstick."""
    before, start = processor_seconds(), time.perf_counter()
    subprocess.run([sys.executable, "-c", "import numpy, pydantic.main"], check=True, timeout=DEADLINE)
    return time.perf_counter() - start, processor_seconds() - before


def main() -> None:
    """Measure in turns, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 9])
    args = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for repetition in range(args.repetitions + 1):
            now = {f"{workers} workers": first_tick(workers, Path(folder)) for workers in args.workers}
            now["python -c 'import numpy, pydantic.main'"] = imports()
            if repetition:  # the first warms the file caches
                for name, seconds in now.items():
                    found.setdefault(name, []).append(seconds)
    print("| | first tick: median, smallest | processor time |")
    print("|---|---:|---:|")
    for name, all_seconds in found.items():
        walls, used = zip(*all_seconds, strict=True)
        print(f"| {name} | {statistics.median(walls):.2f} s, {min(walls):.2f} s | {statistics.median(used):.2f} s |")


if __name__ == "__main__":
    main()
