"""Variables under the names, sizes and units that the rest of an agent uses, and the own ones that they stand for."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Element, Floats, Value, Variable
from cosim.components.units import IDENTITY, Scale, conversion

ELEMENT = re.compile(r"(?P<name>.+)\[(?P<indices>\d+(?:, ?\d+)*)\]")
"""An element of an array, counted from 1, as FMI 2.0 and scenarios write it."""


def find(variables: Mapping[str, Variable], name: str) -> Variable | None:
    """The variable of that name, or the element of a flattened FMI 2.0 array, which has a name of its own there."""
    match = ELEMENT.fullmatch(name)
    if name in variables or match is None:
        return variables.get(name)
    array = variables.get(match["name"])
    if array is None or not is_flattened(array):
        return None
    indices = tuple(int(i) - 1 for i in match["indices"].split(","))
    if len(indices) != len(array.shape) or not all(0 <= i < n for i, n in zip(indices, array.shape, strict=True)):
        return None
    return _scalar(array, int(np.ravel_multi_index(indices, array.shape)))


def is_flattened(variable: Variable) -> bool:
    """Whether it is an array of FMI 2.0, made of scalars."""
    return bool(variable.shape) and variable.elements is None and len(variable.references) == variable.size > 0


def elements_of(variable: Variable) -> tuple[Element, ...]:
    """The numbers of a component's own variables that a variable stands for; its own, unless it is mapped."""
    if variable.elements is not None:
        return variable.elements
    return tuple(Element(variable, i) for i in range(variable.size))


def read_back(variable: Variable) -> tuple[Element, ...]:
    """The same, with scales from what the component has to what its agent sees: an input's go the other way."""
    elements = elements_of(variable)
    if variable.causality != "input":
        return elements
    return tuple(replace(element, scale=element.scale.inverse()) for element in elements)


def element_of(variable: Variable, index: int) -> Element:
    """One number of an own variable; of a flattened FMI 2.0 array, the scalar that it is."""
    return Element(_scalar(variable, index)) if is_flattened(variable) else Element(variable, index)


def _scalar(variable: Variable, index: int) -> Variable:
    """One element of a flattened array, under its own name."""
    place = np.unravel_index(index, variable.shape)
    return replace(
        variable,
        name=f"{variable.name}[{','.join(str(int(i) + 1) for i in place)}]",
        shape=(),
        references=(variable.references[index],),
        start=None if variable.start is None else (variable.start[index],),
        initial=variable.initials[index] if variable.initials else variable.initial,
        initials=(),
        limits=variable.limits[index : index + 1] if len(variable.limits) > 1 else variable.limits,
    )


def in_unit_of(variable: Variable, other: Variable) -> Variable | None:
    """A variable with values in the unit of another one, where both units are known and differ in more than their name;
    the variable itself where nothing is to be converted; None where they measure different things.
    """
    if variable.unit == other.unit or variable.measure is None or other.measure is None:
        return variable
    into = variable.causality == "input"
    scale = conversion(other.measure, variable.measure) if into else conversion(variable.measure, other.measure)
    if scale is None:
        return None
    if scale == IDENTITY:
        return variable
    return scaled(variable, scale, replace(other, measure=replace(other.measure, relative=variable.measure.relative)))


def scaled(variable: Variable, scale: Scale, unit_of: Variable) -> Variable:
    """A variable whose values pass through another scale: on their way in the first one, on their way out the last."""
    into = variable.causality == "input"
    start = variable.start
    return replace(
        variable,
        unit=unit_of.unit,
        measure=unit_of.measure,
        dtype=variable.dtype if variable.dtype == "Float32" else "Float64",
        start=None if start is None else tuple((scale.inverse() if into else scale)(float(x)) for x in start),
        references=(),
        elements=tuple(
            replace(element, scale=element.scale.after(scale) if into else scale.after(element.scale))
            for element in elements_of(variable)
        ),
    )


