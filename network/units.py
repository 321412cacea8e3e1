"""Quantities as users write them: `100 ms`, `2 %`. Time becomes an integer number of nanoseconds.

Every type here is an annotated pydantic type, so that a spec or a channel model that uses it gets parsing, the error
message and the JSON schema at once.
"""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema

NANOSECONDS_PER_SECOND = 1_000_000_000

_TIME_UNITS = {"ns": 1, "us": 10**3, "µs": 10**3, "ms": 10**6, "s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9}
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\s\d]*)\s*")


def to_seconds(nanoseconds: int) -> float:
    """Seconds as the nearest float: the one conversion used at the FMU boundary and in what people read."""
    return nanoseconds / NANOSECONDS_PER_SECOND


def parse_duration(value: Any) -> int:
    """Nanoseconds from `"100 ms"` or from a plain number of seconds.

    Raises:
        ValueError: not a number with a unit of time, or finer than a nanosecond.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a time is a number with a unit, such as "100 ms" or "0.1 s"')
    match = _QUANTITY.fullmatch(str(value))
    if match is None:
        raise ValueError(f'{value!r} is not a time; write a number with a unit, such as "100 ms" or "0.1 s"')
    number, unit = match.groups()
    if unit not in ("", *_TIME_UNITS):
        raise ValueError(f"unknown unit of time {unit!r}; one of {', '.join(_TIME_UNITS)}")
    try:
        exact = Decimal(number) * _TIME_UNITS[unit or "s"]
    except InvalidOperation:  # pragma: no cover - the pattern admits only decimals
        raise ValueError(f"{value!r} is not a number") from None
    if exact != exact.to_integral_value():
        raise ValueError(f"{value!r} is finer than a nanosecond, the resolution of the clock")
    return int(exact)


def parse_probability(value: Any) -> float:
    """A probability from `0.02` or `"2 %"`.

    Raises:
        ValueError: not a number, or outside [0, 1].
    """
    if isinstance(value, str) and value.strip().endswith("%"):
        probability = float(value.strip()[:-1]) / 100
    elif isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a probability is a number from 0 to 1, or a percentage such as "2 %"')
    else:
        probability = float(value)
    if not 0.0 <= probability <= 1.0:
        raise ValueError(f"{value!r} is no probability: it must be from 0 to 1 (or from 0 % to 100 %)")
    return probability


_TIME_SCHEMA = {
    "oneOf": [
        {"type": "number", "description": "seconds"},
        {"type": "string", "pattern": r"^\s*[+-]?[0-9.]+([eE][+-]?[0-9]+)?\s*(ns|us|µs|ms|s|min|h)?\s*$"},
    ]
}

Duration = Annotated[int, BeforeValidator(parse_duration), Field(ge=0), WithJsonSchema(_TIME_SCHEMA)]
"""Nanoseconds, at least 0."""

PositiveDuration = Annotated[int, BeforeValidator(parse_duration), Field(gt=0), WithJsonSchema(_TIME_SCHEMA)]
"""Nanoseconds, more than 0."""

Probability = Annotated[
    float,
    BeforeValidator(parse_probability),
    WithJsonSchema({"oneOf": [{"type": "number", "minimum": 0, "maximum": 1}, {"type": "string", "pattern": "%$"}]}),
]
