"""The deliveries of a run, edge by edge: what the report says of the network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from cosim.theory import mu, published_bound
from network.connectivity import Connectivity, connectivity, window_of
from network.freshness import (
    Age,
    EdgeLog,
    Front,
    Span,
    age_of_information,
    ages_at_ticks,
    common_front,
    edge_logs,
    intervals_above,
    tolerance_fronts,
)
from network.messages import Fate, Fates, Ints, Links
from network.traffic import Traffic, traffic

MAX_FATES = 5_000_000
"""Of a longer log, the beginning is looked at."""

FRONT_LIMIT = 5_000_000
"""Edges times ticks up to which Assumption 1 is evaluated: about a quarter of a second's work per million."""

CONNECTIVITY_LIMIT = 2_000_000_000
"""Edges times words of 64 agents times ticks of a window times windows up to which joint rootedness is evaluated: some
seconds' work."""


class Logged(Protocol):
    """Where deliveries are logged: the `Results` of a run, or a channel that was played alone."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Names."""

    @property
    def period_ns(self) -> int:
        """T."""

    @property
    def n_ticks(self) -> int:
        """Recorded ticks, tick 0 among them: one more than those at which messages left."""

    @property
    def links(self) -> Links:
        """The edges."""

    @property
    def analysis(self) -> Mapping[str, Any]:
        """Roles, gains and leaders; None where not given."""

    @property
    def n_fates(self) -> int:
        """How many fates there are."""

    @property
    def fates(self) -> Fates:
        """All of them."""

    def first_fates(self, limit: int) -> Fates:
        """The first ones, about so many."""

    def channel(self, link: int) -> str:
        """Name of the channel of an edge."""

    def age_bound(self, link: int) -> float | None:
        """The largest age in seconds, read at ticks, that the channel of an edge can produce; None without bound."""


@dataclass(frozen=True)
class Assumed:
    """The h* that the design of a controller assumed of an edge.

    Attributes:
        h_star_ns: None where nothing can be said.
        origin: where the number is from.
    """

    h_star_ns: int | None
    origin: str