# --- what moves between a component and the signals ------------------------------------------------------------------


class Scales(NamedTuple):
    """What each of several numbers is multiplied by, and what is then added to it; both (size,)."""

    gains: Floats
    offsets: Floats

    def __call__(self, values: Floats) -> Floats:
        return self.gains * values + self.offsets


@dataclass(frozen=True)
class Piece:
    """One of a component's own variables, whole: those of its numbers that are wanted, and the others.

    Attributes:
        places: (size,) which number of the variable that stands for it each of its numbers is; -1 for none.
        scales: None where no number is scaled.
    """

    own: Variable
    places: NDArray[np.int32]
    scales: Scales | None


def pieces(elements: Sequence[Element]) -> Iterator[Piece]:
    """The own variables behind elements; one that some element repeats comes more than once."""
    rounds: list[dict[str, list[tuple[int, Element]]]] = [{}]
    taken: dict[tuple[str, int], int] = {}
    for place, element in enumerate(elements):
        key = element.variable.name, element.index
        number = taken[key] = taken.get(key, -1) + 1
        if number == len(rounds):
            rounds.append({})
        rounds[number].setdefault(element.variable.name, []).append((place, element))
    for by_name in rounds:
        for found in by_name.values():
            yield _piece(found)


def _piece(found: Sequence[tuple[int, Element]]) -> Piece:
    own = found[0][1].variable
    places = np.full(own.size, -1, np.int32)
    scales = Scales(np.ones(own.size), np.zeros(own.size))
    for place, element in found:
        places[element.index] = place
        scales.gains[element.index], scales.offsets[element.index] = element.scale
    plain = all(element.scale == IDENTITY for _, element in found)
    return Piece(own, places, None if plain else scales)


# --- start values -----------------------------------------------------------------------------------------------------


def own_starts(
    variables: Mapping[str, Variable], start: Mapping[str, tuple[Value, ...]]
) -> Iterable[tuple[Variable, tuple[Value, ...]]]:
    """Start values of a component's own variables, from those of the variables as a scenario names them. Those of an
    array come before those of its elements, which so may differ.

    Args:
        variables: by the names that the scenario uses.
        start: by the same names.
    """
    found: dict[str, tuple[Variable, list[Value]]] = {}
    known = [(variable, values) for name, values in start.items() if (variable := find(variables, name)) is not None]
    for variable, values in sorted(
        known, key=lambda item: (item[0].elements is not None, item[0].name not in variables)
    ):
        if variable.elements is None:
            found[variable.name] = variable, list(values)
            continue
        for element, value in zip(variable.elements, values, strict=True):
            own = element.variable
            _, whole = found.setdefault(own.name, (own, list(own.start or [0] * own.size)))
            whole[element.index] = own_value(variable, element, value)
    return ((own, tuple(whole)) for own, whole in found.values())


def beginning(variable: Variable, variables: Mapping[str, Variable], start: Mapping[str, tuple[Value, ...]]) -> Floats:
    """What a numeric variable begins with, as its agent sees it: given, or declared by the component, or 0.

    Args:
        variable: of the component, possibly in another unit, or only the first rows of one.
        variables: see `own_starts`.
        start: likewise.

    Returns:
        Shape (variable.size,).
    """
    given = {own.name: values for own, values in own_starts(variables, start)}
    found = np.zeros(variable.size)
    for i, element in enumerate(read_back(variable)):
        values = given.get(element.variable.name, element.variable.start) or ()
        if element.index < len(values):
            found[i] = element.scale(float(values[element.index]))
    return found


def own_value(variable: Variable, element: Element, value: Value) -> Value:
    """The start value of one number of an own variable, from that of the variable which stands for it."""
    if element.scale == IDENTITY:
        return value
    into = variable.causality == "input"
    number = (element.scale if into else element.scale.inverse())(float(value))
    return number if element.variable.dtype.startswith("Float") else round(number)
