"""From the variables of a model description, as FMPy reads them, to the framework's `Variable`s.

FMI 3.0 arrays get their shape from the given structural parameters. FMI 2.0 has no arrays: elements that follow its
naming convention for them (FMI 2.0.5, section 2.2.9: `x[1]`, `x[2]`, row-major `x[1,1]`, `x[1,2]`, …) are gathered.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.components.component import NO_LIMITS, Limits, Value, Variable, check_size
from cosim.components.presented import ELEMENT
from cosim.components.units import BASE, Measure, measure

_FMI2_TYPES = {"Real": "Float64", "Integer": "Int32"}
_STORED_AS = {"Enumeration": "Integer"}


def variables_of(model: Any, structural: Mapping[str, int]) -> dict[str, Variable]:
    """By name, in the file's order; the arrays of FMI 2.0 gathered, each in the place of its first element.

    Args:
        model: FMPy's `ModelDescription`.
        structural: values of FMI 3.0's structural parameters; others keep their start values.

    Raises:
        ValueError: the description of a variable makes no sense.
    """
    return _fmi2_variables(model) if model.fmiMajorVersion == 2 else _fmi3_variables(model, structural)


def _fmi2_variables(model: Any) -> dict[str, Variable]:
    context = _Context(_dependencies(model), _units(model))
    scalars = [
        _variable(v, _FMI2_TYPES.get(v.type, v.type), (), (v.valueReference,), context) for v in model.modelVariables
    ]
    return _rename_dependencies(*_gather(scalars))


def _fmi3_variables(model: Any, structural: Mapping[str, int]) -> dict[str, Variable]:
    context = _Context(_dependencies(model), _units(model))
    return {
        v.name: _variable(v, v.type, fmi3_shape(v, structural), (v.valueReference,), context)
        for v in model.modelVariables
    }


def fmi3_shape(variable: Any, structural: Mapping[str, int]) -> tuple[int, ...]:
    """The shape of an array, with the structural parameters given or else their start values.

    Raises:
        ValueError: it is too large.
    """
    shape = tuple(
        int(structural.get(d.variable.name, d.variable.start)) if d.start is None else d.start
        for d in variable.dimensions
    )
    check_size(variable.name, shape)
    return shape


@dataclass(frozen=True)
class _Context:
    """What other parts of the model description say of its variables."""

    dependencies: Mapping[tuple[str, int], tuple[str, ...]]
    units: Mapping[str, Measure]


def _variable(
    v: Any,
    dtype: str,
    shape: tuple[int, ...],
    references: tuple[int, ...],
    context: _Context,
) -> Variable:
    """A variable.

    Raises:
        ValueError: its description makes no sense; names it.
    """
    try:
        return _read(v, dtype, shape, references, context)
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f'"{v.name}" (line {v.sourceline}): {error}') from error


def _read(v: Any, dtype: str, shape: tuple[int, ...], references: tuple[int, ...], context: _Context) -> Variable:
    declared = v.declaredType
    unit = v.unit or (declared.unit if declared else None)
    relative = v.relativeQuantity or (declared is not None and v.relativeQuantity is None and declared.relativeQuantity)
    return Variable(
        name=v.name,
        causality=v.causality,
        variability=v.variability,
        dtype=dtype,
        shape=shape,
        references=references,
        unit=unit,
        start=_start(v.start, dtype, int(np.prod(shape, dtype=np.int64))),
        description=v.description or "",
        items={item.name: int(item.value) for item in declared.items} if declared and dtype == "Enumeration" else {},
        dependencies=context.dependencies.get(_value_of(v)) if v.causality in ("output", "local") else None,
        initial=v.initial or "",
        limits=_limits(v, dtype),
        measure=_measured(unit, context.units, relative=bool(relative)),
        derivative_of=v.derivative.name if v.derivative is not None else None,
    )


def _units(model: Any) -> dict[str, Measure]:
    """What the model description says of its units."""
    return {
        unit.name: Measure(
            tuple(getattr(unit.baseUnit, base) for base in BASE), unit.baseUnit.factor, unit.baseUnit.offset
        )
        for unit in model.unitDefinitions
        if unit.baseUnit is not None
    }


def _measured(unit: str | None, units: Mapping[str, Measure], *, relative: bool) -> Measure | None:
    """As the model description defines the unit, else as it is written."""
    found = units.get(unit or "") or measure(unit)
    return replace(found, relative=True) if found and relative else found


def _start(written: str | list[str] | None, dtype: str, size: int) -> tuple[Value, ...] | None:
    """Declared start values, flat. Of an array that was resized they are known only if all are equal."""
    if written is None or dtype == "Clock":
        return None
    values: list[Value]
    if dtype in ("String", "Binary"):
        values = [written] if isinstance(written, str) else [*written]
    else:
        values = [_number(word, dtype) for word in str(written).split()]
    if len(values) == size:
        return tuple(values)
    return tuple(values[:1]) * size if len(set(values)) == 1 else None


def _number(text: str, dtype: str) -> Value:
    if dtype == "Boolean":
        return text in ("true", "1")
    return float(text) if dtype.startswith("Float") else int(text)


def _limits(v: Any, dtype: str) -> tuple[Limits, ...]:
    """`min` and `max`, those of the type where the variable has none; empty where neither says anything."""
    number = float if dtype.startswith("Float") else int
    written = [getattr(v, bound) or getattr(v.declaredType, bound, None) for bound in ("min", "max")]
    found: list[float] = []
    for text, none in zip(written, NO_LIMITS, strict=True):
        try:
            found.append(none if text is None else number(text))
        except ValueError:  # the validation says so
            found.append(none)
    limits = found[0], found[1]
    return () if limits == NO_LIMITS else (limits,)


def _dependencies(model: Any) -> dict[tuple[str, int], tuple[str, ...]]:
    """Per output of the model structure, the inputs among its dependencies, where the file says so; a state depends on
    none. By what variables of one value have in common: aliases depend on the same.
    """
    inputs = {_value_of(v): v.name for v in reversed(model.modelVariables) if v.causality == "input"}
    derivatives = (unknown.variable.derivative for unknown in model.derivatives)
    found: dict[tuple[str, int], tuple[str, ...]] = {_value_of(state): () for state in derivatives if state is not None}
    for unknown in model.outputs:
        if unknown.dependencies is not None:
            key = _value_of(unknown.variable)
            names = [inputs[_value_of(known)] for known in unknown.dependencies if _value_of(known) in inputs]
            found[key] = tuple(dict.fromkeys([*found.get(key, ()), *names]))
    return found


def _value_of(v: Any) -> tuple[str, int]:
    """The value that a variable stands for; in FMI 2.0, each type numbers its own."""
    return _STORED_AS.get(v.type, v.type), v.valueReference


# --- the arrays of FMI 2.0 ------------------------------------------------------------------------------------------
def _gather(scalars: Iterable[Variable]) -> tuple[dict[str, Variable], dict[str, str]]:
    """Gather complete arrays; also the array's name for the name of each of its elements."""
    scalars = list(scalars)
    groups: defaultdict[str, dict[tuple[int, ...], Variable]] = defaultdict(dict)
    for scalar in scalars:
        match = ELEMENT.fullmatch(scalar.name)
        if match:
            groups[match["name"]][tuple(int(i) for i in match["indices"].split(","))] = scalar
    taken = {scalar.name for scalar in scalars}
    arrays = {name: _array(name, elements) for name, elements in groups.items() if name not in taken}
    array_of = {e.name: name for name, array in arrays.items() if array is not None for e in groups[name].values()}
    variables: dict[str, Variable] = {}
    for scalar in scalars:
        array = arrays.get(array_of.get(scalar.name, ""))
        gathered = array or scalar
        variables.setdefault(gathered.name, gathered)
    return variables, array_of


