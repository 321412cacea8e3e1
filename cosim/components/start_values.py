"""Start values as a scenario gives them, in the type of their variable: for FMUs and Python components alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cosim.components.component import Value, Variable
from cosim.errors import suggest


def start_values(variable: Variable, values: Sequence[Value]) -> list[Any]:
    """Start values in the variable's type; those of a `Binary`, given in hexadecimal digits, as bytes.

    Raises:
        ValueError: wrong number or type of values; the message is a predicate ("takes …").
    """
    if len(values) != variable.size:
        raise ValueError(f"takes {variable.size} values, not {len(values)}")
    return [_start_value(variable, value) for value in values]


def _start_value(variable: Variable, value: Value) -> Any:
    if variable.dtype == "String":
        if isinstance(value, str):
            return value
        raise ValueError(f"takes a text, not {value!r}")
    if variable.dtype == "Binary":
        return from_digits(value)
    if variable.dtype == "Boolean":
        if isinstance(value, bool) or value in (0, 1):
            return bool(value)
        raise ValueError(f"takes true or false, not {value!r}")
    if variable.dtype == "Enumeration" and isinstance(value, str):
        if value in variable.items:
            return variable.items[value]
        raise ValueError(f"has no item {value!r}{suggest(value, variable.items)}")
    if isinstance(value, (bool, str)):
        raise ValueError(f"takes a number, not {value!r}")  # noqa: TRY004 - said of a user's value
    if variable.dtype.startswith("Float"):
        return float(value)
    if value != int(value):
        raise ValueError(f"takes a whole number, not {value!r}")
    return int(value)


def from_digits(value: Value) -> bytes:
    """The bytes written in hexadecimal digits, two for each.

    Raises:
        ValueError: it is something else.
    """
    try:
        return bytes.fromhex(value if isinstance(value, str) else "no digits")
    except ValueError:
        raise ValueError(f"takes bytes in hexadecimal digits, in quotes, such as '666f6f', not {value!r}") from None
