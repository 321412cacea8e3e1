"""How fresh the information was: age of information, and the (k*, h) of the paper's Assumption 1, from a log.

A log is what became of every message that was sent at ticks 0, …, N - 1, and is known up to NT (exclusive).

The **age of information** of an edge at time t is t minus the time at which the freshest sample that has arrived was
taken: t - k_ij(t)·T (eq. k_t). Until the first arrival it counts from the start of the run, as if a sample of
tick 0 had been there: what the receiver then assumes of its neighbour is about that time. Each arrival of a fresher
sample ends a peak (Costa, Codreanu, Ephremides: "On the age of information in status update systems", 2016).

**Assumption 1** asks of an edge that a sequence of samples, the first among ticks 0, …, k*, and each at most k* ticks
after the one before, arrive within h of being taken. A log refutes pairs (k*, h) that are too small.
`tolerance_fronts` gives those that it does not refute and that cannot be made smaller. (The largest age read at ticks,
which the paper calls h*, is another number, and usually less than the smallest k*·T + h.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from network.messages import Fate, Fates, Ints, Links
from network.units import to_seconds

_NEVER_ARRIVES = np.iinfo(np.int64).max
_SAMPLES_AT_ONCE = 2**17


@dataclass(frozen=True)
class Span:
    """What a log covers: messages sent at ticks 0, …, n_ticks - 1 (one at least), and what came before n_ticks·T."""

    n_ticks: int
    period_ns: int

    @property
    def end_ns(self) -> int:
        """The time up to which fates are known, exclusive."""
        return self.n_ticks * self.period_ns


@dataclass(frozen=True)
class EdgeLog:
    """What became of the messages of one edge; the (n,) columns are those of `Fates`."""

    stamp: Ints
    sent: Ints
    arrival_ns: Ints
    fate: Ints


def edge_logs(fates: Fates, links: Links) -> list[EdgeLog]:
    """The log of a network, taken apart: one log per edge, in the order of `links`."""
    n_agents = len(links.agents)
    edge = fates.sender * n_agents + fates.receiver
    order = np.argsort(edge, kind="stable")
    wanted = links.sender * n_agents + links.receiver
    begins = np.searchsorted(edge[order], wanted).tolist()
    ends = np.searchsorted(edge[order], wanted, side="right").tolist()
    columns = [column[order] for column in (fates.stamp, fates.sent, fates.arrival_ns, fates.fate)]
    return [EdgeLog(*(column[i:j] for column in columns)) for i, j in zip(begins, ends, strict=True)]


# --- age of information ----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Age:
    """Age of information of an edge over a log, in seconds.

    Attributes:
        mean: over time, from 0 to the end of the log.
        peak_mean: mean of the ages just before each arrival of a fresher sample; NaN if there was none.
        sup: least upper bound over time. The age jumps down at arrivals, so it need not be attained.
        tick_mean, tick_sup: of the age read at the ticks 0, …, n_ticks - 1, after what arrives at the tick itself.
    """

    mean: float
    peak_mean: float
    sup: float
    tick_mean: float
    tick_sup: float


def age_of_information(log: EdgeLog, span: Span) -> Age:
    """Age of information of one edge; exact but for the rounding of the means."""
    begin, taken = _freshest(log, span)
    end = np.append(begin[1:], span.end_ns)
    lasts = end > begin
    begin, end, taken = begin[lasts], end[lasts], taken[lasts]
    lasting, peaks = end - begin, (end - taken).astype(np.float64)
    middle = peaks - lasting / 2
    at_ticks = _at_ticks(begin, taken, span)
    return Age(
        mean=float((middle * lasting).sum() / lasting.sum()) / 1e9,
        peak_mean=float(peaks[:-1].mean()) / 1e9 if len(peaks) > 1 else float("nan"),
        sup=to_seconds(int((end - taken).max())),
        tick_mean=float(at_ticks.mean()) / 1e9,
        tick_sup=to_seconds(int(at_ticks.max())),
    )


def ages_at_ticks(log: EdgeLog, span: Span) -> Ints:
    """(n_ticks,) nanoseconds: the age read at each tick, after what arrives at the tick itself."""
    return _at_ticks(*_freshest(log, span), span)


def _at_ticks(begin: Ints, taken: Ints, span: Span) -> Ints:
    ticks = np.arange(span.n_ticks) * span.period_ns
    return np.asarray(ticks - taken[np.searchsorted(begin, ticks, side="right") - 1], np.int64)


def intervals_above(ages: Ints, limit_ns: int) -> Ints:
    """(n, 2) where the age at ticks exceeds a limit: the first tick, and the first one after it that does not.

    Args:
        ages: (n_ticks,) nanoseconds, as from `ages_at_ticks`.
        limit_ns: the largest age that was assumed.
    """
    above = np.concatenate(([False], ages > limit_ns, [False]))
    return np.flatnonzero(above[1:] != above[:-1]).reshape(-1, 2)


def _freshest(log: EdgeLog, span: Span) -> tuple[Ints, Ints]:
    """When each freshest sample came into force, from 0 on and in order, and when it was taken."""
    fresh = log.fate == Fate.DELIVERED
    arrival, stamp = log.arrival_ns[fresh], log.stamp[fresh]
    order = np.lexsort((stamp, arrival))
    first = np.zeros(1, np.int64)
    return np.concatenate((first, arrival[order])), np.concatenate((first, stamp[order] * span.period_ns))


# --- Assumption 1 ----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Front:
    """Pairs (k*, h) of which neither can be made smaller without making the other larger.

    Attributes:
        k_star: (n,) ticks, strictly decreasing.
        h_ns: (n,) nanoseconds, strictly increasing. Empty where no pair will do: nothing ever arrived.
    """

    k_star: Ints
    h_ns: Ints

    def smallest_sum_ns(self, period_ns: int) -> int | None:
        """The literal minimum of k*·T + h (eq. h_star) over the front; None where it is empty."""
        return int((self.k_star * period_ns + self.h_ns).min()) if len(self.h_ns) else None


def tolerance_fronts(logs: Sequence[EdgeLog], span: Span) -> list[Front]:
    """The smallest pairs (k*, h) of Assumption 1 that the log of each edge does not refute, for the delays h it shows.

    The delay of a sample runs from when it was taken to its first arrival. The ends of the log count as follows. The
    first sample in time may be that of tick k* at the latest. A sample that had not arrived by the end of the log, and
    was not lost, may yet arrive: its delay is at least its age at the end, and is taken to be that. All samples after
    the log may be in time: the gap at its end reaches to the first of them.

    The exact front in O(N log N): samples are struck in the order of falling delay, where the largest gap only grows.
    """
    at_once = max(1, _SAMPLES_AT_ONCE // span.n_ticks)
    return [front for i in range(0, len(logs), at_once) for front in _fronts_of_some(logs[i : i + at_once], span)]


def _fronts_of_some(logs: Sequence[EdgeLog], span: Span) -> list[Front]:
    delays, arrived = _delays(logs, span)
    order = np.argsort(delays, axis=1, kind="stable")
    delay = np.take_along_axis(delays, order, axis=1)
    gap = _largest_gaps(order)
    # Of samples with equal delays the last stands for all: h may be that if one of them did arrive.
    last = np.ones(delay.shape, np.bool_)
    last[:, :-1] = delay[:, 1:] != delay[:, :-1]
    edge, place = np.nonzero(last)
    so_far = np.cumsum(np.take_along_axis(arrived, order, axis=1), axis=1)[edge, place]
    new_edge = np.append(True, edge[1:] != edge[:-1])
    known = so_far > np.where(new_edge, 0, np.append(0, so_far[:-1]))
    edge, h, k_star = edge[known], delay[edge[known], place[known]], gap[edge[known], place[known]]
    falls = np.ones(len(edge), np.bool_)
    falls[1:] = (edge[1:] != edge[:-1]) | (k_star[1:] < k_star[:-1])
    edge, h, k_star = edge[falls], h[falls], k_star[falls]
    ends = np.searchsorted(edge, np.arange(len(logs) + 1)).tolist()
    return [Front(k_star[i:j], h[i:j]) for i, j in pairwise(ends)]


def common_front(fronts: Sequence[Front]) -> Front:
    """The front of the pairs (k*, h) that serve every edge: the paper's, "common to all (j, i)"."""
    if not fronts or any(len(front.h_ns) == 0 for front in fronts):
        return Front(np.zeros(0, np.int64), np.zeros(0, np.int64))
    h = np.unique(np.concatenate([front.h_ns for front in fronts]))
    h = h[h >= max(front.h_ns[0] for front in fronts)]
    # An edge whose front steps down to the next k* at `step` needs the `before` of that step for every smaller h.
    step = np.concatenate([front.h_ns[1:] for front in fronts])
    before = np.concatenate([front.k_star[:-1] for front in fronts])
    order = np.argsort(step, kind="stable")
    at_least = max(front.k_star[-1] for front in fronts)
    needed = np.maximum.accumulate(np.append(before[order], at_least)[::-1])[::-1]
    return _pareto(needed[np.searchsorted(step[order], h, side="right")], h)


