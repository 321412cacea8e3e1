"""Time per step, memory and start-up against the number of agents, in one process.

    python -m benchmarks.scaling [--repetitions 3] [--sizes 10 100 1000 10000] [--kinds averager talker] [--json]

Agents sit in a circle; in every step each sends 64 bytes to the next two through a delaying channel. Kinds: `averager`,
an FMU of next to no computation (`benchmarks/averager`, compiled on the spot) with the native loop; `talker`, a
component in Python that does nothing else than send; `arm`, the shipped arm with its controller, joint, steps of 5 ms.
Nothing is recorded. Every measurement is a process of its own; processor time, as others may use the
machine. The slope is that of a straight line through the logarithms: 1 is proportional to the number of agents.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
PERIOD_MS = 100
DELAY_MS = 250
WARM_UP = 64
"""Ticks before the clock starts: the emulator routes as many at once."""
STEPS = {10: 4096, 100: 2048, 1000: 512, 10_000: 128}
OTHER_STEPS = 128
ARM_STEPS = 64
COLUMNS = {
    "plan_s": "planning, s",
    "open_s": "opening, s",
    "initialise_s": "initialising, s",
    "memory_mb": "memory of the process, MB",
    "step_us": "µs per step",
    "per_agent_us": "µs per agent and step",
}
RECEIVED = {
    "p": "controller.neighbour_p",
    "v_hat": "controller.neighbour_v_hat",
    "stamp": "controller.neighbour_stamp",
    "time": "controller.neighbour_time",
    "weight": "controller.weight",
    "count": "controller.n_neighbours",
    "period": "controller.T",
}
KINDS: dict[str, dict[str, Any]] = {
    "averager": {
        "components": {"mean": {"fmu": "@", "start": {"x": {"uniform": [-1, 1]}}}},
        "publish": {"x": "mean.x"},
        "receive": {"x": "mean.heard", "count": "mean.n_neighbours"},
        "record": [],
    },
    "talker": {
        "components": {"talker": {"python": "benchmarks.peers.talker:Talker"}},
        "publish": {"samples": "talker.samples"},
        "receive": {"samples": "talker.heard", "count": "talker.count"},
        "record": [],
    },
    "arm": {
        "components": {
            "plant": {"fmu": "TwoLinkArm", "start": {"p": {"uniform": [-1, 1]}}},
            "controller": {"fmu": "ArmSyncController"},
        },
        "connections": ["plant.p -> controller.p", "plant.v -> controller.v", "controller.u -> plant.u"],
        "publish": {"p": "plant.p", "v_hat": "controller.v_hat"},
        "receive": RECEIVED,
        "record": [],
    },
}


def build_averager(folder: Path) -> Path:
    """The FMU, for FMI 3.0."""
    from fmus.build import build_model

    return build_model(HERE / "averager", folder)[1]


def scenario(kind: str, n_agents: int, ticks: int, fmu: Path, delay_ms: int = DELAY_MS) -> str:
    """The network as YAML (which JSON is)."""
    joint = kind == "arm"
    heard = {(i, (i - d) % n_agents) for i in range(n_agents) for d in (1, 2)}
    tree = {
        "name": kind,
        "period": f"{PERIOD_MS} ms",
        "duration": f"{ticks * PERIOD_MS} ms",
        "templates": {"one": KINDS[kind]},
        "coupling": {"method": "joint", "step": "5 ms"} if joint else {"method": "jacobi", "step": f"{PERIOD_MS} ms"},
        "agents": {f"1..{n_agents}": {"template": "one"}},
        "graph": {
            "channel": "line",
            "edges": [f"{j + 1} -> {i + 1}" for i, j in sorted(heard) if i != j],
        },
        "channels": {"line": {"model": "netem", "delay": f"{delay_ms} ms"}},
    }
    return json.dumps(tree).replace('"@"', json.dumps(str(fmu)))


def resident_mb() -> float:
    """Memory of this process."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return float(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024


