"""What became of an edge's messages: counts, delays, runs of losses, order. In the terms of the IETF's IPPM.

One-way delay is that of RFC 7679, from when a message leaves to when it arrives; loss is RFC 7680's; reordering is RFC
4737's: a message is reordered if one that was sent after it arrived before it; duplicates are RFC 5560's.
(m, k)-firmness is Hamdaoui's and Ramanathan's ("A dynamic priority assignment technique for streams with (m,k)-firm
deadlines", 1995), counted in losses: `most_losses_in` any k messages in a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from network.freshness import EdgeLog, Span
from network.messages import Fate, Floats, Ints

_NAN = float("nan")
QUANTILES = (0.5, 0.95, 0.99)


@dataclass(frozen=True)
class Traffic:
    """An edge's messages over a log; times in seconds.

    Attributes:
        sent: messages that left, duplicates included.
        delivered, superseded, lost, in_flight: by fate; they add up to `sent`.
        delivery_ratio: share of those whose fate is known that arrived; NaN if there is none.
        losses_in_a_row: longest run of losses in the order of sending.
        mean_loss_run: mean length of such runs; NaN if nothing was lost.
        never_sent: share of the samples that never left, of those that no longer can; NaN if there is none.
        delay: (4,) median, 95 %, 99 % and maximum of the one-way delay of what arrived; NaN if nothing did.
        most_between: longest time from one arrival of fresher data to the next, the beginning and the end of the log
            included: the largest transmission interval (MATI) that was observed.
        most_stale: largest time from when a sample was taken to when it arrived as the freshest: the delay that a
            controller would have had to allow for (MAD); NaN if nothing arrived.
        reordered: share of what arrived that was reordered; NaN if nothing did.
        duplicates: copies that arrived beside the first.
    """

    sent: int
    delivered: int
    superseded: int
    lost: int
    in_flight: int
    delivery_ratio: float
    losses_in_a_row: int
    mean_loss_run: float
    never_sent: float
    delay: Floats
    most_between: float
    most_stale: float
    reordered: float
    duplicates: int


def traffic(log: EdgeLog, span: Span, history: int = 0) -> Traffic:
    """Count and measure the messages of one edge.

    Args:
        log: of the edge.
        span: of the log.
        history: how many ticks back a sample that the channel sends may lie (`Channel.history`): the last `history`
            samples of the log may still be sent after its end and so are left out of `never_sent`.
    """
    delivered, superseded, lost, in_flight = np.bincount(log.fate, minlength=len(Fate)).tolist()
    arrived = delivered + superseded
    settled = max(0, span.n_ticks - history)
    has_left = np.zeros(span.n_ticks, np.bool_)
    has_left[log.stamp] = True
    left = np.count_nonzero(has_left[:settled])
    runs = loss_runs(log)
    delays = one_way_delays(log, span)
    fresh = log.fate == Fate.DELIVERED
    fresh_at, stamp = log.arrival_ns[fresh], log.stamp[fresh]
    between = np.diff(np.concatenate(([0], np.sort(fresh_at), [span.end_ns])))
    return Traffic(
        sent=len(log.stamp),
        delivered=delivered,
        superseded=superseded,
        lost=lost,
        in_flight=in_flight,
        delivery_ratio=arrived / (arrived + lost) if arrived + lost else _NAN,
        losses_in_a_row=int(runs.max(initial=0)),
        mean_loss_run=float(runs.mean()) if len(runs) else _NAN,
        never_sent=1 - left / settled if settled else _NAN,
        delay=_quantiles(delays) if arrived else np.full(4, _NAN),
        most_between=float(between.max()) / 1e9,
        most_stale=float((fresh_at - stamp * span.period_ns).max()) / 1e9 if delivered else _NAN,
        reordered=_reordered(log) / arrived if arrived else _NAN,
        duplicates=_duplicates(log),
    )


def one_way_delays(log: EdgeLog, span: Span) -> Floats:
    """(n,) seconds from leaving to arriving, of all that arrived, in the order of the log."""
    arrived = _arrived(log)
    return np.asarray((log.arrival_ns[arrived] - log.sent[arrived] * span.period_ns) / 1e9)


def times_between(log: EdgeLog) -> Floats:
    """(n - 1,) seconds from each arrival of fresher data to the next, of n such arrivals."""
    return np.asarray(np.diff(np.sort(log.arrival_ns[log.fate == Fate.DELIVERED])) / 1e9)


def loss_runs(log: EdgeLog) -> Ints:
    """(n,) lengths of the runs of losses, in the order of sending."""
    flags = np.concatenate(([False], _losses(log), [False]))
    changes = np.flatnonzero(flags[1:] != flags[:-1])
    return np.asarray(changes[1::2] - changes[::2], np.int64)


def most_losses_in(log: EdgeLog, k: int) -> int:
    """The m of (m, k): at most so many of any k messages in a row, in the order of sending, were lost.

    Args:
        log: of an edge.
        k: at least 1.
    """
    sums = np.concatenate(([0], np.cumsum(_losses(log))))
    k = min(k, len(sums) - 1)
    return int((sums[k:] - sums[: len(sums) - k]).max(initial=0))


def _quantiles(values: Floats) -> Floats:
    """(4,) those of `QUANTILES`, linear between values, and the maximum; as `np.quantile`, which is slow for few."""
    ordered = np.sort(values)
    place = np.array([*QUANTILES, 1.0]) * (len(ordered) - 1)
    below = place.astype(np.int64)
    low, high = ordered[below], ordered[np.minimum(below + 1, len(ordered) - 1)]
    return np.asarray(low + (high - low) * (place - below))


def _losses(log: EdgeLog) -> NDArray[np.bool_]:
    """(n,) whether each message was lost, in the order of sending."""
    return np.asarray(log.fate[np.lexsort((log.stamp, log.sent))] == Fate.LOST)


def _arrived(log: EdgeLog) -> NDArray[np.bool_]:
    return np.asarray((log.fate == Fate.DELIVERED) | (log.fate == Fate.SUPERSEDED))


def _reordered(log: EdgeLog) -> int:
    """How many arrived after one that was sent later."""
    arrived = _arrived(log)
    sent, arrival = log.sent[arrived], log.arrival_ns[arrived]
    in_order = sent[np.lexsort((sent, arrival))]
    return int(np.count_nonzero(in_order < np.maximum.accumulate(in_order))) if len(in_order) else 0


def _duplicates(log: EdgeLog) -> int:
    """How many arrived although the same sample, sent at the same tick, had arrived."""
    arrived = _arrived(log)
    stamp, sent = log.stamp[arrived], log.sent[arrived]
    each = np.sort(stamp * (sent.max(initial=0) + 1) + sent)
    return int(np.count_nonzero(each[1:] == each[:-1]))
