from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from network.units import (
    Duration,
    DurationRange,
    PositiveDuration,
    Probability,
    first_nanosecond,
    format_duration,
    parse_duration,
    parse_probability,
    to_seconds,
)


class Quantities(BaseModel):
    wait: Duration = 0
    period: PositiveDuration = 1
    delay: DurationRange = (0, 0)
    loss: Probability = 0.0


@pytest.mark.parametrize(
    ("written", "nanoseconds"),
    [
        ("100 ms", 100_000_000),
        ("100ms", 100_000_000),
        ("1e-3 s", 1_000_000),
        (".5 us", 500),
        ("3 µs", 3000),
        ("2 min", 120_000_000_000),
        (0.1, 100_000_000),
        (5, 5_000_000_000),
        (1e-09, 1),
        ("-2 ms", -2_000_000),
    ],
)
def test_times(written: Any, nanoseconds: int) -> None:
    assert parse_duration(written) == nanoseconds


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("soon", "is not a time; write a number with a unit"),
        (True, "a time is a number with a unit"),
        (None, "a time is a number with a unit"),
        (float("nan"), "is not a time"),
        ("5 years", "unknown unit of time 'years'; one of ns, us"),
        ("0.5 ns", "finer than a nanosecond"),
        ("1e9 h", "longer than a hundred years"),
        ("1e9999 s", "is not a time"),
    ],
)
def test_what_is_no_time(written: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_duration(written)


@given(st.integers(-(10**18), 10**18))
def test_a_formatted_time_reads_back_exactly(nanoseconds: int) -> None:
    assert parse_duration(format_duration(nanoseconds)) == nanoseconds


@pytest.mark.parametrize(
    ("nanoseconds", "text"), [(10**8, "100 ms"), (1_500_000_000, "1.5 s"), (0, "0 s"), (7, "7 ns")]
)
def test_times_are_written_as_people_do(nanoseconds: int, text: str) -> None:
    assert format_duration(nanoseconds) == text


def test_a_range_is_one_time_or_two() -> None:
    assert Quantities.model_validate({"delay": "20 ms"}).delay == (20_000_000, 20_000_000)
    assert Quantities.model_validate({"delay": ["10 ms", 0.03]}).delay == (10_000_000, 30_000_000)


@pytest.mark.parametrize(
    ("field", "written", "message"),
    [
        ("wait", "-1 ms", "-1 ms is negative; it must be 0 or more"),
        ("period", 0, "0 s is too short; it must be more than 0"),
        ("delay", ["30 ms", "10 ms"], "the lowest, 30 ms, is more than the highest, 10 ms; write [10 ms, 30 ms]"),
        ("delay", ["10 ms"], 'write one time, such as "20 ms", or the lowest and the highest, such as [10 ms, 30 ms]'),
        ("delay", ["-10 ms", "10 ms"], "-10 ms is negative"),
        ("delay", "-10 ms", "-10 ms is negative"),
        ("loss", "two", "'two' is no probability; write a number from 0 to 1, or such as \"2 %\""),
        ("loss", 2, "2 is no probability: it must be from 0 to 1"),
        ("loss", float("nan"), "nan is no probability"),
        ("loss", [], "a probability is a number from 0 to 1"),
    ],
)
def test_mistakes_get_a_sentence(field: str, written: Any, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Quantities.model_validate({field: written})
    (error,) = caught.value.errors()
    assert error["loc"] == (field,)
    assert message in error["msg"]


@pytest.mark.parametrize(
    ("written", "probability"), [("2 %", 0.02), ("100%", 1.0), (0.5, 0.5), ("0.25", 0.25), (0, 0.0)]
)
def test_probabilities(written: Any, probability: float) -> None:
    assert parse_probability(written) == probability


def test_json_mode_gives_what_reads_back_alike() -> None:
    quantities = Quantities.model_validate({"wait": "3 ms", "period": "1 h", "delay": ["1 us", "2 us"], "loss": "3 %"})
    dumped = quantities.model_dump(mode="json")
    assert dumped == {"wait": "3 ms", "period": "3600 s", "delay": ["1 us", "2 us"], "loss": 0.03}
    assert Quantities.model_validate(dumped) == quantities
    fixed = Quantities.model_validate({"delay": "20 ms"}).model_dump(mode="json")
    assert fixed["delay"] == "20 ms"


@given(st.floats(0.0, 8e6))
def test_the_first_nanosecond_that_is_not_before_a_time(seconds: float) -> None:
    nanoseconds = first_nanosecond(seconds)
    assert to_seconds(nanoseconds - 1) < seconds <= to_seconds(nanoseconds)
