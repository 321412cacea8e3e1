"""Edges, in-neighbours, weights and channels of a scenario's graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.errors import Location, suggest
from cosim.planning.problems import Problems
from cosim.scenario.names import agent_names
from cosim.scenario.reading import Scenario
from cosim.scenario.source import Node
from cosim.scenario.spec import ALL, EdgeSpec
from network.messages import Links


@dataclass(frozen=True)
class Edge:
    """One directed edge, by name: `receiver` can hear `sender`."""

    sender: str
    receiver: str
    weight: float
    channel: str
    where: Location


def resolve_edges(scenario: Scenario, problems: Problems) -> tuple[Edge, ...]:
    """Every edge once, by receiver and then by sender in the order of the agents: the order of the mailbox rows.

    The order of the lines in the file makes no difference to a run.
    """
    graph = scenario.spec.graph
    rules = _Rules(scenario, problems)
    first: dict[tuple[str, str], Edge] = {}
    for index, spec in enumerate(graph.edges):
        node = scenario.root.find("graph", "edges", index) or scenario.root
        own = _own_channel(scenario, spec, node, problems)
        weight = _given_weight(scenario, spec, node, problems)
        for sender, receiver in _pairs(scenario, spec, node, problems):
            if (earlier := first.get((sender, receiver))) is not None:
                problems.error(f"duplicate edge '{sender} -> {receiver}', first {earlier.where.short}", node.where)
            else:
                channel = own or rules.channel(sender, receiver)
                if channel is None and not rules.doubtful:
                    problems.error(f"{_NO_CHANNEL} ('{sender} -> {receiver}')", node.where)
                first[sender, receiver] = Edge(sender, receiver, weight, channel or "", node.where)
    index_of = {name: index for index, name in enumerate(scenario.agents)}
    edges = sorted(first.values(), key=lambda edge: (index_of[edge.receiver], index_of[edge.sender]))
    return tuple(_equally_weighted(edges)) if graph.weights == "equal" else tuple(edges)


def links_of(edges: Sequence[Edge], agents: Sequence[str]) -> Links:
    """The edges, ordered as `resolve_edges` orders them, as indices."""
    index_of = {name: index for index, name in enumerate(agents)}
    sender = np.array([index_of[edge.sender] for edge in edges], dtype=np.int64)
    receiver = np.array([index_of[edge.receiver] for edge in edges], dtype=np.int64)
    slot = np.arange(len(edges), dtype=np.int64) - np.searchsorted(receiver, receiver)
    return Links(tuple(agents), sender, receiver, slot)


def _pairs(scenario: Scenario, spec: EdgeSpec, node: Node, problems: Problems) -> Iterator[tuple[str, str]]:
    """The edges that one line stands for; ranges and lists stand for every pair but an agent and itself."""
    senders = known_agents(scenario, spec.from_, node.locate("from"), problems)
    receivers = known_agents(scenario, spec.to, node.locate("to"), problems)
    if senders == receivers and len(senders) == 1:
        problems.error(f"the edge '{senders[0]} -> {receivers[0]}' joins an agent to itself", node.where)
    yield from ((sender, receiver) for sender in senders for receiver in receivers if sender != receiver)


def known_agents(scenario: Scenario, text: str, where: Location, problems: Problems) -> list[str]:
    """The agents of a name, range or list; those that do not exist become problems."""
    names = list(agent_names(text))
    for name in names:
        if name not in scenario.agents and not scenario.doubts.about_agent(name):
            problems.error(f"unknown agent {name!r}{suggest(name, scenario.agents)}", where)
    return [name for name in names if name in scenario.agents]


_NO_CHANNEL = (
    "this edge has no channel; give it one, or many of them with `rules`, or all of them with `channel:`, under `graph`"
)


class _Rules:
    """Which profile an edge has that names none."""

    def __init__(self, scenario: Scenario, problems: Problems) -> None:
        graph = scenario.spec.graph
        self.doubtful = False
        self._default = graph.channel
        if graph.channel is not None:
            self._check(scenario, graph.channel, scenario.root.locate("graph", "channel"), problems)
        self._rules: list[tuple[frozenset[str], frozenset[str], str]] = []
        for index, rule in enumerate(graph.rules):
            node = scenario.root.find("graph", "rules", index) or scenario.root
            senders, receivers = (
                frozenset(scenario.agents)
                if text.strip() == ALL
                else frozenset(known_agents(scenario, text, node.locate(key), problems))
                for text, key in ((rule.from_, "from"), (rule.to, "to"))
            )
            self._check(scenario, rule.channel, node.locate("channel"), problems)
            self._rules.append((senders, receivers, rule.channel))

    def channel(self, sender: str, receiver: str) -> str | None:
        """Of the last rule that fits, else the graph's."""
        fitting = (
            name for senders, receivers, name in reversed(self._rules) if sender in senders and receiver in receivers
        )
        return next(fitting, self._default)

    def _check(self, scenario: Scenario, name: str, where: Location, problems: Problems) -> None:
        self.doubtful |= not _is_channel(scenario, name, where, problems)


def _is_channel(scenario: Scenario, name: str, where: Location, problems: Problems) -> bool:
    if name in scenario.spec.channels:
        return True
    problems.error(f"unknown channel {name!r}{suggest(name, scenario.spec.channels)}", where)
    return False


def _own_channel(scenario: Scenario, spec: EdgeSpec, node: Node, problems: Problems) -> str | None:
    """The profile that the line names."""
    if spec.channel is not None:
        _is_channel(scenario, spec.channel, node.locate("channel"), problems)
    return spec.channel


def _given_weight(scenario: Scenario, spec: EdgeSpec, node: Node, problems: Problems) -> float:
    if scenario.spec.graph.weights == "given":
        if spec.weight is None:
            problems.error(
                "with 'weights: given' every edge needs its weight: {from: 4, to: 1, weight: 0.5}", node.where
            )
    elif spec.weight is not None:
        problems.error("a weight of its own needs 'weights: given' under 'graph'", node.locate("weight", key=True))
    return spec.weight or 0.0


def _equally_weighted(edges: Sequence[Edge]) -> Iterator[Edge]:
    """a_ij = 1/|N_i|, so that every κ_i is 1."""
    count: dict[str, int] = {}
    for edge in edges:
        count[edge.receiver] = count.get(edge.receiver, 0) + 1
    for edge in edges:
        yield Edge(edge.sender, edge.receiver, 1.0 / count[edge.receiver], edge.channel, edge.where)
