"""Scenarios with a bridge, runs of them, and an outside to talk to."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cosim.bridge import Bridge, Taken, open_bridge, recorded
from cosim.distributed import cluster
from cosim.plan import Plan
from cosim.planning import load
from cosim.recording.recorder import Recorder
from cosim.running import inline

OUTSIDE = Path(__file__).with_name("outside.py")
DEADLINE = 30.0
TICKS = 8


def scenario(endpoint: str, *, plant: str = "{fmu: TwoLinkArm}", coupling: str = "{method: joint, step: 5 ms}") -> str:
    """Three arms that do not hear each other; the outside sets the torques of the first two."""
    return f"""\
name: lab
seed: 3
period: 100 ms
duration: {TICKS * 100} ms
coupling: {coupling}
agents:
  1..3:
    components: {{plant: {plant}}}
    record: [plant.p, plant.v]
bridge:
  listen: ["{endpoint}"]
  publish:
    - {{key: "lab/{{agent}}/p", variable: plant.p}}
    - {{key: lab/raw, agents: 3, variable: plant.v, encoding: float64}}
  subscribe:
    - {{key: "lab/{{agent}}/u", agents: 1..2, variable: plant.u, start: [0.1, 0.2]}}
    - {{key: lab/never, agents: 3, variable: plant.u}}
"""


def planned(folder: Path, text: str) -> Plan:
    path = folder / "lab.yaml"
    path.write_text(text)
    return load(str(path)).plan


@contextmanager
def outside(endpoint: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The other program, connected and ready."""
    command = [sys.executable, str(OUTSIDE), endpoint, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def play(
    plan: Plan,
    folder: Path,
    bridge: Bridge | None,
    *,
    workers: int | None = None,
    take: Callable[[int], Taken] | None = None,
) -> str:
    """The digest of a run; `take` in place of the bridge's."""
    recorder = Recorder(plan, folder)
    recorder.open()
    observers: Sequence[Any] = [recorder, *([] if bridge is None else [bridge])]
    taking = None
    if bridge is not None:

        class Taking:
            def take(self, tick: int) -> Taken:
                return (take or bridge.take)(tick)

        taking = recorded(Taking(), recorder.external)  # type: ignore[arg-type]
    if workers is None:
        inline.run(plan, observers, take=taking)
    else:
        cluster.run(plan, workers, observers, take=taking)
    return recorder.close("complete")


def replayed(folder: Path, out: Path, *settings: str, workers: int | None = None) -> str:
    """The digest of running again what a run folder says, without any outside."""
    plan = load(str(folder / "scenario.yaml"), settings).plan
    with open_bridge(plan, refuse_nothing) as bridge:
        return play(plan, out, bridge, workers=workers)


def refuse_nothing(text: str) -> None:
    raise AssertionError(text)


def until(condition: Callable[[], bool]) -> None:
    """Wait for something."""
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.001)
