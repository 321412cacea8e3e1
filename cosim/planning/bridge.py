"""What the bridge publishes and takes: every key a single one, every variable there, of the right kind, and free."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from cosim.components.component import Variable
from cosim.errors import Location, Problem
from cosim.plan import BRIDGE_LISTEN, BridgePlan, External, Plan, Port, Publication, Subscription
from cosim.planning.blueprint import Blueprint
from cosim.planning.graph import known_agents
from cosim.planning.ports import numbers
from cosim.planning.problems import Problems
from cosim.planning.starts import INTEGERS, draw, elements
from cosim.scenario.reading import Scenario
from cosim.scenario.source import Node
from cosim.scenario.spec import PublicationSpec, SubscriptionSpec
from network.payload import Encoding

_EXACT = 2.0**53
"""Whole numbers up to here are exact as a float64."""

_LARGEST_FLOAT32 = 3.4028234663852886e38


@dataclass(frozen=True)
class Bridged:
    """The plan of the bridge, and of every agent that it feeds, which of its inputs."""

    plan: BridgePlan
    external: Mapping[str, tuple[External, ...]]

    def feeds(self, agents: Iterable[str]) -> frozenset[tuple[int, str]]:
        """The inputs, by component and name, that the bridge feeds in each of these agents."""
        sets = [{(x.port.component, x.port.variable.name) for x in self.external.get(name, ())} for name in agents]
        return frozenset(set.intersection(*sets)) if sets else frozenset()


def plan_bridge(scenario: Scenario, blueprints: Mapping[str, Blueprint], problems: Problems) -> Bridged:
    """The bridge of a scenario.

    Args:
        scenario: as it was read.
        blueprints: of the agents whose components could be opened.
        problems: where mistakes go.
    """
    spec, root = scenario.spec.bridge, scenario.root
    _check_endpoints(scenario, problems)
    planner = _Planner(scenario, blueprints, problems)
    publish = [
        publication
        for index, entry in enumerate(spec.publish)
        for publication in planner.publications(entry, root.find("bridge", "publish", index) or root)
    ]
    for index, taken in enumerate(spec.subscribe):
        planner.subscribe(taken, root.find("bridge", "subscribe", index) or root)
    planner.sort()
    replay = None if spec.replay is None else scenario.folder(root.locate("bridge", "replay")) / spec.replay
    plan = BridgePlan(
        listen=tuple(spec.listen) or (() if spec.connect else (BRIDGE_LISTEN,)),
        connect=tuple(spec.connect),
        publish=tuple(publish),
        subscribe=tuple(planner.subscriptions),
        replay=None if replay is None else replay.absolute(),
    )
    if not spec.publish and not spec.subscribe and root.find("bridge"):
        problems.warning("the bridge publishes nothing and takes nothing", root.locate("bridge", key=True))
    return Bridged(plan, {name: tuple(inputs) for name, inputs in planner.external.items()})


def missing_replay(scenario: Scenario, plan: Plan) -> Problem | None:
    """That the recording to be replayed is not there. Whoever plans for a worker does not need it."""
    replay = plan.bridge.replay
    if replay is None or replay.is_file():
        return None
    return Problem(f"there is no file {replay}", scenario.root.locate("bridge", "replay"))


def _check_endpoints(scenario: Scenario, problems: Problems) -> None:
    """Whoever reaches an endpoint can set inputs: beyond this host that takes TLS, or the user's word."""
    from network.access import Endpoint

    spec = scenario.spec.bridge
    for section, endpoints in (("listen", spec.listen), ("connect", spec.connect)):
        for index, text in enumerate(endpoints):
            endpoint = Endpoint.of(text)
            if endpoint.protocol not in ("tls", "quic") and not endpoint.stays_here and not spec.insecure:
                problems.error(
                    f"{text} is reached from beyond this host, and whoever does can read and set what the bridge has; "
                    "use tls/, a tunnel to tcp/127.0.0.1:7447, or 'insecure: true' where nobody else is on the network",
                    scenario.root.locate("bridge", section, index),
                )


