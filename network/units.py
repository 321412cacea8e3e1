"""Quantities as users write them: `100 ms`, `2 %`. Time becomes an integer number of nanoseconds.

Every type here is an annotated pydantic type, so that a spec or a channel model that uses it gets parsing, the error
message, the JSON schema and (in JSON mode) the way back to what users write at once.
"""

from __future__ import annotations

import math
import re
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, PlainSerializer, WithJsonSchema

NANOSECONDS_PER_SECOND = 1_000_000_000

_TIME_UNITS = {"ns": 1, "us": 10**3, "µs": 10**3, "ms": 10**6, "s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9}
_RATE_UNITS = {"": 1.0, "bit": 1.0, "kbit": 1e3, "Mbit": 1e6, "Gbit": 1e9}
_SIZE_UNITS = {"": 1, "B": 1, "kB": 1000, "MB": 10**6}
_LARGEST = 10**9  # bytes
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*([^\s\d]*)\s*")
_LONGEST = 100 * 365 * 24 * 3600 * NANOSECONDS_PER_SECOND  # the sum of two such times still fits 64 bits


def to_seconds(nanoseconds: int) -> float:
    """Seconds as the nearest float: the one conversion used at the FMU boundary and in what people read."""
    return nanoseconds / NANOSECONDS_PER_SECOND


def first_nanosecond(seconds: float) -> int:
    """The first whole nanosecond that, in seconds, is not before a time: one of rounding could be, and what waits for
    that time would not see it come.
    """
    nanoseconds = math.floor(seconds * NANOSECONDS_PER_SECOND) - 2
    while to_seconds(nanoseconds) < seconds:
        nanoseconds += 1
    return nanoseconds


def parse_duration(value: Any) -> int:
    """Nanoseconds from `"100 ms"` or from a plain number of seconds.

    Raises:
        ValueError: not a number with a unit of time, finer than a nanosecond, or longer than a century.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a time is a number with a unit, such as "100 ms" or "0.1 s"')  # noqa: TRY004 - for pydantic
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
    if abs(exact) > _LONGEST:
        raise ValueError(f"{value!r} is longer than a hundred years, more than the clock can count")
    if exact != exact.to_integral_value():
        raise ValueError(f"{value!r} is finer than a nanosecond, the resolution of the clock")
    return int(exact)


def format_duration(nanoseconds: int) -> str:
    """The exact text that `parse_duration` reads back, in the unit that people would choose: `100 ms`, `1.5 s`."""
    unit = next((u for u in ("s", "ms", "us") if abs(nanoseconds) >= _TIME_UNITS[u]), "ns" if nanoseconds else "s")
    number = f"{Decimal(nanoseconds) / _TIME_UNITS[unit]:f}"
    return f"{number} {unit}"


def parse_duration_range(value: Any) -> tuple[int, int]:
    """Nanoseconds (lowest, highest) from one time, or from a list of two.

    Raises:
        ValueError: not a time, not two of them, or the first is the greater.
    """
    if not isinstance(value, (list, tuple)):
        fixed = _not_negative(parse_duration(value))
        return fixed, fixed
    if len(value) != 2:
        raise ValueError('write one time, such as "20 ms", or the lowest and the highest, such as [10 ms, 30 ms]')
    low, high = (_not_negative(parse_duration(item)) for item in value)
    if low > high:
        raise ValueError(
            f"the lowest, {format_duration(low)}, is more than the highest, {format_duration(high)}; "
            f"write [{format_duration(high)}, {format_duration(low)}]"
        )
    return low, high


def parse_probability(value: Any) -> float:
    """A probability from `0.02` or `"2 %"`.

    Raises:
        ValueError: not a number, or outside [0, 1].
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a probability is a number from 0 to 1, or such as "2 %"')  # noqa: TRY004 - for pydantic
    text = str(value).strip()
    percent = text.endswith("%")
    try:
        number = float(text.removesuffix("%"))
    except ValueError:
        raise ValueError(f'{value!r} is no probability; write a number from 0 to 1, or such as "2 %"') from None
    probability = number / 100 if percent else number
    if not 0.0 <= probability <= 1.0:
        raise ValueError(f"{value!r} is no probability: it must be from 0 to 1 (or from 0 % to 100 %)")
    return probability


def parse_bit_rate(value: Any) -> float:
    """Bits per second from `"1 Mbit/s"`, `"9600 bit/s"` or a plain number.

    Raises:
        ValueError: not a positive number with a unit of rate.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a rate is a number with a unit, such as "1 Mbit/s"')  # noqa: TRY004 - for pydantic
    match = _QUANTITY.fullmatch(str(value))
    if match is None:
        raise ValueError(f'{value!r} is not a rate; write a number with a unit, such as "1 Mbit/s"')
    number, unit = match.groups()
    scale = _RATE_UNITS.get(unit.removesuffix("/s").removesuffix("ps"))
    if scale is None:
        raise ValueError(f"unknown unit of rate {unit!r}; one of bit/s, kbit/s, Mbit/s, Gbit/s")
    rate = float(number) * scale
    if rate <= 0:
        raise ValueError(f"{value!r}: a rate must be more than 0")
    return rate


def parse_size(value: Any) -> int:
    """Bytes from `"40 B"`, `"1.5 kB"` or a plain whole number.

    Raises:
        ValueError: not a whole number of bytes.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a size is a number of bytes, such as "40 B"')  # noqa: TRY004 - for pydantic
    match = _QUANTITY.fullmatch(str(value))
    if match is None or match.group(2) not in _SIZE_UNITS:
        raise ValueError(f'{value!r} is not a size; write a number of bytes, such as "40 B" or "1.5 kB"')
    size = Decimal(match.group(1)) * _SIZE_UNITS[match.group(2)]
    if size != size.to_integral_value() or abs(size) > _LARGEST:
        raise ValueError(f"{value!r} is not a whole number of bytes, or is more than a gigabyte")
    return int(size)


def _format_rate(rate: float) -> str:
    unit = next((unit for unit in ("Gbit", "Mbit", "kbit") if rate >= _RATE_UNITS[unit]), "bit")
    text = f"{rate / _RATE_UNITS[unit]:.12g} {unit}/s"
    return text if parse_bit_rate(text) == rate else f"{rate!r} bit/s"


def _format_size(size: int) -> str:
    return f"{size} B"


def _not_negative(nanoseconds: int) -> int:
    if nanoseconds < 0:
        raise ValueError(f"{format_duration(nanoseconds)} is negative; it must be 0 or more")
    return nanoseconds


def _positive(nanoseconds: int) -> int:
    if nanoseconds <= 0:
        raise ValueError(f"{format_duration(nanoseconds)} is too short; it must be more than 0")
    return nanoseconds


def _format_range(durations: tuple[int, int]) -> str | list[str]:
    low, high = durations
    return format_duration(low) if low == high else [format_duration(low), format_duration(high)]


_TIME_SCHEMA: dict[str, Any] = {
    "oneOf": [
        {"type": "number", "description": "seconds"},
        {"type": "string", "pattern": r"^\s*[+-]?[0-9.]+([eE][+-]?[0-9]+)?\s*(ns|us|µs|ms|s|min|h)?\s*$"},
    ]
}
_RANGE_SCHEMA: dict[str, Any] = {
    "oneOf": [*_TIME_SCHEMA["oneOf"], {"type": "array", "items": _TIME_SCHEMA, "minItems": 2, "maxItems": 2}]
}
_AS_WRITTEN = PlainSerializer(format_duration, return_type=str, when_used="json")

Duration = Annotated[
    int, BeforeValidator(parse_duration), AfterValidator(_not_negative), WithJsonSchema(_TIME_SCHEMA), _AS_WRITTEN
]
"""Nanoseconds, at least 0."""

PositiveDuration = Annotated[
    int, BeforeValidator(parse_duration), AfterValidator(_positive), WithJsonSchema(_TIME_SCHEMA), _AS_WRITTEN
]
"""Nanoseconds, more than 0."""

DurationRange = Annotated[
    tuple[int, int],
    BeforeValidator(parse_duration_range),
    WithJsonSchema(_RANGE_SCHEMA),
    PlainSerializer(_format_range, when_used="json"),
]
"""Nanoseconds (lowest, highest), each at least 0; one time stands for both."""

Probability = Annotated[
    float,
    BeforeValidator(parse_probability),
    WithJsonSchema(
        {"oneOf": [{"type": "number", "minimum": 0, "maximum": 1}, {"type": "string", "pattern": r"%\s*$"}]}
    ),
]

BitRate = Annotated[
    float,
    BeforeValidator(parse_bit_rate),
    WithJsonSchema(
        {
            "oneOf": [
                {"type": "number", "description": "bits per second"},
                {"type": "string", "pattern": r"^\s*[0-9.]+([eE][+-]?[0-9]+)?\s*[kMG]?bit(/s|ps)?\s*$"},
            ]
        }
    ),
    PlainSerializer(_format_rate, return_type=str, when_used="json"),
]
"""Bits per second, more than 0."""

Size = Annotated[
    int,
    BeforeValidator(parse_size),
    WithJsonSchema({"oneOf": [{"type": "integer"}, {"type": "string", "pattern": r"^\s*[+-]?[0-9.]+\s*[kM]?B?\s*$"}]}),
    PlainSerializer(_format_size, return_type=str, when_used="json"),
]
"""Bytes."""
