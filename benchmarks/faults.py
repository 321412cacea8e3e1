"""How soon faults of a distributed run are noticed, and how long a lost worker takes to be replaced.

    python -m benchmarks.faults [--trials 20] [--ticks 200 2000 20000] [--faults killed hangs]

Four agents in two workers, real processes over Zenoh on this host, `on_worker_loss: restart`. A component brings its
own worker down at a given tick, the first time only, and notes the moment. `noticed` is when the user is told; `caught
up` when the replacement has come to where the others wait. The agents compute next to nothing, so that catching up
shows what starting and the exchange cost; agents that take long take as long again as they took until then. The loss
of the emulator, and messages that come to harm, end the run: `noticed` is then when all processes are gone. Where the
orchestrator is killed, `noticed` is when the last of the others has ended.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
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
    "worker stopped (after 2 s)": "stopped",
    f"worker hangs (deadline {DEADLINE:g} s)": "hangs",
    "a message lost, and all after it": "loses",
    "a message lost": "gap",
    "a message twice": "twice",
    "a message damaged": "damaged",
    "emulator killed": "kills emulator",
    "emulator stopped (after 2 s)": "stops emulator",
    "orchestrator killed": "kills orchestrator",
}
ORCHESTRATOR = "kills orchestrator"


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
            case "kills emulator":
                os.kill(_process("emulator", os.getppid()), signal.SIGKILL)
            case "stops emulator":
                os.kill(_process("emulator", os.getppid()), signal.SIGSTOP)
            case "kills orchestrator":
                os.kill(os.getppid(), signal.SIGKILL)
            case harm:
                _harm_samples(harm)


def _harm_samples(harm: str) -> None:
    """Let the next samples of this process come to harm on the wire, after they were numbered."""
    from network.zenoh import ZenohEndpoint

    (endpoint,) = [thing for thing in gc.get_objects() if isinstance(thing, ZenohEndpoint)]
    seen = 0

    def tamper(_sender: str, receiver: str, frame: bytes) -> Sequence[bytes]:
        nonlocal seen
        seen += receiver == "emulator"
        if receiver != "emulator" or (seen > 1 and harm != "loses"):
            return [frame]
        return {"twice": [frame, frame], "damaged": [frame[:-1] + bytes([frame[-1] ^ 1])]}.get(harm, [])

    endpoint._tamper = tamper


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
            "channels: {used: {model: netem, delay: 15 ms}}",
        ]
    )


def orphaned(fault: int, ticks: int) -> tuple[float, None]:
    """Seconds from the death of the orchestrator until the last of the others has ended."""
    with tempfile.TemporaryDirectory() as folder:
        path, mark = Path(folder) / "faults.yaml", Path(folder) / "mark"
        path.write_text(scenario(fault, ticks), encoding="utf-8")
        command = [sys.executable, "-m", "cosim", "run", str(path), "--distributed", "--workers", "2"]
        command += ["--no-report", "--quiet", "--out", str(Path(folder) / "out")]
        subprocess.run(command, env={**os.environ, MARK: str(mark)}, capture_output=True, timeout=120, check=False)
        return time.monotonic() - float(mark.read_text()), None  # its output ends with the last of those who share it


def trial(fault: int, ticks: int) -> tuple[float, float | None]:
    """Seconds from the fault until it is noticed, and until the replacement has caught up."""
    if list(FAULTS.values())[fault] == ORCHESTRATOR:
        return orphaned(fault, ticks)
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
    parser.add_argument("--faults", nargs="+", choices=FAULTS.values(), default=list(FAULTS.values()))
    args = parser.parse_args()
    cases = [(index, args.ticks[0]) for index, fault in enumerate(FAULTS.values()) if fault in args.faults]
    cases += [(0, ticks) for ticks in args.ticks[1:] if "killed" in args.faults]
    found: dict[tuple[int, int], list[tuple[float, float | None]]] = {case: [] for case in cases}
    try:
        for number in range(args.trials):
            for case in cases:
                try:
                    found[case].append(trial(*case))
                except FileNotFoundError:
                    print("the run ended before its fault", file=sys.stderr)
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
