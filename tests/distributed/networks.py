"""Small networks as scenarios, in-process runs of them to compare with, and their record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import strategies as st

from cosim.plan import Plan
from cosim.planning import plan
from cosim.running import inline
from cosim.scenario.reading import read_scenario
from network.messages import Fates, Floats
from tests.network.networks import COLUMNS

CHANNELS = {
    "ideal": "{model: ideal}",
    "late": "{model: netem, delay: 250 ms}",
    "lossy": "{model: netem, delay: [10 ms, 320 ms], loss: 20 %}",
    "slack": "{model: netem, delay: [100 ms, 200 ms], loss: 5 %}",
    "window": "{model: window, depth: 4, delay: [150 ms, 250 ms]}",
}
Edges = Sequence[tuple[int, int]]
Fault = tuple[str, float] | tuple[str, float, Mapping[str, int]]


def scenario(
    n_agents: int,
    edges: Edges,
    channel: str = "lossy",
    seed: int = 1,
    ticks: int = 12,
    faults: Mapping[int, Fault] | None = None,
    on_worker_loss: str = "abort",
) -> str:
    """Nodes from 1 to `n_agents`; `faults` gives some of them another class, when its fault happens, and parameters."""
    faults = faults or {}
    lines = [
        "name: little",
        f"on_worker_loss: {on_worker_loss}",
        f"seed: {seed}",
        "period: 100 ms",
        f"duration: {ticks * 100} ms",
        "templates:",
        "  node:",
        "    components: {node: {python: tests.distributed.nodes:Node, start: {x: {uniform: [-1, 1]}}}}",
        "    publish: {y: node.y}",
        "    receive: {y: node.heard, stamp: node.stamp, count: node.count}",
        "    record: [node.x]",
        "agents:",
        *(f"  {i}: {{template: node{_fault(faults.get(i))}}}" for i in range(1, n_agents + 1)),
        "coupling: {method: joint, step: 20 ms}",
    ]
    if edges:
        lines += [
            "graph:",
            "  channel: used",
            "  edges:",
            *(f"    - {sender} -> {receiver}" for sender, receiver in edges),
            f"channels: {{used: {CHANNELS[channel]}}}",
        ]
    return "\n".join(lines) + "\n"


def _fault(fault: Fault | None) -> str:
    if fault is None:
        return ""
    more = "".join(f", {name}: {value}" for name, value in fault[2].items()) if len(fault) > 2 else ""
    return f", components: {{node: {{python: 'tests.distributed.nodes:{fault[0]}', start: {{at: {fault[1]}{more}}}}}}}"


def ring(n_agents: int) -> Edges:
    return [(i % n_agents + 1, (i + 1) % n_agents + 1) for i in range(n_agents)] if n_agents > 1 else []


@st.composite
def scenarios(draw: st.DrawFn, on_worker_loss: str = "abort") -> str:
    n_agents = draw(st.integers(1, 5))
    pairs = [(i, j) for i in range(1, n_agents + 1) for j in range(1, n_agents + 1) if i != j]
    edges = draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else []
    channel, seed = draw(st.sampled_from(sorted(CHANNELS))), draw(st.integers(0, 2**31))
    return scenario(n_agents, edges, channel, seed, draw(st.integers(1, 12)), on_worker_loss=on_worker_loss)


def planned(text: str) -> Plan:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "net.yaml"
        path.write_text(text)
        return plan(read_scenario(path)).plan


@dataclass
class Record:
    """An observer that keeps all it is told, in order."""

    ticks: list[tuple[int, bytes]] = field(default_factory=list)
    fates_of: list[dict[str, list[int]]] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)

    def tick(self, tick: int, row: Floats) -> None:
        self.calls.append("tick")
        self.ticks.append((tick, row.tobytes()))

    def fates(self, fates: Fates) -> None:
        self.calls.append("fates")
        self.fates_of.append({name: getattr(fates, name).tolist() for name in COLUMNS})


def in_process(plan: Plan) -> tuple[Record, Exception | None]:
    """What the in-process run shows, and how it fails."""
    record = Record()
    try:
        inline.run(plan, [record])
    except Exception as error:
        return record, error
    return record, None
