"""Whole commands: `cosim run` against real time, drawing the report, and `cosim --help`.

    python benchmarks/run.py [--repetitions 7]

Each command is a fresh process, start-up included; medians. The yardsticks in the same run: real time (60 simulated
seconds), and a Python process that only imports NumPy.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def seconds(command: list[str], folder: Path) -> float:
    """Wall time of one process."""
    start = time.perf_counter()
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return time.perf_counter() - start


def main() -> None:
    """Measure, in turn, so that a change of the machine's speed hits all alike."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=7)
    repetitions = parser.parse_args().repetitions
    cosim = [sys.executable, "-m", "cosim"]
    times: dict[str, list[float]] = {"run": [], "report": [], "help": [], "numpy": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for i in range(repetitions + 1):  # the first is a warm-up
            out = f"run{i}"
            measured = {
                "run": seconds([*cosim, "run", "paper_leaders", "--quiet", "--no-report", "--out", out], folder),
                "report": seconds([*cosim, "report", out], folder),
                "help": seconds([*cosim, "--help"], folder),
                "numpy": seconds([sys.executable, "-c", "import numpy"], folder),
            }
            for key, value in measured.items():
                times[key].append(value)
        simulated = json.loads((folder / "run0" / "manifest.json").read_text())["simulated_s"]
    medians = {key: statistics.median(values[1:]) for key, values in times.items()}
    print(f"median of {repetitions}:")
    print(
        f"  cosim run paper_leaders --no-report  {medians['run']:6.2f} s = {simulated / medians['run']:.0f} x real time"
    )
    print(f"  cosim report                         {medians['report']:6.2f} s")
    print(f"  cosim --help                         {medians['help']:6.2f} s")
    print(f"  python -c 'import numpy'             {medians['numpy']:6.2f} s")


if __name__ == "__main__":
    main()
