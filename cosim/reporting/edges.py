"""The deliveries of a run, edge by edge: what the report says of the network."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from cosim.results import Results
from network.freshness import (
    Age,
    EdgeLog,
    Front,
    Span,
    age_of_information,
    edge_logs,
    tolerance_front,
)
from network.messages import Fate, Fates
from network.traffic import Traffic, traffic

MAX_FATES = 5_000_000
"""Of a longer log, the beginning is looked at."""


class Edges:
    """Logs and measures of every edge, in the plan's order.

    Args:
        results: of the run, of at least two ticks.
    """

    def __init__(self, results: Results) -> None:
        self.results = results

    def __len__(self) -> int:
        return len(self.results.links)

    def name(self, link: int) -> str:
        """`4 → 1`."""
        links = self.results.links
        return f"{links.agents[links.sender[link]]} → {links.agents[links.receiver[link]]}"

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

    @cached_property
    def fronts(self) -> list[Front]:
        """The pairs (k*, h) of Assumption 1 that the log does not refute."""
        return [tolerance_front(log, self.span) for log in self.logs]
