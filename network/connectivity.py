"""Who heard of whom in time: the update sets N_i(σ) of the paper's observer, and whether they were jointly rooted.

The observer of follower i uses, at tick σ, its own estimate and what came fresh from its in-neighbours in
((σ-1)T, σT] (eq. updatevk_follower and the definition after eq. updatevk_f2). Proposition 1 needs the graphs of these
sets to be repeatedly jointly rooted: over every window of ⌈h*/T⌉ + 1 ticks their composition has a root. Leaders hear
nobody, but all of each other; every agent hears itself (the graphs G_s of the proof).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from network.freshness import EdgeLog, Span
from network.messages import Fate, Ints, Links

Graphs = NDArray[np.bool_]
"""(…, n, n): [j, i] where i heard j."""


def updates(logs: Sequence[EdgeLog], span: Span) -> NDArray[np.bool_]:
    """(n_ticks, n_links): whether the freshest stamp of an edge grew in ((σ-1)T, σT]; at tick 0, by time 0.

    Args:
        logs: of every edge.
        span: of the logs.
    """
    grew = np.zeros((span.n_ticks, len(logs)), np.bool_)
    for link, log in enumerate(logs):
        ticks = -(-log.arrival_ns[log.fate == Fate.DELIVERED] // span.period_ns)
        grew[ticks[ticks < span.n_ticks], link] = True
    return grew


@dataclass(frozen=True)
class Connectivity:
    """How often a network was jointly rooted.

    Attributes:
        window: ticks in a window.
        rooted: (n_windows,) whether the composition of the graphs of the window that begins at each tick has a root
            (among the leaders, where there are any).
        mean_updates: (n_agents,) mean number of in-neighbours whose data was fresh at a tick.
    """

    window: int
    rooted: NDArray[np.bool_]
    mean_updates: NDArray[np.float64]

    @property
    def first_gap(self) -> int | None:
        """The first tick at which a window begins that is not jointly rooted."""
        gaps = np.flatnonzero(~self.rooted)
        return int(gaps[0]) if len(gaps) else None


def connectivity(
    logs: Sequence[EdgeLog], links: Links, span: Span, window: int, leaders: Collection[int] = ()
) -> Connectivity:
    """Joint rootedness over every window of a log.

    The composition over a sliding window takes two products per tick, however long the window (a queue made of two
    stacks, each with its running compositions).

    Args:
        logs: of every edge, in the order of `links`.
        links: the edges.
        span: of the logs.
        window: ticks per window: ⌈h*/T⌉ + 1, at least 1.
        leaders: indices of agents that hold their estimate.
    """
    grew = updates(logs, span)
    n = len(links.agents)
    held = _mask(n, leaders)
    graphs = _graphs(grew, links, held)
    rooted = np.zeros(max(0, span.n_ticks - window + 1), np.bool_)
    older: list[Graphs] = []  # compositions of a tick with all that follow it in this stack; the oldest tick last
    newer: list[Graphs] = []
    together: Graphs | None = None  # of `newer`
    for tick, heard in enumerate(graphs):
        newer.append(heard)
        together = newer[-1] if together is None else _then(together, newer[-1])
        if tick < window - 1:
            continue
        if not older:
            for graph in reversed(newer):
                older.append(graph if not older else _then(graph, older[-1]))
            newer, together = [], None
        oldest = older.pop()
        whole = oldest if together is None else _then(oldest, together)
        rooted[tick - window + 1] = _has_root(whole, held)
    heard_per_agent = np.zeros(n)
    np.add.at(heard_per_agent, links.receiver, grew.mean(axis=0))
    return Connectivity(window, rooted, heard_per_agent)


def unreached(
    logs: Sequence[EdgeLog], links: Links, span: Span, ticks: range, leaders: Collection[int] = ()
) -> list[int]:
    """Indices of the agents that news did not reach over some ticks; of the best root (a leader if there are any).

    Args:
        logs: of every edge, in the order of `links`.
        links: the edges.
        span: of the logs.
        ticks: of the window.
        leaders: as for `connectivity`.
    """
    held = _mask(len(links.agents), leaders)
    whole: Graphs | None = None
    for heard in _graphs(updates(logs, span)[ticks.start : ticks.stop], links, held):
        whole = heard if whole is None else _then(whole, heard)
    return [] if whole is None else np.flatnonzero(_missed(whole, held)).tolist()


def _mask(n: int, indices: Collection[int]) -> NDArray[np.bool_]:
    mask = np.zeros(n, np.bool_)
    mask[list(indices)] = True
    return mask


def _graphs(grew: NDArray[np.bool_], links: Links, leaders: NDArray[np.bool_]) -> Iterator[Graphs]:
    """Who heard whom at each tick of (n_ticks, n_links)."""
    base = np.eye(len(leaders), dtype=np.bool_) | np.outer(leaders, leaders)
    into_follower = ~leaders[links.receiver]
    for row in grew:
        heard = base.copy()
        fresh = row & into_follower
        heard[links.sender[fresh], links.receiver[fresh]] = True
        yield heard


def _then(first: Graphs, second: Graphs) -> Graphs:
    """Who heard of whom over two graphs, one after the other."""
    return np.asarray(first.astype(np.float32) @ second.astype(np.float32) > 0)


def _has_root(heard: Graphs, leaders: NDArray[np.bool_]) -> bool:
    """Whether somebody, a leader if there are any, reaches all: over any number of steps of this graph."""
    return not _missed(heard, leaders).any()


def _missed(heard: Graphs, leaders: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) whom nobody's news reaches who reaches most (a leader if there are any); over any number of steps."""
    n = len(heard)
    candidates = np.flatnonzero(leaders) if leaders.any() else np.arange(n)
    if heard[candidates].all(axis=1).any():
        return np.zeros(n, np.bool_)
    reach, steps = heard, 1
    while steps < n:
        further = _then(reach, reach)
        if np.array_equal(further, reach):
            break
        reach, steps = further, 2 * steps
    best = candidates[np.argmax(reach[candidates].sum(axis=1))]
    return np.asarray(~reach[best])


def window_of(h_star_ns: int, period_ns: int) -> int:
    """Ticks in a window: ⌈h*/T⌉ + 1."""
    return -(-h_star_ns // period_ns) + 1


def fresh_counts(logs: Sequence[EdgeLog], links: Links, span: Span) -> Ints:
    """(n_ticks, n_agents): |N_ij(σ)|, how many in-neighbours' data was fresh."""
    counts = np.zeros((span.n_ticks, len(links.agents)), np.int64)
    grew = updates(logs, span)
    for link, receiver in enumerate(links.receiver.tolist()):
        counts[:, receiver] += grew[:, link]
    return counts
