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
from cosim.scenario.spec import EdgeSpec
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
    first: dict[tuple[str, str], Edge] = {}
    for index, spec in enumerate(graph.edges):
        node = scenario.root.find("graph", "edges", index) or scenario.root
        channel = _channel(scenario, spec, node, problems)
        weight = _given_weight(scenario, spec, node, problems)
        for sender, receiver in _pairs(scenario, spec, node, problems):
            if (earlier := first.get((sender, receiver))) is not None:
                problems.error(f"duplicate edge '{sender} -> {receiver}', first {earlier.where.short}", node.where)
            else:
                first[sender, receiver] = Edge(sender, receiver, weight, channel, node.where)
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


def _channel(scenario: Scenario, spec: EdgeSpec, node: Node, problems: Problems) -> str:
    name = spec.channel or scenario.spec.graph.channel
    if name is None:
        problems.error(
            "this edge has no channel; give it one, or all of them with `channel:` under `graph`", node.where
        )
    elif name not in scenario.spec.channels:
        where = node.locate("channel") if spec.channel else scenario.root.locate("graph", "channel")
        problems.error(f"unknown channel {name!r}{suggest(name, scenario.spec.channels)}", where)
    return name or ""


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
