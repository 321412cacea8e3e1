"""How late the ticks of an idle paced run are, beside a bare loop that sleeps at the same rate.

    python -m benchmarks.realtime [--seconds 10] [--rates 100 1000] [--json]

The loop (`time.sleep` until the next release, with the timer slack of a paced run) is what machine and system allow.
The runs are `cosim run --realtime` of two Python components that do next to nothing and hear each other, in one
process and across processes (an emulator and two workers). One after the other, each in a process of its own. Run it
from the repository's root, on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
N_AGENTS = 2
WAYS = {"one process": (), "distributed": ("--distributed", "--workers", "2")}
LOOP = """
import json, sys, time
from cosim.running.lateness import Durations
from cosim.running.pacing import precise_timers
precise_timers()
rate, seconds = int(sys.argv[1]), float(sys.argv[2])
late, began, missed = Durations(), time.monotonic_ns(), 0
for tick in range(round(seconds * rate)):
    release = began + tick * 10**9 // rate
    while (left := release - time.monotonic_ns()) > 0:
        time.sleep(left / 1e9)
    behind = time.monotonic_ns() - release
    late.add(behind)
    missed += behind > 10**9 / rate
print(json.dumps({"lateness_s": late.summary(), "missed": missed, "ticks": late.count}))
"""
COMPONENT = '''
from cosim.components.python import Input, Output, PythonComponent, State, Structural


class Node(PythonComponent):
    """x' = -x; publishes x."""

    count = Structural(0)
    heard = Input(shape=("count", 1))
    x = State(1.0, shape=(1,))
    y = Output(shape=(1,), depends_on=())

    def outputs(self, time):
        self.y = self.x

    def derivatives(self, time):
        return {"x": -self.x}
'''


def scenario(rate: int, seconds: float) -> str:
    """Nodes in a ring."""
    edges = "\n".join(f"    - {i} -> {i % N_AGENTS + 1}" for i in range(1, N_AGENTS + 1))
    return f"""\
name: idle
period: {1e6 / rate:g} us
duration: {seconds:g} s
templates:
  node:
    components: {{node: {{python: idle:Node}}}}
    publish: {{y: node.y}}
    receive: {{y: node.heard, count: node.count}}
    record: [node.x]
agents: {{1..{N_AGENTS}: {{template: node}}}}
coupling: {{method: joint, step: {1e6 / rate:g} us}}
graph:
  channel: ideal
  edges:
{edges}
channels: {{ideal: {{model: ideal}}}}
"""


def bare(rate: int, seconds: float) -> dict[str, Any]:
    """The sleeping loop."""
    command = [sys.executable, "-c", LOOP, str(rate), str(seconds)]
    done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=True)
    account: dict[str, Any] = json.loads(done.stdout)
    return account


def paced(rate: int, seconds: float, how: tuple[str, ...]) -> dict[str, Any]:
    """A paced run's account of itself."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "idle.py").write_text(COMPONENT)
        (folder / "idle.yaml").write_text(scenario(rate, seconds))
        command = [sys.executable, "-m", "cosim", "run", "idle.yaml", "--out", "out", "--quiet", "--no-report"]
        environment = {"PYTHONPATH": f"{ROOT}:{folder}"}
        done = subprocess.run(
            [*command, "--realtime", *how], cwd=folder, env=environment, text=True, capture_output=True, check=False
        )
        if done.returncode:
            sys.exit(done.stderr)
        account: dict[str, Any] = json.loads((folder / "out" / "manifest.json").read_text())["realtime"]
    return account


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rates", type=int, nargs="+", default=[100, 1000], metavar="HZ")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    found: dict[str, dict[str, Any]] = {}
    for rate in args.rates:
        found[f"{rate} Hz, bare `time.sleep` loop"] = bare(rate, args.seconds)
        for name, how in WAYS.items():
            found[f"{rate} Hz, {name}"] = paced(rate, args.seconds, how)
    if args.json:
        print(json.dumps(found, indent=2))
        return
    print("| lateness, ms | p50 | p99 | max | missed |\n|---|---|---|---|---|")
    for name, account in found.items():
        numbers = " | ".join(f"{1e3 * account['lateness_s'][key]:.3g}" for key in ("p50", "p99", "max"))
        print(f"| {name} | {numbers} | {account['missed']} of {account['ticks']} |")


if __name__ == "__main__":
    main()
