"""Who heard of whom in time: the update sets N_i(σ) of the paper's observer, and whether they were jointly rooted.

The observer of follower i uses, at tick σ, its own estimate and what came fresh from its in-neighbours in
((σ-1)T, σT] (eq. updatevk_follower and the definition after eq. updatevk_f2). Proposition 1 needs the graphs of these
sets to be repeatedly jointly rooted: over every window of ⌈h*/T⌉ + 1 ticks their composition has a root. Leaders hear
nobody, but all of each other; every agent hears itself (the graphs G_s of the proof).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from network.freshness import EdgeLog, Span
from network.messages import Fate, Ints, Links

Words = NDArray[np.uint64]
Sets = Words
"""(n, windows, words) sets of agents as bits: of whom each agent has heard over each window, itself included."""

_WORDS_AT_ONCE = 2**17  # in the working arrays: about what the second-level cache holds


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

    Windows are composed tick by tick, many at once; one in which everybody has heard of somebody is rooted, and done
    with. Of those that are left at their end, the composed graph may still have a root over several of its steps.

    Args:
        logs: of every edge, in the order of `links`.
        links: the edges.
        span: of the logs.
        window: ticks per window: ⌈h*/T⌉ + 1, at least 1.
        leaders: indices of agents that hold their estimate.
    """
    grew = updates(logs, span)
    net = _Network(links, leaders)
    n_windows = max(0, span.n_ticks - window + 1)
    rooted = np.zeros(n_windows, np.bool_)

    @cache  # the same few graphs come again and again
    def has_root(heard: bytes) -> bool:
        return net.has_root(np.frombuffer(heard, np.uint64).reshape(net.n, net.words))

    ever, open_ = net.compose(np.asarray(grew.any(axis=0))[None, :], np.zeros(1, np.int64), 1)
    if not len(open_) or net.has_root(ever[:, 0]):  # else no window has a root either
        at_once = max(1, _WORDS_AT_ONCE // max(1, len(links) * net.words))
        for begin in range(0, n_windows, at_once):
            begins = np.arange(begin, min(begin + at_once, n_windows))
            heard, open_ = net.compose(grew, begins, window)
            rooted[begins] = True
            rooted[open_] = [has_root(heard[:, i].tobytes()) for i in range(len(open_))]
    heard_per_agent = np.zeros(net.n)
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
    net = _Network(links, leaders)
    heard, open_ = net.compose(updates(logs, span), np.array([ticks.start]), len(ticks))
    if not len(open_):
        return []
    reached = [net.reached_from(heard[:, 0], root) for root in net.candidates]
    best = max(reached, key=np.count_nonzero)  # of equals the first
    return np.flatnonzero(~best).tolist()


class _Network:
    """The edges between followers and to them; leaders, if there are any, hear each other and nobody else."""

    def __init__(self, links: Links, leaders: Collection[int]) -> None:
        self.n = len(links.agents)
        self.words = -(-self.n // 64)
        self._leaders = np.array(sorted(leaders), np.intp)
        self.candidates: list[int] = self._leaders.tolist() or list(range(self.n))
        kept = np.flatnonzero(~np.isin(links.receiver, self._leaders))
        self._link = kept[np.argsort(links.receiver[kept], kind="stable")]
        self._sender, self._receiver = links.sender[self._link], links.receiver[self._link]
        agents = np.arange(self.n)
        self._itself = np.zeros((self.n, self.words), np.uint64)
        self._itself[agents, agents // 64] = np.uint64(1) << (agents % 64).astype(np.uint64)
        roots = np.bitwise_or.reduce(self._itself[self.candidates], axis=0)
        self._roots: Words = roots[None, :]

    def compose(self, grew: NDArray[np.bool_], begins: Ints, window: int) -> tuple[Sets, Ints]:
        """Who has heard of whom over windows.

        Args:
            grew: (n_ticks, n_links) as from `updates`.
            begins: (n_windows,) first tick of each.
            window: ticks in each, at least 1.

        Returns:
            The sets of those windows in which there is no candidate of whom all have heard, and when they begin.
        """
        fresh = np.ascontiguousarray(grew[:, self._link].T)
        heard = np.repeat(self._itself[:, None, :], len(begins), axis=1)
        for step in range(window):
            here = fresh[:, begins + step]
            some = np.flatnonzero(here.any(axis=1))
            passed = heard[self._sender[some]]
            passed *= here[some][:, :, None]
            if len(self._leaders):
                heard[self._leaders] |= self._roots
            if len(some):
                receiver = self._receiver[some]
                first = np.flatnonzero(np.append(True, receiver[1:] != receiver[:-1]))
                heard[receiver[first]] |= np.bitwise_or.reduceat(passed, first, axis=0)
            known_to_all = np.bitwise_and.reduce(heard, axis=0) & self._roots
            still = np.flatnonzero(~known_to_all.any(axis=1))
            if len(still) < len(begins):
                heard, begins = heard[:, still], begins[still]
            if not len(still):
                break
        return heard, begins

    def has_root(self, heard: Words) -> bool:
        """Whether a candidate reaches all in a graph of (n, words) in-neighbours, over any number of its steps."""
        if len(self._leaders):  # which have heard of each other
            return bool(self.reached_from(heard, self.candidates[0]).all())
        # If there is a root, then whoever is not reached from those tried before and reaches it last is one.
        reached = np.zeros(self.n, np.bool_)
        last = 0
        while not reached.all():
            last = int(np.argmin(reached))
            reached |= self.reached_from(heard, last)
        return bool(self.reached_from(heard, last).all())

    def reached_from(self, heard: Words, root: int) -> NDArray[np.bool_]:
        """(n,) whom the news of one agent reaches over any number of steps."""
        reached = np.zeros(self.n, np.bool_)
        reached[root] = True
        while True:
            known = np.bitwise_or.reduce(self._itself[reached], axis=0)
            further = (heard & known).any(axis=1)
            if np.array_equal(further, reached):
                return reached
            reached = further


def window_of(h_star_ns: int, period_ns: int) -> int:
    """Ticks in a window: ⌈h*/T⌉ + 1."""
    return -(-h_star_ns // period_ns) + 1
