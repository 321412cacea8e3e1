"""How soon faults of a distributed run are noticed, and how long a lost worker takes to be replaced.

    python -m benchmarks.faults [--trials 20] [--ticks 200 2000 20000]

Four agents in two workers, real processes over Zenoh on this host, `on_worker_loss: restart`. A component brings its
own worker down at a given tick, the first time only, and notes the moment. `noticed` is when the user is told; `caught
up` when the replacement has come to where the others wait. The agents compute next to nothing, so that catching up
shows what starting and the exchange cost; agents that take long take as long again as they took until then. The loss
of the emulator ends the run: `noticed` is then when all processes are gone.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.components.python import Input, Output, Parameter, PythonComponent, Structural

PERIOD_MS = 10
DEADLINE = 1.0
"""Of a step, where a component hangs."""

MARK = "COSIM_FAULT_MARK"
FAULTS = {
    "worker killed": "killed",
    "worker stopped (lease 2 s)": "stopped",
    f"worker hangs (deadline {DEADLINE:g} s)": "hangs",
    "message lost": "loses",
    "emulator killed": "orphans",
}


class Node(PythonComponent):
    """Sends a number, and brings its process down when it is told to, once."""

    count = Structural(0)
    heard = Input(shape=("count", 1))
    at = Parameter(np.inf, unit="s", description="when the fault happens")
    fault = Parameter(0, dtype="Int64", description="index in FAULTS")
    y = Output(shape=(1,), depends_on=())

    def outputs(self, time: float) -> None:
        self.y = np.sin(time)
        if time >= self.at:
            self._fault(list(FAULTS.values())[int(self.fault)])

    def _fault(self, name: str) -> None:
        try:
            with Path(os.environ[MARK]).open("x") as file:
                file.write(repr(time.monotonic()))
        except FileExistsError:
            return
        match name:
            case "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            case "stopped":
                os.kill(os.getpid(), signal.SIGSTOP)
            case "hangs":
                while True:
                    signal.pause()
            case "loses":
                _lose_samples()
            case "orphans":
                os.kill(_process("emulator", os.getppid()), signal.SIGKILL)


def _lose_samples() -> None:
    """Let the next samples of this process, and all that follow, get lost after they were numbered."""
    from network import zenoh
    from network.transport import Kind

    send = zenoh.ZenohEndpoint.send

    def losing(self: Any, receiver: str, kind: Kind, tick: int, *parts: Any) -> None:
        if kind is not Kind.SAMPLES:
            send(self, receiver, kind, tick, *parts)

    zenoh.ZenohEndpoint.send = losing  # type: ignore[method-assign, assignment]


def _process(name: str, parent: int) -> int:
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = (path / "cmdline").read_bytes().split(b"\0")
            above = int((path / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if above == parent and b"_process" in words and name.encode() in words:
            return int(path.name)
    raise LookupError(name)


def scenario(fault: int, ticks: int) -> str:
    """The fault happens after so many ticks; the run goes on for a while."""
    component = "components: {node: {python: benchmarks.faults:Node"
    return "\n".join(
        [
            "name: faults",
            f"period: {PERIOD_MS} ms",
            f"duration: {(ticks + 200) * PERIOD_MS} ms",
            "on_worker_loss: restart",
            "templates:",
            f"  node: {{{component}}}}}, publish: {{y: node.y}}, receive: {{y: node.heard, count: node.count}}}}",
            "agents:",
            "  1..4: {template: node}",
            f"  3: {{{component}, start: {{at: {ticks * PERIOD_MS / 1000}, fault: {fault}}}}}}}}}",
            "graph: {channel: used, edges: [1 -> 3, 3 -> 1, 2 -> 4, 4 -> 2]}",
            "channels: {used: {model: delay, delay: 15 ms}}",
        ]
    )


def trial(fault: int, ticks: int) -> tuple[float, float | None]:
    """Seconds from the fault until it is noticed, and until the replacement has caught up."""
    from cosim.distributed import cluster
    from cosim.errors import ClusterError
    from cosim.planning import plan
    from cosim.scenario.reading import read_scenario

    told: list[float] = []

    def tell(text: str, restart: Mapping[str, Any] | None) -> None:
        if restart is not None or "has caught up" in text:
            told.append(time.monotonic())

    with tempfile.TemporaryDirectory() as folder:
        path, mark = Path(folder) / "faults.yaml", Path(folder) / "mark"
        path.write_text(scenario(fault, ticks), encoding="utf-8")
        os.environ[MARK] = str(mark)
        try:
            cluster.run(plan(read_scenario(path)).plan, 2, [], tell=tell, step_deadline=DEADLINE)
        except ClusterError:
            told.append(time.monotonic())
        moment = float(mark.read_text())
    return told[0] - moment, told[1] - moment if len(told) > 1 else None


def main() -> None:
    """Measure in turns, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--ticks", type=int, nargs="+", default=[200, 2000, 20000])
    args = parser.parse_args()
    cases = [(index, args.ticks[0]) for index in range(len(FAULTS))] + [(0, ticks) for ticks in args.ticks[1:]]
    found: dict[tuple[int, int], list[tuple[float, float | None]]] = {case: [] for case in cases}
    try:
        for number in range(args.trials):
            for case in cases:
                found[case].append(trial(*case))
            print(f"{number + 1} of {args.trials}", file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted: fewer trials", file=sys.stderr)
    print("| fault | after ticks | trials | noticed: median, largest | caught up: median, largest |")
    print("|---|---:|---:|---:|---:|")
    for (index, ticks), times in found.items():
        noticed = _cell([first for first, _ in times])
        caught_up = _cell([second for _, second in times if second is not None])
        print(f"| {list(FAULTS)[index]} | {ticks} | {len(times)} | {noticed} | {caught_up} |")


def _cell(seconds: list[float]) -> str:
    return f"{statistics.median(seconds):.3g} s, {max(seconds):.3g} s" if seconds else ""


if __name__ == "__main__":
    main()
