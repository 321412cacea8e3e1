"""Freshness against its definitions, evaluated instant by instant and sample by sample."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network.freshness import (
    EdgeLog,
    Front,
    Span,
    age_of_information,
    common_front,
    edge_logs,
    tolerance_fronts,
)
from network.messages import NEVER, Fate, Fates
from network.traffic import traffic
from tests.network.networks import links_of

PERIOD = 4  # nanoseconds: small enough to look at every instant


def log_of(messages: list[tuple[int, int, int]], span: Span) -> EdgeLog:
    """A log of (stamp, sent, arrival), fates judged one by one; arrival `NEVER` for a loss."""
    freshest = NEVER
    rows = []
    for arrival, stamp, sent in sorted((arrival, stamp, sent) for stamp, sent, arrival in messages):
        if arrival == NEVER:
            fate = Fate.LOST
        elif arrival >= span.end_ns:
            fate = Fate.IN_FLIGHT
        elif stamp > freshest:
            freshest, fate = stamp, Fate.DELIVERED
        else:
            fate = Fate.SUPERSEDED
        rows.append((stamp, sent, arrival, fate))
    return EdgeLog(*(np.array([row[i] for row in rows], np.int64) for i in range(4)))


@st.composite
def logs(draw: st.DrawFn) -> tuple[EdgeLog, Span]:
    span = Span(draw(st.integers(1, 14)), PERIOD)
    messages = []
    for sent in range(span.n_ticks):
        for _ in range(draw(st.integers(0, 2))):
            stamp = draw(st.integers(max(0, sent - 3), sent))
            delay = draw(st.one_of(st.none(), st.integers(0, 6 * PERIOD)))
            messages.append((stamp, sent, NEVER if delay is None else sent * PERIOD + delay))
    return log_of(messages, span), span


# --- age -------------------------------------------------------------------------------------------------------------
def _age_at(log: EdgeLog, time: int) -> int:
    """t - k_ij(t)·T by its definition: from all arrivals, whatever their fate."""
    arrived = [s for s, a in zip(log.stamp, log.arrival_ns, strict=True) if NEVER != a <= time]
    return int(time - max(arrived, default=0) * PERIOD)


@settings(max_examples=150, deadline=None)
@given(logs())
def test_age_by_its_definition(case: tuple[EdgeLog, Span]) -> None:
    log, span = case
    ages = [_age_at(log, time) for time in range(span.end_ns)]  # between two instants the age grows by one
    age = age_of_information(log, span)
    assert age.mean == pytest.approx((np.mean(ages) + 0.5) / 1e9, rel=1e-12)
    assert age.sup == (max(ages) + 1) / 1e9
    assert age.tick_mean == pytest.approx(np.mean(ages[::PERIOD]) / 1e9, rel=1e-12)
    assert age.tick_sup == max(ages[::PERIOD]) / 1e9
    fresh = {int(a) for a in log.arrival_ns[log.fate == Fate.DELIVERED] if a > 0}
    peaks = [ages[time - 1] + 1 for time in sorted(fresh)]
    assert age.peak_mean == pytest.approx(np.mean(peaks) / 1e9 if peaks else math.nan, rel=1e-12, nan_ok=True)


def test_age_by_hand() -> None:
    span = Span(10, 1_000_000_000)
    second = 1_000_000_000
    log = log_of([(0, 0, 2 * second), (3, 3, 5 * second), (2, 2, 6 * second), (4, 4, NEVER)], span)
    age = age_of_information(log, span)  # 0 to 5, then from 2 up to 7
    assert age.mean == (5 * 2.5 + 5 * 4.5) / 10
    assert age.peak_mean == (2 + 5) / 2
    assert age.sup == 7.0
    assert age.tick_sup == 6.0
    assert age.tick_mean == (0 + 1 + 2 + 3 + 4 + 2 + 3 + 4 + 5 + 6) / 10


def test_age_of_an_edge_that_was_silent() -> None:
    age = age_of_information(log_of([], Span(10, PERIOD)), Span(10, PERIOD))
    assert (age.mean, age.sup, age.tick_sup) == (20e-9, 40e-9, 36e-9)
    assert math.isnan(age.peak_mean)


# --- traffic ---------------------------------------------------------------------------------------------------------
def test_traffic_by_hand() -> None:
    span = Span(8, PERIOD)
    log = log_of(
        [(0, 0, NEVER), (1, 1, 5), (2, 2, NEVER), (3, 3, NEVER), (2, 4, 17), (5, 5, 18), (4, 6, 25), (7, 7, 99)], span
    )
    counts = traffic(log, span, history=2)
    assert (counts.sent, counts.delivered, counts.superseded, counts.lost, counts.in_flight) == (8, 3, 1, 3, 1)
    assert counts.delivery_ratio == 4 / 7
    assert counts.losses_in_a_row == 2
    assert counts.never_sent == 0.0
    assert traffic(log, span).never_sent == 1 / 8


def test_traffic_of_an_edge_that_was_silent() -> None:
    counts = traffic(log_of([], Span(3, PERIOD)), Span(3, PERIOD), history=3)
    assert (counts.sent, counts.losses_in_a_row) == (0, 0)
    assert math.isnan(counts.delivery_ratio)
    assert math.isnan(counts.never_sent)
    assert traffic(log_of([], Span(3, PERIOD)), Span(3, PERIOD)).never_sent == 1.0


def test_a_network_s_log_is_taken_apart_by_edge() -> None:
    links = links_of("abc", [(1, 0), (2, 0), (0, 2)])
    columns = [[2, 1, 2, 1], [0, 0, 0, 0], [0, 1, 2, 3], [0, 1, 2, 3], [5, 6, 7, 8], [0, 0, 0, 0]]
    parts = edge_logs(Fates(*(np.array(column, np.int64) for column in columns)), links)
    assert [part.stamp.tolist() for part in parts] == [[1, 3], [0, 2], []]
    assert [part.arrival_ns.tolist() for part in parts] == [[6, 8], [5, 7], []]


# --- Assumption 1 ----------------------------------------------------------------------------------------------------
def _in_time(log: EdgeLog, span: Span, stamp: int, h: int) -> bool:
    """Whether the log lets the sample of a tick arrive within h of being taken."""
    mine = log.stamp == stamp
    arrived = mine & ((log.fate == Fate.DELIVERED) | (log.fate == Fate.SUPERSEDED))
    if arrived.any():
        return int(log.arrival_ns[arrived].min()) - stamp * PERIOD <= h
    if (mine & (log.fate == Fate.LOST)).any() and not (mine & (log.fate == Fate.IN_FLIGHT)).any():
        return False
    return span.end_ns - stamp * PERIOD <= h


def _k_star(log: EdgeLog, span: Span, h: int) -> int | None:
    """Smallest k* of Assumption 1 for an h, by the definition; None if no sample is known to be in time."""
    members = [k for k in range(span.n_ticks) if _in_time(log, span, k, h)]
    if not members:
        return None
    ends = [*members, span.n_ticks]
    return max([members[0], *(later - earlier for earlier, later in pairwise(ends))])


def _front_of(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The pairs that no other pair beats, by rising h."""
    kept = [p for p in set(pairs) if not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in pairs)]
    return sorted(kept, key=lambda pair: pair[1])