class _Planner:
    """Resolves one entry after the other, and remembers who has which key."""

    def __init__(self, scenario: Scenario, blueprints: Mapping[str, Blueprint], problems: Problems) -> None:
        self._scenario = scenario
        self._blueprints = blueprints
        self._problems = problems
        self._index_of = {name: index for index, name in enumerate(scenario.agents)}
        self._published: dict[str, Location] = {}
        self._subscribed: dict[str, tuple[int, Location]] = {}
        self._fed: dict[tuple[str, str], Location] = {}
        self.subscriptions: list[Subscription] = []
        self.external: dict[str, list[External]] = {}

    def _members(self, spec: PublicationSpec | SubscriptionSpec, node: Node) -> Iterator[tuple[str, Blueprint, str]]:
        """(name, blueprint, key) of the agents that an entry is about and of which enough is known."""
        if spec.agents is None:
            names = list(self._scenario.agents)
        else:
            names = known_agents(self._scenario, spec.agents, node.locate("agents"), self._problems)
        for name in dict.fromkeys(names):
            if name in self._blueprints:
                yield name, self._blueprints[name], spec.key.replace("{agent}", name)

    # --- publish ------------------------------------------------------------------------------------------------------
    def publications(self, spec: PublicationSpec, node: Node) -> Iterator[Publication]:
        """What one entry publishes."""
        where, seen = node.locate("variable"), set[int]()
        for name, blueprint, key in self._members(spec, node):
            if key in self._published:
                self._report_clash(key, node.locate("key"))
                return
            self._published[key] = node.locate("key")
            part = _recorded(blueprint, spec.variable)
            if part is not None:
                yield Publication(key, Encoding(spec.encoding), self._index_of[name], spec.variable, part)
            elif id(blueprint) not in seen:
                seen.add(id(blueprint))
                self._problems.next_view()
                if blueprint.ports.find(spec.variable, where) is not None:
                    text = f"{spec.variable!r} is not recorded, and only what is can be published; add it to 'record'"
                    self._problems.error(text, where)

    def _report_clash(self, key: str, where: Location) -> None:
        first = self._published[key]
        if first == where:
            text = f"several agents would publish at {key!r}; put '{{agent}}' into the key, such as '{key}/{{agent}}'"
        else:
            text = f"{key!r} is published twice, first {first.short}"
        self._problems.error(text, where)

    # --- subscribe ----------------------------------------------------------------------------------------------------
    def subscribe(self, spec: SubscriptionSpec, node: Node) -> None:
        """Add what one entry subscribes to, and which inputs it feeds."""
        where = node.locate("variable")
        inputs: dict[int, Port | None] = {}
        for name, blueprint, key in self._members(spec, node):
            if id(blueprint) not in inputs:
                self._problems.next_view()
                inputs[id(blueprint)] = self._free_input(blueprint, spec, node)
            first = self._fed.setdefault((name, spec.variable), node.where)
            if first != node.where:
                text = f"{spec.variable!r} of agent {name!r} is fed from outside twice, first {first.short}"
                self._problems.error(text, where)
                return
            if key in self._published:
                text = (
                    f"the run itself publishes at {key!r}, {self._published[key].short}; connect its agents by 'graph'"
                )
                self._problems.error(text, node.locate("key"))
                return
            port = inputs[id(blueprint)]
            index = None if port is None else self._subscription(spec, key, port.variable, node.locate("key"))
            if port is not None and index is not None:
                start = self._start(spec, name, blueprint, port)
                self.external.setdefault(name, []).append(External(index, port, start))

    def sort(self) -> None:
        """Order subscriptions by their keys: it must not matter how the entries group the agents."""
        order = sorted(range(len(self.subscriptions)), key=lambda index: self.subscriptions[index].key)
        position = {old: new for new, old in enumerate(order)}
        self.subscriptions = [self.subscriptions[index] for index in order]
        for name, inputs in self.external.items():
            self.external[name] = [
                replace(external, subscription=position[external.subscription]) for external in inputs
            ]

    def _free_input(self, blueprint: Blueprint, spec: SubscriptionSpec, node: Node) -> Port | None:
        """The input that an entry names, if nothing else feeds it and its type and start value will do."""
        reference, where = spec.variable, node.locate("variable")
        port = blueprint.ports.input(reference, where)
        if port is None:
            return None
        if (how := _feeds_already(blueprint, reference)) is not None:
            self._problems.error(f"{reference!r} {how}; an input has one source", where)
        elif port.variable.dtype == "Enumeration":
            text = f"{reference!r} is an Enumeration; from outside come numbers, and true and false, only"
            self._problems.error(text, where)
        elif not port.variable.size:
            self._problems.error(f"{reference!r} has no elements in this agent", where)
        else:
            return port if self._start_fits(spec, port.variable, node.locate("start")) else None
        return None

    def _start_fits(self, spec: SubscriptionSpec, variable: Variable, where: Location) -> bool:
        try:
            if spec.start is not None:
                elements(spec.start, variable)
        except ValueError as error:
            self._problems.error(str(error), where)
            return False
        return True

    def _subscription(self, spec: SubscriptionSpec, key: str, variable: Variable, where: Location) -> int | None:
        """The index of the subscription to a key, which may feed several inputs alike; else None, and a problem."""
        low, high, whole = _bounds(variable)
        encoding = Encoding(spec.encoding)
        if key not in self._subscribed:
            self._subscribed[key] = (len(self.subscriptions), where)
            self.subscriptions.append(Subscription(key, encoding, variable.size, low, high, whole))
            return len(self.subscriptions) - 1
        index, first = self._subscribed[key]
        other = self.subscriptions[index]
        if (other.size, other.encoding) != (variable.size, encoding):
            here, there = (f"{numbers(n)} as {e}" for n, e in ((variable.size, encoding), (other.size, other.encoding)))
            self._problems.error(f"{key!r} brings {here} here, but {there} {first.short}", where)
            return None
        self.subscriptions[index] = replace(
            other, low=max(low, other.low), high=min(high, other.high), whole=whole or other.whole
        )
        return index

    def _start(self, spec: SubscriptionSpec, agent: str, blueprint: Blueprint, port: Port) -> tuple[float, ...]:
        """The value until the first one has come: the entry's, else the component's own."""
        variable, part = port.variable, blueprint.parts[port.component]
        written = part.start.get(variable.name) if spec.start is None else elements(spec.start, variable)
        if written is None:
            values = variable.start or (0.0,) * variable.size
        else:
            values = draw(written, self._scenario.spec.seed, [f"{agent}.{part.name}.{variable.name}"])[0]
        return tuple(float(value) for value in values)