class Clock:
    """An observer that notes the processor time of every tick."""

    def __init__(self) -> None:
        self.ticks: list[float] = []

    def tick(self, tick: int, row: object) -> None:  # noqa: ARG002
        self.ticks.append(time.process_time())

    def fates(self, fates: object) -> None:
        """Not needed."""


def measure(n_agents: int, config: Path, small: Path) -> dict[str, float]:
    """What one process has to say."""
    from cosim.agents.group import Agents
    from cosim.planning import load
    from cosim.running import inline

    Agents(load(str(small)).plan).terminate()  # imports, and reads the FMUs
    times = [time.process_time()]
    plan = load(str(config)).plan
    times.append(time.process_time())
    agents = Agents(plan)
    times.append(time.process_time())
    agents.initialise()
    times.append(time.process_time())
    memory = resident_mb()
    agents.terminate()
    clock = Clock()
    inline.run(plan, [clock])
    steps = clock.ticks[WARM_UP:]
    step = (steps[-1] - steps[0]) / (len(steps) - 1)
    spent = dict(zip(("plan_s", "open_s", "initialise_s"), np.diff(times).tolist(), strict=True))
    return {
        "agents": n_agents,
        **spent,
        "memory_mb": memory,
        "step_us": step * 1e6,
        "per_agent_us": step * 1e6 / n_agents,
    }


def in_own_process(kind: str, n_agents: int, folder: Path, fmu: Path) -> dict[str, float]:
    """Measure once."""
    steps = ARM_STEPS if kind == "arm" else STEPS.get(n_agents, OTHER_STEPS)
    config, small = folder / "measured.yaml", folder / "small.yaml"
    config.write_text(scenario(kind, n_agents, WARM_UP + steps, fmu), encoding="utf-8")
    small.write_text(scenario(kind, 3, 1, fmu), encoding="utf-8")
    command = [sys.executable, "-m", "benchmarks.scaling", "--measure", str(n_agents), str(config), str(small)]
    result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=HERE.parent)
    measured: dict[str, float] = json.loads(result.stdout.splitlines()[-1])
    return measured


def slope(sizes: Sequence[int], values: Sequence[float]) -> float:
    """Of the straight line through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def main() -> None:
    """Print a table per kind, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(STEPS))
    parser.add_argument("--kinds", choices=list(KINDS), nargs="+", default=["averager", "talker"])
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        n_agents, config, small = arguments.measure
        print(json.dumps(measure(int(n_agents), Path(config), Path(small))))
        return
    found: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        fmu = build_averager(Path(name))
        for kind in arguments.kinds:
            rows = []
            for n_agents in arguments.sizes:
                turns = [in_own_process(kind, n_agents, Path(name), fmu) for _ in range(arguments.repetitions)]
                rows.append({key: statistics.median(turn[key] for turn in turns) for key in turns[0]})
            found[kind] = rows
    if arguments.json:
        print(json.dumps(found, indent=2))
        return
    for kind, rows in found.items():
        print(f"\n{kind}, median of {arguments.repetitions}\n\n| agents | {' | '.join(COLUMNS.values())} |")
        print(f"|---|{'---|' * len(COLUMNS)}")
        for row in rows:
            print(f"| {row['agents']:,.0f} | {' | '.join(f'{row[key]:.3g}' for key in COLUMNS)} |")
        if len(rows) > 1:
            sizes = [int(row["agents"]) for row in rows]
            slopes = (slope(sizes, [row[key] for row in rows]) for key in COLUMNS)
            print(f"| slope | {' | '.join(f'{value:.2f}' for value in slopes)} |")
            (few, less), (many, more) = ((row["agents"], row["memory_mb"]) for row in (rows[0], rows[-1]))
            print(f"\nmemory per agent: {(more - less) / (many - few) * 1024:.1f} kB")


if __name__ == "__main__":
    main()
