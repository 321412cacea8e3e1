"""Quantiles of durations in bounded memory, against the sorted list."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from cosim.running.lateness import POINTS, RESOLUTION, Course, Durations

durations = st.lists(st.integers(0, 10**13), min_size=1, max_size=300)


@given(durations, st.sampled_from([0.01, 0.5, 0.9, 0.99, 1.0]))
def test_quantiles_are_at_most_one_percent_too_large(values: list[int], share: float) -> None:
    kept = Durations()
    for value in values:
        kept.add(value)
    exact = sorted(values)[math.ceil(share * len(values)) - 1] / 1e9
    assert exact * (1 - 1e-9) <= kept.quantile(share) <= max(1e-9, exact * (1 + RESOLUTION) * (1 + 1e-9))
    assert kept.summary()["max"] == max(values) / 1e9


def test_nothing_is_said_of_nothing() -> None:
    assert Durations().summary() == {"p50": None, "p99": None, "max": None}
    assert Course().summary() == {"ticks_per_point": 1, "mean": [], "max": []}


@given(st.integers(1, 5 * POINTS), st.integers(0, 10**9))
def test_the_course_keeps_means_and_maxima(n_ticks: int, seed: int) -> None:
    values = [(seed + 7919 * i * i) % 1_000_003 for i in range(n_ticks)]
    course = Course()
    for value in values:
        course.add(value)
    summary = course.summary()
    every, means, largest = summary["ticks_per_point"], summary["mean"], summary["max"]
    assert isinstance(every, int)
    assert isinstance(means, list)
    assert isinstance(largest, list)
    groups = [values[i : i + every] for i in range(0, n_ticks, every)]
    assert len(groups) <= POINTS
    assert largest == [max(group) / 1e9 for group in groups]
    assert means == [round(sum(group) / len(group) / 1e9, 9) for group in groups]
    assert n_ticks <= POINTS or every * POINTS < 2 * n_ticks
