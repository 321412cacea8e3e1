"""What will run: indices instead of names, numbers instead of distributions, every choice made.

A plan is immutable, and is all that an agent, the emulator and the master need: a worker process can be handed one and
nothing else. It is built from a validated spec by `cosim.planning`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal, TypeAlias

from cosim.components.component import Description, Value, Variable
from network.channel import ChannelModel
from network.messages import Links, MessageLayout
from network.payload import Encoding
from network.units import to_seconds

EXTERNAL = "external.parquet"
"""File of a run folder: what was taken from outside, which the resolved scenario beside it replays."""


BRIDGE_LISTEN = "tcp/127.0.0.1:7447"
"""Where others find a bridge that says nothing else: Zenoh's own port, on this host alone."""


class Method(StrEnum):
    """How the components of an agent are coupled between two events."""

    JOINT = "joint"
    MIDPOINT = "midpoint"
    GAUSS_SEIDEL = "gauss-seidel"
    JACOBI = "jacobi"


class Integrator(StrEnum):
    """The one-step method of the `joint` coupling."""

    EULER = "euler"
    RK4 = "rk4"
    DORMAND_PRINCE = "dormand-prince"  # the adaptive embedded pair 5(4)


class Loop(StrEnum):
    """Who runs the micro steps. Both give the same bits."""

    NATIVE = "native"
    PYTHON = "python"


@dataclass(frozen=True)
class ControlPlan:
    """Steps of a Co-Simulation coupling that keep to a tolerance; see `cosim.agents.step_control`.

    Attributes:
        relative_tolerance: for the error of a step in an output, in parts of its size.
        absolute_tolerance: what is allowed beside that, in the output's unit.
        least_ns: no step is shorter, unless the next event comes sooner.
        period_ns: T.
        rollback: whether all components can save their state, so that a step can be made again.
    """

    relative_tolerance: float
    absolute_tolerance: float
    least_ns: int
    period_ns: int
    rollback: bool


@dataclass(frozen=True)
class CouplingPlan:
    """Micro step in nanoseconds (the largest one, where steps adapt) and tolerances.

    Attributes:
        grid: every micro step has this length, because a component accepts no other: an arrival waits for the end of
            the one it falls into.
        retries: how often a step that a component discards is tried again in halves.
        parts: per component, how many steps of its own it makes in a micro step; empty where each makes one.
        control: what the steps of a Co-Simulation coupling keep to; None where they are fixed.
        refinement: how many micro steps are made in the place of each, to see what that changes; not on a grid.
    """

    method: Method
    step_ns: int
    integrator: Integrator = Integrator.RK4
    relative_tolerance: float = 1e-8
    absolute_tolerance: float = 1e-10
    loop: Loop = Loop.NATIVE
    grid: bool = False
    retries: int = 0
    parts: tuple[int, ...] = ()
    control: ControlPlan | None = None
    refinement: int = 1

    @property
    def order(self) -> int | None:
        """Of convergence; None for an integrator that adapts its step."""
        if self.method is Method.JOINT:
            return {Integrator.EULER: 1, Integrator.RK4: 4}.get(self.integrator)
        return 2 if self.method is Method.MIDPOINT else 1

    def parts_of(self, component: int, *, halved: bool = False) -> int:
        """How many steps a component makes in a micro step, or in half of one."""
        parts = self.parts[component] if self.parts else 1
        return (parts + 1) // 2 if halved else parts


@dataclass(frozen=True)
class Isolation:
    """A component in a process of its own: how long a call may take there, in nanoseconds of wall time."""

    deadline_ns: int


@dataclass(frozen=True)
class ComponentPlan:
    """One component: an FMU (`path`) or a Python class (`python`, a dotted path).

    Attributes:
        start: start values and parameters by variable name, flat, numbers drawn; structural parameters among them.
        isolation: None where it lives in the agent's own process.
        cvode: tolerance with which CVODE steps it through Model Exchange; None where it is used as it is.
    """

    name: str
    path: Path | None
    python: str | None
    description: Description
    start: Mapping[str, tuple[Value, ...]]
    isolation: Isolation | None = None
    cvode: float | None = None


@dataclass(frozen=True)
class Port:
    """A variable of a component of an agent."""

    component: int
    variable: Variable


@dataclass(frozen=True)
class Connection:
    """An output that feeds an input of the same size."""

    source: Port
    target: Port


