"""The `min` and `max` that variables declare: the region that a component is made for (FMI 3.0, section 2.4.7.4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from cosim.components.component import NO_LIMITS, Limits, Value, Variable
from cosim.components.presented import element_of, is_flattened


def limits_of(variable: Variable, index: int) -> Limits:
    """Least and largest value of one number of a variable."""
    if not variable.limits:
        return NO_LIMITS
    return variable.limits[index if len(variable.limits) > 1 else 0]


def outside(variable: Variable, index: int, value: Value) -> str:
    """How a start value of one number of a variable breaks its limits, as `above its max, 20`; empty if it does not."""
    low, high = limits_of(variable, index)
    number = variable.items.get(value) if isinstance(value, str) else value
    if number is None or low > high:
        return ""
    if number < low:
        return f"below its min, {_shown(low)}"
    return f"above its max, {_shown(high)}" if number > high else ""


def odd_limits(variables: Mapping[str, Variable]) -> Iterator[str]:
    """Limits that nothing can keep, and declared start values that do not keep theirs; one of each variable."""
    for variable in variables.values():
        for index in range(variable.size if variable.limits else 0):
            name = element_of(variable, index).variable.name if is_flattened(variable) else variable.name
            low, high = limits_of(variable, index)
            if low > high:
                yield f'"{name}" has a min of {_shown(low)}, which is above its max, {_shown(high)}'
                break
            start = variable.start[index] if variable.start else None
            if start is not None and (said := outside(variable, index, start)):
                yield f'"{name}" starts at {_shown(start)}, {said}'
                break


def _shown(number: Value) -> str:
    return f"{number:.9g}" if isinstance(number, float) else str(number)