def _observed(log: EdgeLog) -> list[int]:
    arrived = (log.fate == Fate.DELIVERED) | (log.fate == Fate.SUPERSEDED)
    first: dict[int, int] = {}
    for stamp, arrival in zip(log.stamp[arrived].tolist(), log.arrival_ns[arrived].tolist(), strict=True):
        first[stamp] = min(arrival - stamp * PERIOD, first.get(stamp, 10**9))
    return sorted(set(first.values()))


def front_of(log: EdgeLog, span: Span) -> Front:
    (front,) = tolerance_fronts([log], span)
    return front


def _pairs(front: Front) -> list[tuple[int, int]]:
    return list(zip(front.k_star.tolist(), front.h_ns.tolist(), strict=True))


@settings(max_examples=150, deadline=None)
@given(logs())
def test_the_front_by_its_definition(case: tuple[EdgeLog, Span]) -> None:
    log, span = case
    candidates = [(_k_star(log, span, h), h) for h in _observed(log)]
    pairs = [(k, h) for k, h in candidates if k is not None]
    front = front_of(log, span)
    assert _pairs(front) == _front_of(pairs)
    assert front.smallest_sum_ns(PERIOD) == min((k * PERIOD + h for k, h in pairs), default=None)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.data())
def test_the_fronts_of_many_edges_are_those_of_each(n_ticks: int, data: st.DataObject) -> None:
    cases = [data.draw(logs()) for _ in range(data.draw(st.integers(0, 5)))]
    span = Span(max([n_ticks, *(case[1].n_ticks for case in cases)]), PERIOD)
    together = tolerance_fronts([log for log, _ in cases], span)
    for front, (log, _) in zip(together, cases, strict=True):
        candidates = [(_k_star(log, span, h), h) for h in _observed(log)]
        assert _pairs(front) == _front_of([(k, h) for k, h in candidates if k is not None])


@settings(max_examples=100, deadline=None)
@given(st.lists(logs(), max_size=4))
def test_the_common_front_serves_every_edge(cases: list[tuple[EdgeLog, Span]]) -> None:
    fronts = [front_of(log, span) for log, span in cases]
    pairs = []
    for h in {h for front in fronts for h in front.h_ns.tolist()}:
        served = [[k for k, other in _pairs(front) if other <= h] for front in fronts]
        if all(served):
            pairs.append((max(min(ks) for ks in served), h))
    assert _pairs(common_front(fronts)) == _front_of(pairs)


def test_an_ideal_edge_has_a_gap_of_one_tick_and_no_delay() -> None:
    span = Span(5, PERIOD)
    front = front_of(log_of([(k, k, k * PERIOD) for k in range(5)], span), span)
    assert _pairs(front) == [(1, 0)]
    assert front.smallest_sum_ns(PERIOD) == PERIOD


def test_nothing_arrived_and_no_pair_will_do() -> None:
    span = Span(5, PERIOD)
    empty = front_of(log_of([], span), span)
    assert _pairs(empty) == []
    assert empty.smallest_sum_ns(PERIOD) is None
    assert _pairs(common_front([empty, Front(np.array([1]), np.array([0]))])) == []
    assert _pairs(common_front([])) == []


def test_a_long_log_is_no_trouble() -> None:
    n = 50_000
    rng = np.random.default_rng(1)
    span = Span(n, PERIOD)
    stamp = np.arange(n)
    arrival = stamp * PERIOD + rng.permutation(n)
    log = EdgeLog(stamp, stamp, arrival, np.where(arrival < span.end_ns, Fate.DELIVERED, Fate.IN_FLIGHT))
    front = front_of(log, span)
    assert (np.diff(front.k_star) < 0).all()
    assert (np.diff(front.h_ns) > 0).all()
