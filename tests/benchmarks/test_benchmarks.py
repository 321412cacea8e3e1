"""Benchmarks run: they are looked at rarely, and lean on what is inside. What they measure is not asserted."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import fmus

ROOT = Path(__file__).parents[2]
NAMES = sorted(path.stem for path in (ROOT / "benchmarks").glob("*.py") if path.stem != "__init__")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="benchmarks are for Linux")


def benchmark(name: str, *arguments: str) -> str:
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_says_what_it_measures(name: str) -> None:
    assert "usage: " in benchmark(name, "--help")


def test_instances_of_an_fmu_are_counted() -> None:
    path = fmus.path("TwoLinkArm.fmi3")
    (row, *_) = json.loads(benchmark("instances", str(path), "--number", "3", "--repetitions", "1", "--json"))
    assert row["extractions"] == 1


def test_loops_that_are_compared_give_the_same_bits() -> None:
    """`benchmarks.coupling` refuses to measure others."""
    assert "Co-Simulation" in benchmark("coupling", "--repetitions", "1")