def _delays(logs: Sequence[EdgeLog], span: Span) -> tuple[Ints, NDArray[np.bool_]]:
    """(n_edges, n_ticks) delay of each sample as `tolerance_fronts` takes it; and whether that sample did arrive."""
    edge = np.repeat(np.arange(len(logs)), [len(log.stamp) for log in logs])
    stamp, arrival, fate = (
        np.concatenate([getattr(log, name) for log in logs]) for name in ("stamp", "arrival_ns", "fate")
    )
    delays = np.tile(span.end_ns - np.arange(span.n_ticks) * span.period_ns, (len(logs), 1))
    lost, in_flight = fate == Fate.LOST, fate == Fate.IN_FLIGHT
    may_arrive = np.zeros(delays.shape, np.bool_)
    may_arrive[edge[in_flight], stamp[in_flight]] = True
    gone = lost & ~may_arrive[edge, stamp]
    delays[edge[gone], stamp[gone]] = _NEVER_ARRIVES
    came = np.flatnonzero(~lost & ~in_flight)
    came = came[np.argsort(-arrival[came], kind="stable")]  # the first of a sample's copies is assigned last, and holds
    delays[edge[came], stamp[came]] = arrival[came] - stamp[came] * span.period_ns
    arrived = np.zeros(delays.shape, np.bool_)
    arrived[edge[came], stamp[came]] = True
    return delays, arrived


