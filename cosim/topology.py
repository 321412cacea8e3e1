"""Who can be reached from whom: roots, reachability, weighted in-degrees. An edge goes from sender to receiver."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from network.messages import Floats, Links

Mask = NDArray[np.bool_]


def reached_by(links: Links, start: int, *, backwards: bool = False) -> Mask:
    """Which agents a message can reach from `start`, hop by hop, itself included.

    Args:
        links: the edges.
        start: index of an agent.
        backwards: which agents can reach `start`, instead.

    Returns:
        (n_agents,) bool.
    """
    return _reached(_successors(links, backwards=backwards), start)


def _successors(links: Links, *, backwards: bool = False) -> list[list[int]]:
    ends = (links.receiver, links.sender) if backwards else (links.sender, links.receiver)
    successors: list[list[int]] = [[] for _ in links.agents]
    for here, there in zip(*(end.tolist() for end in ends), strict=True):
        successors[here].append(there)
    return successors


def _reached(successors: Sequence[Sequence[int]], start: int) -> Mask:
    reached = np.zeros(len(successors), dtype=np.bool_)
    reached[start] = True
    waiting = [start]
    while waiting:
        for other in successors[waiting.pop()]:
            if not reached[other]:
                reached[other] = True
                waiting.append(other)
    return reached


def sources(links: Links) -> list[int]:
    """The fewest agents from which all are reached: one of each strongly connected part that nothing leads into.

    The graph is rooted (contains a spanning tree) if there is only one.
    """
    successors = _successors(links)
    seen = np.zeros(len(links.agents), dtype=np.bool_)
    found: list[int] = []
    for agent in range(len(links.agents)):
        if not seen[agent]:
            reached = _reached(successors, agent)
            seen |= reached
            found = [*(other for other in found if not reached[other]), agent]
    return found


def roots(links: Links) -> list[int]:
    """Agents from which every other one is reached; empty if the graph is not rooted."""
    first = sources(links)
    return np.flatnonzero(reached_by(links, first[0], backwards=True)).tolist() if len(first) == 1 else []


def kappa(links: Links, weights: Sequence[float]) -> Floats:
    """κ_i = Σ_j a_ij, shape (n_agents,); 0 for an agent that hears nobody.

    Args:
        links: the edges.
        weights: (n_links,) a_ij of each edge.
    """
    sums = np.zeros(len(links.agents))
    np.add.at(sums, links.receiver, weights)
    return sums
