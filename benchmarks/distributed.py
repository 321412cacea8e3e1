"""Steps per second of distributed runs, beside a bare barrier and beside other co-simulation frameworks.

    python -m venv /tmp/peers && /tmp/peers/bin/pip install helics mosaik numpy
    python -m benchmarks.distributed --peers /tmp/peers/bin/python [--repetitions 5] [--shapes 2/2 100/2] [--json]

Every contestant does the same exchange (`benchmarks.peers.exchange`): in every step each agent sends 64 bytes to two
others through a delaying component in a process of its own. Beside netcosim (`cosim run --distributed`) there are a
barrier over Unix sockets, which is the least that such an exchange costs, HELICS (message federates through its broker)
and mosaik (simulators as processes), each with several settings, of which the table shows the fastest. The peers check
what they exchange, but compute, record and number nothing, and all agents of a process are rows of one array whose
messages are packed into one, which their users would have to do themselves. Each of netcosim's agents is an FMU of next
to no computation (`benchmarks/averager`), or, in another column, a Python component that does nothing else than send;
`one process` is the same scenario without `--distributed`. The delaying component holds what it gets for three steps,
as all contestants know: netcosim lets so many steps travel together.

Start and warm-up are left out; of netcosim only the start, and the closing of the run folder counts, after ten times as
many steps. Contestants take turns, and ratios are medians of ratios within a turn. A contestant that fails or exceeds
the deadline is stopped with all its processes and left out for that shape, with a sentence. Run it from the
repository's root, on Linux.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

from benchmarks.peers.exchange import AGE, Shape
from benchmarks.scaling import PERIOD_MS, build_averager, scenario

ROOT = Path(__file__).resolve().parent.parent
STEPS = {(2, 2): 2000, (10, 10): 800, (30, 30): 200, (100, 2): 1000, (1000, 2): 300}
"""Shapes, as agents and workers, and for how many steps they are measured: some seconds for most contestants."""
OTHER_STEPS = 500
PEERS = {"HELICS": "helics", "mosaik": "mosaik"}
"""What a peer is called, and what is imported."""
INSTALL = (
    "For both peers: python -m venv /tmp/peers && /tmp/peers/bin/pip install helics mosaik numpy, "
    "then --peers /tmp/peers/bin/python"
)
PROGRAMS = {
    "barrier": ("raw", ("unix",)),
    "HELICS": ("helics_federation", ("ipc-targeted", "ipc-free", "zmq-free")),
    "mosaik": ("mosaik_world", ("parallel", "sequential")),
}
"""Contestants, their program in `benchmarks.peers`, and the settings that are tried."""
CHOICES = [*(name.lower() for name in PROGRAMS), "netcosim"]
NETCOSIM = {
    "one process": ("averager", ()),
    "distributed": ("averager", ("--distributed", "--workers")),
    "Python agents, distributed": ("talker", ("--distributed", "--workers")),
}
"""Settings of netcosim: the agents' kind, and what makes it so."""
LONGER = 10
"""So many times as many steps for netcosim, which closes a run folder at the end: about half a second."""
PATIENCE = 5.0
"""Seconds from being asked to stop to being stopped."""


class FailedError(Exception):
    """A contestant that gave no result, and why."""


@dataclass(frozen=True)
class Contestant:
    """One program with one setting."""

    name: str
    setting: str
    python: str

    @property
    def label(self) -> str:
        return f"{self.name} {self.setting}"

    def steps_per_second(self, shape: Shape, deadline: float) -> float:
        """Measure once.

        Raises:
            FailedError: there is no result.
        """
        if self.name == "netcosim":
            return netcosim(shape, self.setting, deadline)
        sizes = f"--agents={shape.agents} --workers={shape.workers} --steps={shape.steps} --warm-up={shape.warm_up}"
        program = f"benchmarks.peers.{PROGRAMS[self.name][0]}"
        output = run([self.python, "-m", program, *sizes.split(), f"--setting={self.setting}"], deadline)
        return float(json.loads(output.splitlines()[-1])["steps_per_s"])


