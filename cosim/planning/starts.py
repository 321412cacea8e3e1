"""Start values: checked against the variable, filled up to its size, and drawn from the seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

from cosim.components.component import Value, Variable
from cosim.components.presented import element_of
from cosim.components.start_values import from_digits
from cosim.errors import suggest
from cosim.scenario.spec import Normal, Uniform
from network.draws import initial_normal, initial_uniform

Element: TypeAlias = "Value | Uniform | Normal"

_INTEGERS = {f"{sign}Int{bits}": (sign, bits) for sign in ("", "U") for bits in (8, 16, 32, 64)}
FLOATS = frozenset({"Float64", "Float32"})
INTEGERS = frozenset(_INTEGERS)
NUMERIC = FLOATS | INTEGERS | {"Boolean", "Enumeration"}
_SETTABLE = frozenset({"input", "output", "local", "parameter", "structuralParameter"})


def elements(value: Any, variable: Variable) -> tuple[Element, ...]:
    """One element per number of the variable, row-major; a single value fills all of them.

    Raises:
        ValueError: the variable takes no start value, or the value has another size or type.
    """
    if not is_settable(variable):
        kind = "a constant" if variable.variability == "constant" else "computed"
        free = [i for i, initial in enumerate(variable.initials) if initial != "calculated"]
        if free:
            one = element_of(variable, free[0]).variable.name
            raise ValueError(
                f"{variable.name!r} is computed in part, and takes no start value as a whole; {one!r} does"
            )
        raise ValueError(f"{variable.name!r} is {kind}; it takes no start value")
    flat = _flatten(value, variable) if isinstance(value, list) else [value] * variable.size
    if len(flat) != variable.size:
        raise ValueError(f"{variable.name!r} takes {_size(variable)}, not {len(flat)}")
    return tuple(_checked(element, variable) for element in flat)


def is_settable(variable: Variable) -> bool:
    """Whether a variable takes a start value (FMI 3.0, section 2.4.7.5): parameters, inputs, and what is `exact` or
    `approx` at the start; also where an array was given another size than that of the start values declared for it.
    """
    given = variable.causality in ("input", "parameter", "structuralParameter") or variable.initial in (
        "exact",
        "approx",
    )
    computed = variable.initial == "calculated" or (variable.start is None and not given)
    return variable.causality in _SETTABLE and variable.variability != "constant" and not computed


def is_drawn(element: Element) -> bool:
    """Whether it is a distribution, of which each agent gets a number of its own."""
    return isinstance(element, (Uniform, Normal))


def draw(value: Sequence[Element], seed: int, paths: Sequence[str]) -> list[tuple[Value, ...]]:
    """Per path, the elements with every distribution replaced by its draw.

    Args:
        value: one element per number.
        seed: of the run.
        paths: `agent.component.variable`; a draw depends on nothing else, so another agent changes none.
    """
    kinds = {type(element) for element in value}
    nothing: list[list[float]] = [[]] * len(paths)
    uniforms = initial_uniform(seed, paths, len(value)).tolist() if Uniform in kinds else nothing
    normals = initial_normal(seed, paths, len(value)).tolist() if Normal in kinds else nothing
    if uniforms is nothing and normals is nothing:
        return [tuple(_drawn(element, i, [], []) for i, element in enumerate(value))] * len(paths)
    return [
        tuple(_drawn(element, i, uniform, normal) for i, element in enumerate(value))
        for uniform, normal in zip(uniforms, normals, strict=True)
    ]


def _drawn(element: Element, i: int, uniform: Sequence[float], normal: Sequence[float]) -> Value:
    if isinstance(element, Uniform):
        low, high = element.uniform
        return low + (high - low) * uniform[i]
    if isinstance(element, Normal):
        mean, deviation = element.normal
        return mean + deviation * normal[i]
    return element


def _flatten(value: list[Any], variable: Variable) -> list[Any]:
    """A flat list, or one nested as the variable's shape is."""
    if not any(isinstance(inner, list) for inner in value):
        return value
    shape = _shape(value)
    if shape != variable.shape:
        nested = "unevenly nested" if shape is None else f"nested as {_by(shape)}"
        raise ValueError(f"{variable.name!r} takes {_size(variable)}; this list is {nested}")
    while any(isinstance(inner, list) for inner in value):
        value = [element for inner in value for element in inner]
    return value


def _shape(value: Any) -> tuple[int, ...] | None:
    """The shape of a nested list, or None if it is ragged."""
    if not isinstance(value, list):
        return ()
    shapes = {_shape(inner) for inner in value}
    if len(shapes) > 1 or None in shapes:
        return None
    return (len(value), *(shapes.pop() or ())) if shapes else (0,)


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _size(variable: Variable) -> str:
    if not variable.shape:
        return "one value"
    return f"{_by(variable.shape)} values"


def _checked(element: Element, variable: Variable) -> Element:
    """The element in the variable's own type.

    Raises:
        ValueError: it is of another type, or out of that type's range.
    """
    dtype = variable.dtype
    if isinstance(element, (Uniform, Normal)):
        if dtype in FLOATS:
            return element
        raise ValueError(
            f"{variable.name!r} is {_article(dtype)}; only a Float64 or Float32 can be drawn from the seed"
        )
    if dtype in FLOATS and isinstance(element, (int, float)) and not isinstance(element, bool):
        return float(element)
    if dtype in INTEGERS and isinstance(element, int) and not isinstance(element, bool):
        return _in_range(element, variable)
    if dtype == "Boolean" and isinstance(element, bool):
        return element
    if dtype == "String" and isinstance(element, str):
        return element
    if dtype == "Binary":
        try:
            from_digits(element)
        except ValueError as error:
            raise ValueError(f"{variable.name!r} {error}") from None
        return element
    if dtype == "Enumeration" and not isinstance(element, (bool, float)):
        return _item(element, variable)
    raise ValueError(f"{variable.name!r} is {_article(dtype)}; {_shown(element)} is not{_hint(element, dtype)}")


def _in_range(element: int, variable: Variable) -> int:
    sign, bits = _INTEGERS[variable.dtype]
    low, high = (0, 2**bits) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    if not low <= element < high:
        raise ValueError(f"{variable.name!r} is {_article(variable.dtype)}, from {low} to {high - 1}; {element} is not")
    return element


def _item(element: int | str, variable: Variable) -> str:
    """The name of an enumeration's item given by name or number."""
    for name, number in variable.items.items():
        if element in (name, number):
            return name
    raise ValueError(f"{variable.name!r} has no item {element!r}{suggest(str(element), variable.items)}")


def _article(dtype: str) -> str:
    return f"an {dtype}" if dtype[0] in "AEIOU" and not dtype.startswith("U") else f"a {dtype}"


def _shown(element: Value) -> str:
    return str(element).lower() if isinstance(element, bool) else repr(element)


def _hint(element: Value, dtype: str) -> str:
    if dtype == "Boolean":
        return "; write true or false"
    if dtype == "String":
        return "; put it in quotes"
    if dtype in INTEGERS and isinstance(element, float) and element.is_integer():
        return f"; write {int(element)}"
    return ""
