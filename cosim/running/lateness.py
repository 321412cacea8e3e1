"""Durations of a long run in bounded memory: their quantiles, and how they went over time."""

from __future__ import annotations

import math
from collections import Counter

from network.units import NANOSECONDS_PER_SECOND

RESOLUTION = 0.01
"""A quantile is given at most so much too large, relative to itself; the largest duration is exact."""

POINTS = 512
"""Up to as many points over time are kept; when there are more, each two neighbours become one."""

_LOG_BASE = math.log1p(RESOLUTION)


class Durations:
    """Quantiles of durations, counted in intervals whose bounds grow by `RESOLUTION`: some thousand for any number.

    As in C. Masson, J. E. Rim, H. K. Lee: DDSketch, PVLDB 12 (2019).

    Attributes:
        count: how many there were.
        largest_ns: exact.
    """

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self.count = 0
        self.largest_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one; a negative one counts as 0."""
        self._counts[math.ceil(math.log(max(1, duration_ns)) / _LOG_BASE)] += 1
        self.count += 1
        self.largest_ns = max(self.largest_ns, duration_ns)

    def quantile(self, share: float) -> float:
        """The least duration, in seconds, that at least this share of all does not exceed; 0 if there was none."""
        left = math.ceil(share * self.count)
        for interval in sorted(self._counts):
            left -= self._counts[interval]
            if left <= 0:
                return min(math.exp(interval * _LOG_BASE), self.largest_ns) / NANOSECONDS_PER_SECOND
        return 0.0

    def summary(self) -> dict[str, float | None]:
        """`p50`, `p99` and `max` in seconds; None where there was none."""
        if not self.count:
            return dict.fromkeys(("p50", "p99", "max"))
        largest = self.largest_ns / NANOSECONDS_PER_SECOND
        return {"p50": round(self.quantile(0.5), 9), "p99": round(self.quantile(0.99), 9), "max": largest}


class Course:
    """Mean and largest duration per point of time; a point is 1, 2, 4, 8, … ticks."""

    def __init__(self) -> None:
        self.ticks_per_point = 1
        self._sums: list[int] = []
        self._largest: list[int] = []
        self._count = 0

    def add(self, duration_ns: int) -> None:
        """The duration of the next tick."""
        if self._count == POINTS * self.ticks_per_point:
            self._sums = [sum(self._sums[i : i + 2]) for i in range(0, POINTS, 2)]
            self._largest = [max(self._largest[i : i + 2]) for i in range(0, POINTS, 2)]
            self.ticks_per_point *= 2
        if self._count % self.ticks_per_point == 0:
            self._sums.append(0)
            self._largest.append(0)
        self._sums[-1] += duration_ns
        self._largest[-1] = max(self._largest[-1], duration_ns)
        self._count += 1

    def summary(self) -> dict[str, int | list[float]]:
        """`ticks_per_point`, and per point `mean` and `max` in seconds."""
        full, rest = divmod(self._count, self.ticks_per_point)
        counts = [self.ticks_per_point] * full + [rest] * (rest > 0)
        return {
            "ticks_per_point": self.ticks_per_point,
            "mean": [round(total / n / NANOSECONDS_PER_SECOND, 9) for total, n in zip(self._sums, counts, strict=True)],
            "max": [largest / NANOSECONDS_PER_SECOND for largest in self._largest],
        }
