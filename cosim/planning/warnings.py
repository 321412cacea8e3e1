"""What runs, but perhaps not as the user thinks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.errors import Location
from cosim.planning.graph import Edge, links_of
from cosim.planning.problems import Problems
from cosim.scenario.names import in_short
from cosim.scenario.reading import Scenario
from cosim.topology import reached_by, roots, sources


def add_warnings(scenario: Scenario, edges: Sequence[Edge], leaders: Sequence[str], problems: Problems) -> None:
    """About what is written but has no effect, and about a graph that cannot do what one expects."""
    _warn_unused(scenario, edges, problems)
    heard = {edge.sender for edge in edges}
    unheard = [name for name, entry in scenario.agents.items() if entry.spec.publish and name not in heard]
    if unheard and len(scenario.agents) > 1:
        problems.warning(f"nobody hears {_agents_text(unheard)}", scenario.root.locate("graph", "edges", key=True))
    deaf = {edge.receiver: edge.where for edge in edges if not scenario.agents[edge.receiver].spec.receive}
    for name, where in deaf.items():
        problems.warning(f"agent {name!r} has no 'receive', so what it hears has no effect", where)
    if edges:
        _warn_topology(scenario, edges, leaders, problems)


def _warn_unused(scenario: Scenario, edges: Sequence[Edge], problems: Problems) -> None:
    templates = {entry.template for entry in scenario.agents.values()}
    for name in scenario.spec.templates:
        if name not in templates:
            problems.warning(f"no agent uses the template {name!r}", scenario.root.locate("templates", name, key=True))
    channels = {edge.channel for edge in edges}
    for name in scenario.spec.channels:
        if name not in channels:
            problems.warning(f"no edge uses the channel {name!r}", scenario.root.locate("channels", name, key=True))


def _warn_topology(scenario: Scenario, edges: Sequence[Edge], leaders: Sequence[str], problems: Problems) -> None:
    names = list(scenario.agents)
    links = links_of(edges, names)
    where: Location = scenario.root.locate("graph", "edges", key=True)
    first = sources(links)
    if len(first) > 1:
        problems.warning(
            f"the graph has no root: {_agents_text([names[i] for i in first])} cannot reach each other, "
            "so that a common position or velocity cannot be expected",
            where,
        )
    elif leaders and not {names[i] for i in roots(links)} & set(leaders):
        unreached = [np.flatnonzero(~reached_by(links, names.index(leader))).tolist() for leader in leaders]
        fewest = min(unreached, key=len)
        leader = leaders[unreached.index(fewest)]
        problems.warning(
            f"no leader reaches every agent: from {leader!r} nothing reaches "
            f"{_agents_text([names[i] for i in fewest])}, so that the leaders' velocity cannot be expected of all",
            where,
        )


def _agents_text(names: Sequence[str]) -> str:
    return f"{'agent' if len(names) == 1 else 'agents'} {in_short(names)}"