def _array(name: str, elements: Mapping[tuple[int, ...], Variable]) -> Variable | None:
    """The array of these elements; None if they are no complete rectangle from 1 on, or not of one kind."""
    ordered = [elements[indices] for indices in sorted(elements)]
    first = ordered[0]
    if len({len(indices) for indices in elements}) != 1 or len({_kind(element) for element in ordered}) != 1:
        return None
    shape = tuple(max(axis) for axis in zip(*elements, strict=True))
    if min(min(indices) for indices in elements) < 1 or len(elements) != np.prod(shape, dtype=np.int64):
        return None
    starts = [element.start for element in ordered]
    initials = tuple(element.initial for element in ordered)
    limits = tuple(element.limits[0] if element.limits else NO_LIMITS for element in ordered)
    dependencies = [element.dependencies for element in ordered]
    return replace(
        first,
        name=name,
        shape=shape,
        references=tuple(element.references[0] for element in ordered),
        start=None if None in starts else tuple(start[0] for start in starts if start),
        dependencies=None if None in dependencies else tuple(x for some in dependencies if some for x in some),
        initial="calculated" if "calculated" in initials else first.initial,
        initials=initials if len(set(initials)) > 1 else (),
        limits=limits if len(set(limits)) > 1 else first.limits,
        derivative_of=_array_differentiated(ordered),
    )


def _array_differentiated(elements: Iterable[Variable]) -> str | None:
    """The array whose derivative an array is, element by element."""
    matches = [ELEMENT.fullmatch(element.derivative_of or "") for element in elements]
    names = {match["name"] if match else None for match in matches}
    return names.pop() if len(names) == 1 else None


def _kind(element: Variable) -> tuple[Any, ...]:
    return element.causality, element.variability, element.dtype, element.unit, tuple(element.items.items())


def _rename_dependencies(variables: dict[str, Variable], array_of: Mapping[str, str]) -> dict[str, Variable]:
    """Dependencies on elements become dependencies on arrays, each once."""
    return {
        name: variable
        if variable.dependencies is None
        else replace(variable, dependencies=tuple(dict.fromkeys(array_of.get(x, x) for x in variable.dependencies)))
        for name, variable in variables.items()
    }