class Edges:
    """Logs and measures of every edge, in the plan's order.

    Args:
        results: where they are logged, of at least two ticks.
    """

    def __init__(self, results: Logged) -> None:
        self.results = results

    def __len__(self) -> int:
        return len(self.results.links)

    def name(self, link: int) -> str:
        """`4 → 1`."""
        links = self.results.links
        return f"{links.agents[links.sender[link]]} → {links.agents[links.receiver[link]]}"

    def names(self, chosen: Iterable[int], limit: int = 6) -> str:
        """Some edges by name, the first few if there are many."""
        chosen = list(chosen)
        more = f" and {len(chosen) - limit} more" if len(chosen) > limit else ""
        return ", ".join(self.name(link) for link in chosen[:limit]) + more

    @cached_property
    def by_channel(self) -> dict[str, list[int]]:
        """The edges of each channel, in the order in which the channels first occur."""
        found: dict[str, list[int]] = {}
        for link in range(len(self)):
            found.setdefault(self.results.channel(link), []).append(link)
        return found

    @cached_property
    def span(self) -> Span:
        """What the logs cover: the run, or its beginning."""
        n_ticks = self.results.n_ticks - 1
        if self.results.n_fates > MAX_FATES:
            known = np.maximum(self._fates.sent, self._fates.arrival_ns // self.results.period_ns)
            n_ticks = min(n_ticks, int(known.max()))
        return Span(max(1, n_ticks), self.results.period_ns)

    @cached_property
    def _fates(self) -> Fates:
        return self.results.fates if self.results.n_fates <= MAX_FATES else self.results.first_fates(MAX_FATES)

    @cached_property
    def logs(self) -> list[EdgeLog]:
        """What became of the messages of each edge, as far as it was known before the end of the span."""
        fates = self._fates
        known = (fates.fate == Fate.IN_FLIGHT) | (fates.arrival_ns < self.span.end_ns)
        known &= fates.sent < self.span.n_ticks  # a run that fails has the fates of its last tick, too
        columns = (fates.sender, fates.receiver, fates.stamp, fates.sent, fates.arrival_ns, fates.fate)
        return edge_logs(Fates(*(column[known] for column in columns)), self.results.links)

    @cached_property
    def ages(self) -> list[Age]:
        """Age of information."""
        return [age_of_information(log, self.span) for log in self.logs]

    @cached_property
    def traffic(self) -> list[Traffic]:
        """Counts of messages."""
        return [traffic(log, self.span) for log in self.logs]

    # --- Assumption 1 -------------------------------------------------------------------------------------------------
    @property
    def fronts_are_known(self) -> bool:
        """Whether the log is short enough for `fronts`."""
        return len(self) * self.span.n_ticks <= FRONT_LIMIT

    @cached_property
    def fronts(self) -> list[Front]:
        """The pairs (k*, h) of Assumption 1 that the log does not refute."""
        return tolerance_fronts(self.logs, self.span)

    @cached_property
    def common_front(self) -> Front:
        """Those that serve every edge."""
        return common_front(self.fronts)

    @cached_property
    def assumed(self) -> list[Assumed]:
        """Per edge: its channel's bound; without one, the largest h* that the published condition admits."""
        results = self.results
        admitted = []
        for agent in results.agents:
            k_eta, lambda_ = ((results.analysis[key] or {}).get(agent) for key in ("k_eta", "lambda"))
            bound = -1.0 if k_eta is None or lambda_ is None else published_bound(mu(k_eta, lambda_))
            admitted.append(bound)
        found = []
        for link, receiver in enumerate(results.links.receiver.tolist()):
            channel = results.age_bound(link)
            if channel is not None:
                found.append(Assumed(round(channel * 1e9), "bound of the channel"))
            elif admitted[receiver] >= 0:
                found.append(Assumed(int(admitted[receiver] * 1e9), "published condition"))
            else:
                found.append(Assumed(None, "nothing"))
        return found

    @cached_property
    def breaks(self) -> list[Ints]:
        """Per edge, (n, 2): the ticks from and up to which (exclusive) it was older than assumed."""
        none = np.zeros((0, 2), np.int64)
        found = []
        for log, age, assumed in zip(self.logs, self.ages, self.assumed, strict=True):
            limit = assumed.h_star_ns
            broken = limit is not None and round(age.tick_sup * 1e9) > limit
            found.append(intervals_above(ages_at_ticks(log, self.span), limit or 0) if broken else none)
        return found

    @cached_property
    def incidents(self) -> list[tuple[int, int, list[int]]]:
        """Times at which some edge was older than assumed: first tick, the one after the last, and the edges."""
        spans = sorted((*span, link) for link, own in enumerate(self.breaks) for span in own.tolist())
        found: list[tuple[int, int, list[int]]] = []
        for first, stop, link in spans:
            if found and first <= found[-1][1]:
                begin, end, edges = found[-1]
                found[-1] = (begin, max(end, stop), edges if link in edges else [*edges, link])
            else:
                found.append((first, stop, [link]))
        return found

    @cached_property
    def worst_first(self) -> list[int]:
        """The edges: those that were too old for longest, then by their largest age at ticks."""
        too_old = [int((spans[:, 1] - spans[:, 0]).sum()) for spans in self.breaks]
        return sorted(range(len(self)), key=lambda link: (-too_old[link], -self.ages[link].tick_sup, link))

    @cached_property
    def assumed_h_star_ns(self) -> int | None:
        """The largest over the edges; None if nothing was assumed of one of them."""
        known = [one.h_star_ns for one in self.assumed]
        return None if None in known else max((one for one in known if one is not None), default=None)

    @cached_property
    def leaders(self) -> list[int]:
        """Indices of the agents that hold their estimate."""
        return [self.results.agents.index(name) for name in self.results.analysis["leaders"] or ()]

    @cached_property
    def connectivity(self) -> Connectivity | None:
        """Joint rootedness over windows of the assumed h*; None where that is not known, or too much work."""
        if self.assumed_h_star_ns is None:
            return None
        window = window_of(self.assumed_h_star_ns, self.span.period_ns)
        words = -(-len(self.results.agents) // 64)
        if len(self) * words * window * self.span.n_ticks > CONNECTIVITY_LIMIT:
            return None
        return connectivity(self.logs, self.results.links, self.span, window, self.leaders)
