"""Who does what: which worker carries which agents, and the job that every process is handed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from cosim.errors import ClusterError
from cosim.plan import ComponentPlan, Plan
from cosim.scenario.names import in_short
from network.codec import Block, decode_object, encode_object
from network.transport import HUB, Envelope, Kind, Part, WireError

ORCHESTRATOR = HUB
EMULATOR = "emulator"

_WINDOW_BYTES = 32 << 20
_WINDOW_TICKS = 4096
_WINDOWS_PARTS = 4
_T = TypeVar("_T")

Share: TypeAlias = range | tuple[int, ...]
"""Which agents a worker carries, by index and in ascending order; a range where they follow each other."""


def share_of(indices: Iterable[int]) -> Share:
    """A worker's agents, given in any order."""
    ordered = tuple(sorted(indices))
    contiguous = range(ordered[0], ordered[-1] + 1) if ordered else range(0)
    return contiguous if len(contiguous) == len(ordered) else ordered


def pick(things: Sequence[_T], share: Share) -> Sequence[_T]:
    """Those of a worker's agents, of things that there is one of per agent."""
    return things[share.start : share.stop] if isinstance(share, range) else tuple(things[i] for i in share)


def rows_of(share: Share) -> slice | list[int]:
    """The index of a worker's agents in an array with one row per agent."""
    return slice(share.start, share.stop) if isinstance(share, range) else list(share)


@dataclass(frozen=True)
class Message:
    """What a state machine wants sent.

    Attributes:
        receiver: name of a process.
        tick: that it is about; of the first one for a batch.
        parts: the body, in pieces.
    """

    receiver: str
    kind: Kind
    tick: int
    parts: Sequence[Part] = ()


def divide(n_agents: int, n_workers: int) -> dict[str, Share]:
    """Contiguous blocks of agents in the order of the file, as even as can be, by worker.

    Args:
        n_agents: how many agents.
        n_workers: how many workers are wanted; no more than agents are used.
    """
    n_workers = min(n_workers, n_agents)
    ends = [n_agents * i // n_workers for i in range(n_workers + 1)]
    return {f"worker-{i + 1}": range(ends[i], ends[i + 1]) for i in range(n_workers)}


def renamed(things: Mapping[str, _T], old: str, new: str) -> dict[str, _T]:
    """The same things in the same order, one of them under another name."""
    return {new if name == old else name: thing for name, thing in things.items()}


def blocks(plan: Plan, workers: Mapping[str, Share]) -> dict[str, Block]:
    """What both ends of a stream know of each worker's agents."""
    return {
        name: Block(
            neighbours=tuple(len(agent.neighbours) for agent in pick(plan.agents, share)),
            widths=tuple(sum(port.variable.size for _, port in agent.record) for agent in pick(plan.agents, share)),
            width=plan.layout.width,
            period_ns=plan.period_ns,
        )
        for name, share in workers.items()
    }


def window_ticks(plan: Plan) -> int:
    """How many ticks the emulator may be ahead of what is recorded: bounds the memory of the rows under way.

    It is not where values come from outside: those of tick k are taken when tick k is recorded.
    """
    if plan.bridge.subscribe:
        return 0
    per_tick = 8 * sum(port.variable.size for agent in plan.agents for _, port in agent.record) + 48 * len(plan.links)
    return max(_WINDOWS_PARTS, min(_WINDOW_TICKS, _WINDOW_BYTES // max(1, per_tick)))


def batch_ticks(plan: Plan) -> int:
    """After how many ticks rows, fates and grants are sent on, if time does not ask for it earlier."""
    return max(1, window_ticks(plan) // _WINDOWS_PARTS)


@dataclass(frozen=True)
class Job:
    """What a process needs to begin; each plans for itself.

    Attributes:
        scenario: resolved, as YAML text.
        sha256: of every component's file, agent by agent.
        workers: the agents of every worker.
        paced: whether rows and fates are sent at every tick, because the run is paced against the wall.
    """

    scenario: str
    sha256: tuple[str, ...]
    workers: Mapping[str, Share]
    paced: bool = False

    @classmethod
    def of(cls, plan: Plan, workers: Mapping[str, Share], *, paced: bool = False) -> Job:
        """The job of carrying out a plan."""
        return cls(plan.scenario, _hashes(plan), workers, paced)

    def encode(self) -> list[Part]:
        """As the body of a message."""
        workers = {name: list(share) for name, share in self.workers.items()}
        return encode_object(
            {"scenario": self.scenario, "sha256": list(self.sha256), "workers": workers, "paced": self.paced}
        )

    @classmethod
    def decode(cls, envelope: Envelope) -> Job:
        """The job in a message.

        Raises:
            WireError: there is none.
        """
        tree: dict[str, Any] = decode_object(envelope.expect(Kind.SCENARIO))
        try:
            workers = {str(name): share_of(map(int, agents)) for name, agents in tree["workers"].items()}
            return cls(str(tree["scenario"]), tuple(map(str, tree["sha256"])), workers, tree["paced"] is True)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise WireError(envelope.sender, f"the message holds no job: {error!r}") from error

    def plan(self, located: Mapping[str, Path] | None = None) -> Plan:
        """Plan the scenario anew.

        Args:
            located: where FMUs are here, by what the scenario calls them.

        Raises:
            ConfigError: the scenario cannot be planned here.
            ClusterError: a component's file is not the one that the orchestrator planned with.
        """
        from cosim import planning
        from cosim.scenario.reading import read_scenario

        with tempfile.TemporaryDirectory(prefix="cosim-") as folder:
            path = Path(folder) / "scenario.yaml"
            path.write_text(self.scenario, encoding="utf-8")
            plan = planning.plan(read_scenario(path, path.name), located).plan
        if _hashes(plan) != self.sha256:
            raise ClusterError(f"other files than those that the orchestrator has: {_differences(plan, self.sha256)}")
        return plan


def _hashes(plan: Plan) -> tuple[str, ...]:
    return tuple(component.description.sha256 for agent in plan.agents for component in agent.components)


def _differences(plan: Plan, expected: Sequence[str]) -> str:
    """Every file that differs, and whose it is."""
    components = [(agent.name, component) for agent in plan.agents for component in agent.components]
    users: dict[str, list[str]] = {}
    for (agent, component), sha256 in zip(components, expected, strict=False):
        if component.description.sha256 != sha256:
            users.setdefault(_file(component), []).append(agent)
    return ", ".join(f"{file} (of agents {in_short(names)})" for file, names in users.items())


def _file(component: ComponentPlan) -> str:
    if component.path is not None:
        return str(component.path)
    from cosim.components.python import load

    return load(component.python or "").file