def _feeds_already(blueprint: Blueprint, reference: str) -> str | None:
    """What else an input gets its values from, and where that is written."""
    spec = blueprint.entry.spec
    for index, (source, target) in enumerate(spec.connections):
        if target == reference:
            return f"is connected to {source!r}, {blueprint.where('connections', index).short}"
    for name, target in spec.receive.items():
        if target == reference:
            return f"receives {name!r}, {blueprint.where('receive', name).short}"
    return None


def _recorded(blueprint: Blueprint, variable: str) -> slice | None:
    """Where a variable is in the recorded row."""
    begin = 0
    for name, port in blueprint.record:
        if name == variable:
            return slice(begin, begin + port.variable.size)
        begin += port.variable.size
    return None


def _bounds(variable: Variable) -> tuple[float, float, bool]:
    """What an input can hold: least, most, and whether whole numbers only."""
    if variable.dtype == "Boolean":
        return 0.0, 1.0, True
    if variable.dtype == "Float32":
        return -_LARGEST_FLOAT32, _LARGEST_FLOAT32, False
    if variable.dtype not in INTEGERS:
        return -math.inf, math.inf, False
    bits = int(variable.dtype.removeprefix("U").removeprefix("Int"))
    if variable.dtype.startswith("U"):
        return 0.0, min(2.0**bits - 1, _EXACT), True
    return max(-(2.0 ** (bits - 1)), -_EXACT), min(2.0 ** (bits - 1) - 1, _EXACT), True