@dataclass(frozen=True)
class MailboxPlan:
    """Which inputs the mailbox feeds; None where the agent does not ask for it.

    For n in-neighbours and a message variable of size m, the input of that variable has n*m numbers, one row per
    in-neighbour; `stamp`, `time` and `weight` have n.
    """

    values: Mapping[str, Port]
    stamp: Port | None
    time: Port | None
    weight: Port | None


@dataclass(frozen=True)
class External:
    """An input that takes its value from outside of the run, through the bridge.

    Attributes:
        subscription: index in `BridgePlan.subscribe`.
        start: (size,) its value until the first one has come.
    """

    subscription: int
    port: Port
    start: tuple[float, ...]


@dataclass(frozen=True)
class AgentPlan:
    """One agent.

    Attributes:
        neighbours: indices of the in-neighbours, in the order of the mailbox rows.
        weights: a_ij of each in-neighbour.
        publish: where each variable of the message layout is read; empty where nobody hears the agent.
        record: what is written to the trajectories, as (`component.variable`, port).
    """

    index: int
    name: str
    components: tuple[ComponentPlan, ...]
    connections: tuple[Connection, ...]
    publish: tuple[Port, ...]
    mailbox: MailboxPlan
    neighbours: tuple[int, ...]
    weights: tuple[float, ...]
    coupling: CouplingPlan
    record: tuple[tuple[str, Port], ...]
    external: tuple[External, ...] = ()


@dataclass(frozen=True)
class Publication:
    """What the bridge publishes on one key at every tick.

    Attributes:
        variable: `component.variable`, for people.
        part: where its numbers are in the recorded row of the agent.
    """

    key: str
    encoding: Encoding
    agent: int
    variable: str
    part: slice


@dataclass(frozen=True)
class Subscription:
    """A key whose newest value is taken at every tick.

    Attributes:
        size: how many numbers it must have.
        low, high: what its inputs can hold.
        whole: whether they hold whole numbers only.
    """

    key: str
    encoding: Encoding
    size: int
    low: float
    high: float
    whole: bool


@dataclass(frozen=True)
class BridgePlan:
    """What a run says to others, and takes from them, over plain Zenoh; see docs/bridge.md.

    Attributes:
        listen, connect: Zenoh endpoints.
        replay: a recording that stands in for the outside; nothing is opened then.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    publish: tuple[Publication, ...] = ()
    subscribe: tuple[Subscription, ...] = ()
    replay: Path | None = None

    def __bool__(self) -> bool:
        return bool(self.publish or self.subscribe)

    @property
    def where(self) -> str:
        """For people: `listens at tcp/127.0.0.1:7447`."""
        if self.replay is not None:
            return f"replays {self.replay}"
        ways = (("listens at", self.listen), ("is connected to", self.connect))
        return " and ".join(f"{verb} {', '.join(endpoints)}" for verb, endpoints in ways if endpoints)


@dataclass(frozen=True)
class AnalysisPlan:
    """What the report and the checks call position, velocity and so on; `component.variable`, None where not given."""

    position: str | None = None
    velocity: str | None = None
    estimate: str | None = None
    parameters: str | None = None
    reference_velocity: tuple[float, ...] | None = None
    leaders: tuple[str, ...] = ()
    k_eta: Mapping[str, float] | None = None  # by agent; both None unless the agents run the paper's scheme
    lambda_: Mapping[str, float] | None = None


Workers: TypeAlias = int | Literal["per-agent"] | Mapping[str, tuple[int, ...]] | None
"""How a run across processes divides the agents: among how many workers, or which indices each of them carries."""


@dataclass(frozen=True)
class Plan:
    """A whole run.

    Attributes:
        ticks: number of periods to advance; trajectories have ticks + 1 rows per agent.
        channels: profiles by name; `link_channel[i]` names that of `links` row i.
        scenario: the resolved scenario as YAML text; running it gives the same digest.
        workers: as the scenario wants the agents divided in a run across processes; no result depends on it.
        on_worker_loss: across processes, `abort` or `restart`; no result depends on it.
    """

    name: str
    title: str
    seed: int
    period_ns: int
    ticks: int
    layout: MessageLayout
    links: Links
    weights: tuple[float, ...]
    channels: Mapping[str, ChannelModel]
    link_channel: tuple[str, ...]
    agents: tuple[AgentPlan, ...]
    analysis: AnalysisPlan
    scenario: str
    workers: Workers = None
    bridge: BridgePlan = BridgePlan()
    on_worker_loss: str = "abort"

    @property
    def period(self) -> float:
        """T in seconds."""
        return to_seconds(self.period_ns)
