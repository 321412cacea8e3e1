"""Measures of an edge's messages, against loops that follow the definitions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network.freshness import EdgeLog, Span
from network.messages import NEVER, Fate
from network.netem import Netem
from network.traffic import loss_runs, most_losses_in, one_way_delays, traffic
from tests.network.networks import T, dense_links, logs_of


@st.composite
def logs(draw: st.DrawFn) -> tuple[EdgeLog, Span]:
    """Messages of up to ten ticks: lost, twice, late, fresh or not as their arrivals have it."""
    span = Span(draw(st.integers(1, 10)), T)
    rows: list[tuple[int, int, int]] = []  # stamp, sent, arrival
    for tick in range(span.n_ticks):
        for _ in range(draw(st.integers(0, 2))):
            delay = draw(st.one_of(st.none(), st.integers(0, 4 * T)))
            rows.append((draw(st.integers(max(0, tick - 2), tick)), tick, NEVER if delay is None else tick * T + delay))
    fates, freshest = {}, -1
    for i in sorted(range(len(rows)), key=lambda i: (rows[i][2], rows[i][0])):
        stamp, _, arrival = rows[i]
        if arrival == NEVER:
            fates[i] = Fate.LOST
        elif arrival >= span.end_ns:
            fates[i] = Fate.IN_FLIGHT
        else:
            fates[i] = Fate.DELIVERED if stamp > freshest else Fate.SUPERSEDED
            freshest = max(freshest, stamp)
    columns = [np.array([row[c] for row in rows], np.int64) for c in range(3)]
    return EdgeLog(*columns, np.array([fates[i] for i in range(len(rows))], np.int64)), span


@given(logs())
def test_measures_are_those_of_their_definitions(case: tuple[EdgeLog, Span]) -> None:
    log, span = case
    rows = list(zip(*(c.tolist() for c in (log.stamp, log.sent, log.arrival_ns, log.fate)), strict=True))
    found = traffic(log, span)
    arrived = [row for row in rows if row[3] in (Fate.DELIVERED, Fate.SUPERSEDED)]
    assert found.sent == len(rows)
    assert found.delivered + found.superseded == len(arrived)
    assert sorted(one_way_delays(log, span)) == pytest.approx(sorted((a - s * T) / 1e9 for _, s, a, _ in arrived))
    fresh = sorted(a for _, _, a, fate in rows if fate == Fate.DELIVERED)
    times = [0, *fresh, span.end_ns]
    assert found.most_between == pytest.approx(max(b - a for a, b in itertools.pairwise(times)) / 1e9)
    stale = [(a - stamp * T) / 1e9 for stamp, _, a, fate in rows if fate == Fate.DELIVERED]
    assert found.most_stale == pytest.approx(max(stale)) if stale else math.isnan(found.most_stale)
    late = sum(any(other[1] > s and (other[2], other[1]) < (a, s) for other in arrived) for _, s, a, _ in arrived)
    assert found.reordered == pytest.approx(late / len(arrived)) if arrived else math.isnan(found.reordered)
    assert found.duplicates == len(arrived) - len({(stamp, s) for stamp, s, _, _ in arrived})


@given(logs(), st.integers(1, 6))
def test_losses_in_a_row_and_in_any_k(case: tuple[EdgeLog, Span], k: int) -> None:
    log, span = case
    lost = (log.fate[np.lexsort((log.stamp, log.sent))] == Fate.LOST).tolist()
    runs = [len(list(group)) for value, group in itertools.groupby(lost) if value]
    assert loss_runs(log).tolist() == runs
    assert traffic(log, span).losses_in_a_row == max(runs, default=0)
    windows = [sum(lost[i : i + k]) for i in range(max(1, len(lost) - k + 1))]
    assert most_losses_in(log, k) == max(windows)


def test_a_channel_that_keeps_its_order_reorders_nothing() -> None:
    for fifo, some in ((True, False), (False, True)):
        model = Netem.model_validate({"delay": {"time": "300 ms", "jitter": "200 ms", "fifo": fifo}})
        (log, *_) = logs_of(model, dense_links(2, 1), 200)
        assert (traffic(log, Span(200, T)).reordered > 0) == some


def test_every_message_twice() -> None:
    model = Netem.model_validate({"duplicate": 1, "delay": "10 ms"})
    (log, *_) = logs_of(model, dense_links(2, 1), 20)
    found = traffic(log, Span(20, T))
    assert (found.sent, found.delivered, found.superseded, found.duplicates) == (40, 20, 20, 20)