def _largest_gaps(order: Ints) -> Ints:
    """(n_edges, n) largest gap, those at both ends included, that the first 1, 2, …, n of each row of `order` leave.

    A row is a permutation of 0, …, n - 1. The gap at the beginning is counted from 0, that at the end up to n. Struck
    in reverse, an element leaves the gap between its nearest neighbours that come earlier in `order`.
    """
    rows, n = order.shape
    rank = np.full((rows, n + 1), -1)  # the last column parts the rows
    np.put_along_axis(rank, order, np.arange(n)[None, :], axis=1)
    begin = np.arange(rows)[:, None] * (n + 1)
    right = _nearest_smaller(rank.reshape(-1)).reshape(rows, n + 1)[:, :n] - begin
    turned = np.append(rank[:, n - 1 :: -1] if n else rank[:, :0], rank[:, n:], axis=1)
    left = n - 1 - (_nearest_smaller(turned.reshape(-1)).reshape(rows, n + 1)[:, :n] - begin)[:, ::-1]
    left_by = np.take_along_axis(right - np.maximum(left, 0), order, axis=1)  # by striking each of `order`
    # With the first i + 1 of them left, all later ones have been struck.
    after = np.append(left_by[:, 1:], np.ones((rows, 1), np.int64), axis=1)
    return np.maximum.accumulate(after[:, ::-1], axis=1)[:, ::-1]


def _nearest_smaller(values: Ints) -> Ints:
    """(n,) index of the next smaller value to the right of each; n where there is none. None is less than -1.

    In a tree of minima: up and to the right past blocks in which all is larger, then down to the first that is not.
    """
    n = len(values)
    rows = [np.full(1 << n.bit_length(), -2, np.int64)]
    rows[0][:n] = values
    while len(rows[-1]) > 1:
        rows.append(np.minimum(rows[-1][0::2], rows[-1][1::2]))
    block = np.arange(1, n + 1)
    climbing = np.arange(n)
    stopped = []
    for row in rows:
        here, wanted = block[climbing], values[climbing]
        onward = row[here] > wanted
        again = onward & (here % 2 == 0)  # the right half of the same pair
        here = here + again
        onward &= ~again | (row[here] > wanted)
        block[climbing] = np.where(onward, (here + 1) // 2, here)
        stopped.append(climbing[~onward])
        climbing = climbing[onward]
    falling = stopped.pop()
    for row, joining in zip(rows[-2::-1], stopped[::-1], strict=True):
        left = 2 * block[falling]
        block[falling] = left + (row[left] > values[falling])
        falling = np.concatenate((falling, joining))
    return block


def _pareto(k_star: Ints, h_ns: Ints) -> Front:
    """The front of pairs given by rising h, and so by falling k*."""
    falls = np.ones(len(h_ns), np.bool_)
    falls[1:] = k_star[1:] < k_star[:-1]
    return Front(k_star[falls], h_ns[falls])