@dataclass
class Row:
    """What was measured for one shape: steps per second by contestant, turn by turn."""

    shape: Shape
    speeds: dict[Contestant, list[float]] = field(default_factory=dict)

    def best(self, name: str, setting: str | None = None) -> Contestant | None:
        """The fastest setting of a contestant, by the median."""
        candidates = [c for c in self.speeds if c.name == name and setting in (None, c.setting)]
        return max(candidates, key=self.median, default=None)

    def median(self, contestant: Contestant) -> float:
        return statistics.median(self.speeds[contestant])

    def ratio(self, above: Contestant | None, below: Contestant | None) -> float | None:
        """Median of the ratios within a turn."""
        if above is None or below is None:
            return None
        return statistics.median(a / b for a, b in zip(self.speeds[above], self.speeds[below], strict=True))


def run(command: Sequence[str], deadline: float) -> str:
    """What a command prints; it leads a process group, of which nothing is left afterwards.

    Raises:
        FailedError: it took longer than `deadline` seconds, failed or printed nothing.
    """
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(command, stdout=out, stderr=err, cwd=ROOT, start_new_session=True)
        ended = False
        try:
            ended = has_ended(process.pid, deadline)
        finally:
            if not ended:
                process.terminate()
                has_ended(process.pid, PATIENCE)
            os.killpg(process.pid, signal.SIGKILL)  # the leader is not yet waited for, so the number is still its own
            process.wait()
        for file in (out, err):
            file.seek(0)
        printed, said = out.read(), err.read().split("\n")
    if not ended:
        raise FailedError(f"no result within {deadline:g} s")
    if process.returncode or not printed.strip():
        raise FailedError(
            next((line for line in reversed(said) if line.strip()), f"exit code {process.returncode}").strip()
        )
    return printed


def has_ended(pid: int, seconds: float) -> bool:
    """Whether a child ends within some seconds; it is not waited for, so that its number stays its own."""
    until = time.monotonic() + seconds
    while os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def netcosim(shape: Shape, setting: str, deadline: float) -> float:
    """Steps per second of `cosim run`, from tick 0 to the closing of the run folder.

    Raises:
        FailedError: the run failed.
    """
    with tempfile.TemporaryDirectory(prefix="netcosim-benchmark-") as name:
        folder = Path(name)
        config = folder / "talkers.yaml"
        kind, flags = NETCOSIM[setting]
        fmu = build_averager(folder)
        steps = LONGER * shape.total
        config.write_text(scenario(kind, shape.agents, steps, fmu, AGE * PERIOD_MS))
        if flags:
            flags = (*flags, f"{shape.workers}")
        out = folder / "out"
        run([sys.executable, "-m", "cosim", "run", str(config), "--out", str(out), "--no-report", *flags], deadline)
        manifest = json.loads((out / "manifest.json").read_text())
    if manifest["status"] != "complete" or manifest["ticks"]["done"] != steps:
        raise FailedError(f"the run folder says {manifest['status']!r} after {manifest['ticks']['done']} ticks")
    return cast(float, steps / (manifest["wall_s"] - manifest["start_s"]))


def contestants(peers: str, chosen: Sequence[str]) -> Iterable[Contestant]:
    """Who takes part; whoever is not installed is left out, with a sentence."""
    for name, (_, settings) in PROGRAMS.items():
        if name.lower() not in chosen:
            continue
        python = peers if name in PEERS else sys.executable
        if name in PEERS and not importable(python, PEERS[name]):
            say(f"{name} is left out: {python} cannot import {PEERS[name]}. {INSTALL}")
            continue
        yield from (Contestant(name, setting, python) for setting in settings)
    if "netcosim" in chosen:
        yield from (Contestant("netcosim", setting, sys.executable) for setting in NETCOSIM)


def importable(python: str, module: str) -> bool:
    """Whether an interpreter has a module."""
    try:
        return (
            subprocess.run([python, "-c", f"import {module}, numpy"], capture_output=True, check=False).returncode == 0
        )
    except OSError:
        return False


def measure(shape: Shape, taking_part: Sequence[Contestant], repetitions: int, deadline: float) -> Row:
    """Let all take turns; whoever fails is left out for this shape."""
    speeds: dict[Contestant, list[float]] = {contestant: [] for contestant in taking_part}
    for _ in range(repetitions):
        for contestant in list(speeds):
            try:
                speeds[contestant].append(contestant.steps_per_second(shape, deadline))
            except FailedError as failure:
                say(f"{contestant.label} is left out for {title(shape)}: {failure}")
                del speeds[contestant]
    return Row(shape, speeds)


def say(sentence: str) -> None:
    """Beside the table, not in it."""
    print(sentence, file=sys.stderr, flush=True)


def title(shape: Shape) -> str:
    """As the table names it."""
    return f"{shape.agents:,} agents in {shape.workers}"


def ratios(row: Row) -> dict[str, float | None]:
    """Of netcosim to the better peer, and of the barrier to both."""
    own = row.best("netcosim", "distributed")
    peers = [peer for peer in map(row.best, PEERS) if peer is not None]
    better = max(peers, key=row.median, default=None)
    return {
        "netcosim / better peer": row.ratio(own, better),
        "barrier / netcosim": row.ratio(row.best("barrier"), own),
        "barrier / better peer": row.ratio(row.best("barrier"), better),
    }


def table(rows: Sequence[Row], repetitions: int) -> None:
    """Steps per second and ratios, as Markdown."""
    columns = [("barrier", None), ("HELICS", None), ("mosaik", None), *(("netcosim", setting) for setting in NETCOSIM)]
    shown = [(name, setting) for name, setting in columns if any(row.best(name, setting) for row in rows)]
    keys = [key for key in ratios(rows[0]) if any(ratios(row)[key] is not None for row in rows)]
    print(f"steps per second, median of {repetitions}; the peers' fastest setting")
    header = ["processes", *(f"{name}, {setting}" if setting else name for name, setting in shown), *keys]
    print(f"| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for row in rows:
        best = [row.best(name, setting) for name, setting in shown]
        speeds = [cell(row, contestant) for contestant in best]
        values = [ratios(row)[key] for key in keys]
        print(f"| {' | '.join([title(row.shape), *speeds, *('' if v is None else f'{v:.2f}' for v in values)])} |")


def cell(row: Row, contestant: Contestant | None) -> str:
    """Steps per second, with the setting where there are several."""
    if contestant is None:
        return ""
    setting = f" ({contestant.setting})" if contestant.name in PEERS else ""
    return f"{row.median(contestant):,.0f}{setting}"


def as_json(row: Row) -> Mapping[str, object]:
    """Everything that was measured for a shape."""
    return {
        "agents": row.shape.agents,
        "workers": row.shape.workers,
        "steps": row.shape.steps,
        "steps_per_s": {contestant.label: values for contestant, values in row.speeds.items()},
        "median": {contestant.label: row.median(contestant) for contestant in row.speeds},
        **ratios(row),
    }


def shape_of(text: str) -> tuple[int, int]:
    """`100/2`: 100 agents in 2 workers."""
    agents, workers = map(int, text.split("/"))
    if not 1 <= workers <= min(agents, 100):
        raise ValueError(text)
    return agents, workers


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", default=sys.executable, metavar="PYTHON", help="interpreter that has the peers")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--shapes", type=shape_of, nargs="+", default=list(STEPS), metavar="AGENTS/WORKERS")
    parser.add_argument("--only", nargs="+", default=CHOICES, choices=CHOICES)
    parser.add_argument("--steps", type=int, help="instead of each shape's own number")
    parser.add_argument("--deadline", type=float, default=60.0, help="seconds for one measurement")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("asked to stop"))  # so that nobody's processes are left behind
    taking_part = list(contestants(given.peers, given.only))
    if not taking_part:
        sys.exit("nobody takes part")
    rows = []
    for agents, workers in given.shapes:
        steps = given.steps or STEPS.get((agents, workers), OTHER_STEPS)
        rows.append(
            measure(Shape(agents, workers, steps, max(1, steps // 10)), taking_part, given.repetitions, given.deadline)
        )
        say(f"{title(rows[-1].shape)}: " + ", ".join(f"{c.label} {rows[-1].median(c):,.0f}" for c in rows[-1].speeds))
    if given.json:
        print(json.dumps([as_json(row) for row in rows], indent=2))
    else:
        table(rows, given.repetitions)


if __name__ == "__main__":
    main()
