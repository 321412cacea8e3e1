"""A component under the names that the rest of its agent uses: `inputs` and `outputs` of a scenario, resolved."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.components.component import Description, Element, Variable
from cosim.components.presented import ELEMENT, element_of, elements_of, in_unit_of, scaled
from cosim.components.units import BASE, Measure, Scale, measure
from cosim.errors import Location, suggest
from cosim.planning.ports import a_or_an
from cosim.planning.problems import Problems
from cosim.planning.starts import FLOATS, NUMERIC
from cosim.scenario.mapped import Scaled, ScaledInput
from cosim.scenario.source import Node
from cosim.scenario.spec import ComponentSpec

_READABLE = ("output", "local", "calculatedParameter", "parameter", "independent")


@dataclass(frozen=True)
class Mapped:
    """A component as the rest of its agent sees it.

    Attributes:
        description: with the names that the scenario gives; `own` is the component's own.
        instead: for own variables that can no longer be named, the name that stands for each.
        broken: names that the scenario gives to something that is not there; it has been reported.
    """

    description: Description
    instead: Mapping[str, str]
    broken: frozenset[str]


def map_names(own: Description, spec: ComponentSpec, node: Node, problems: Problems) -> Mapped:
    """The component under the names of its scenario.

    Args:
        own: the component's own description.
        spec: the component.
        node: where it was written.
        problems: where mistakes go.
    """
    if not spec.inputs and not spec.outputs:
        return Mapped(own, {}, frozenset())
    return _Mapping(own, spec, node, problems).result()


@dataclass(frozen=True)
class _Taken:
    """Elements behind a name: nested as they are written.

    Attributes:
        own: per element, the own variable and the flat index in it, as they count for what is taken already.
    """

    shape: tuple[int, ...]
    variables: tuple[Variable, ...]
    own: tuple[tuple[str, int], ...]


class _Mapping:
    def __init__(self, own: Description, spec: ComponentSpec, node: Node, problems: Problems) -> None:
        self._own = own
        self._spec = spec
        self._node = node
        self._problems = problems
        self._fed: dict[tuple[str, int], Location] = {}
        self._behind: dict[str, tuple[tuple[str, int], ...]] = {}
        self._broken: set[str] = set()

    def result(self) -> Mapped:
        named: dict[str, Variable] = {}
        for kind, causality in (("inputs", "input"), ("outputs", "output")):
            for name, written in getattr(self._spec, kind).items():
                where = self._node.locate(kind, name, key=True)
                if kind == "outputs" and name in self._spec.inputs:
                    self._problems.error(f"{name!r} is an input already; an output needs another name", where)
                    continue
                node = self._node.find(kind, name) or self._node
                taken = self._resolve(written, node, causality)
                variable = self._together(name, causality, taken, where) if taken else None
                if taken is None or variable is None:
                    self._broken.add(name)
                else:
                    named[name] = variable
                    self._behind[name] = taken.own
        self._check_shadows(named)
        return self._present(named)

    # --- one name -----------------------------------------------------------------------------------------------------
    def _resolve(self, written: Any, node: Node, causality: str) -> _Taken | None:
        """What was written behind a name; None, and problems, if some of it is not there."""
        if isinstance(written, str):
            return self._find(written, node.where, causality)
        if isinstance(written, list):
            parts = [self._resolve(part, node.child(i) or node, causality) for i, part in enumerate(written)]
            return self._joined([part for part in parts if part], written, node) if all(parts) else None
        key = "to" if isinstance(written, ScaledInput) else "from"
        inner = written.to if isinstance(written, ScaledInput) else written.from_
        taken = self._resolve(inner, node.child(key) or node, causality)
        return self._scaled(taken, written, node) if taken else None

    def _joined(self, parts: list[_Taken], written: list[Any], node: Node) -> _Taken | None:
        """Rows of equal length make a matrix; everything else is put one after the other."""
        size = sum(len(part.variables) for part in parts)
        shape: tuple[int, ...] = (size,)
        if any(isinstance(part, list) for part in written):
            shapes = {part.shape for part in parts}
            if len(shapes) > 1 or not all(isinstance(part, list) for part in written):
                self._problems.error("the rows of this list are of different lengths", node.where)
                return None
            shape = (len(parts), *shapes.pop())
        return _Taken(shape, tuple(v for part in parts for v in part.variables), tuple(x for p in parts for x in p.own))

    def _find(self, text: str, where: Location, causality: str) -> _Taken | None:
        """An own variable, or an element of one."""
        variables = self._own.variables
        variable, indices = variables.get(text), None
        if variable is None and (match := ELEMENT.fullmatch(text)) and match["name"] in variables:
            variable, indices = variables[match["name"]], tuple(int(i) for i in match["indices"].split(","))
        if variable is None:
            usable = [v.name for v in variables.values() if _usable(v, causality)]
            self._problems.error(f"the component has no variable {text!r}{suggest(text, usable)}", where)
            return None
        if not _usable(variable, causality):
            what = a_or_an(variable.causality) if variable.dtype in NUMERIC else f"of type {variable.dtype}"
            takes = "an input" if causality == "input" else "something that can be read"
            self._problems.error(f"{text!r} is {what}, not {takes}", where)
            return None
        if indices is None:
            positions, shape = list(range(variable.size)), variable.shape
        elif len(indices) == len(variable.shape) and all(
            1 <= i <= n for i, n in zip(indices, variable.shape, strict=True)
        ):
            positions, shape = [int(np.ravel_multi_index([i - 1 for i in indices], variable.shape))], ()
        else:
            sizes = " x ".join(map(str, variable.shape))
            has = f"has {sizes} elements, counted from 1" if sizes else "is one number"
            self._problems.error(f"{variable.name!r} {has}; there is no {text!r}", where)
            return None
        whole = len(positions) == variable.size
        elements = elements_of(variable) if whole else (element_of(variable, positions[0]),)
        own = tuple((variable.name, i) for i in positions)
        if causality == "input" and not self._take(own, text, where):
            return None
        return _Taken(shape, tuple(_alone(variable, element, positions[i]) for i, element in enumerate(elements)), own)

    def _take(self, own: Iterable[tuple[str, int]], text: str, where: Location) -> bool:
        """Note that these inputs are mapped; a problem if they are already."""
        first = next((self._fed[x] for x in own if x in self._fed), None)
        if first is not None:
            self._problems.error(f"{text!r} is mapped twice, first {first.short}", where)
            return False
        self._fed.update(dict.fromkeys(own, where))
        return True

    def _scaled(self, taken: _Taken, written: Scaled, node: Node) -> _Taken | None:
        """Elements through a gain and an offset, or in another unit."""
        wanted = Variable("", "", "", "", unit=written.unit, measure=self._measure(written.unit))
        variables = []
        for variable in taken.variables:
            if written.gain is not None or written.offset is not None:
                if variable.dtype in ("Boolean", "Enumeration"):
                    text = f"{variable.name!r} is of type {variable.dtype}; it has no gain and no offset"
                    self._problems.error(text, node.where)
                    return None
                gain = 1.0 if written.gain is None else written.gain
                variables.append(scaled(variable, Scale(gain, written.offset or 0.0), wanted))
            elif written.unit is None:
                variables.append(variable)
            elif variable.measure is not None and wanted.measure is None:
                text = f"the unit {written.unit!r} means nothing here; write it as in 'N.m', 'deg/s' or 'kg.m2'"
                self._problems.error(text, node.locate("unit"))
                return None
            elif (converted := in_unit_of(variable, wanted)) is None:
                self._problems.error(
                    f"{variable.name!r} is in {in_words(variable)}, which does not convert to {in_words(wanted)}; "
                    "with a 'gain', 'unit' says what results",
                    node.locate("unit"),
                )
                return None
            else:
                meant = wanted.measure
                if meant is not None and variable.measure is not None:
                    meant = replace(meant, relative=variable.measure.relative)
                variables.append(replace(converted, unit=wanted.unit, measure=meant))
        return replace(taken, variables=tuple(variables))

    def _measure(self, unit: str | None) -> Measure | None:
        """As the component defines the unit, else as it is written."""
        of_own = (v.measure for v in self._own.variables.values() if v.unit == unit and v.measure is not None)
        found = next(of_own, None) or measure(unit)
        return None if found is None else replace(found, relative=False)

    def _together(self, name: str, causality: str, taken: _Taken, where: Location) -> Variable | None:
        """The variable that stands for the elements."""
        first = taken.variables[0]
        same = [in_unit_of(variable, first) for variable in taken.variables]
        variables = [variable for variable in same if variable is not None]
        if len(variables) < len(same):  # such as a vector of positions and velocities
            variables = [replace(variable, unit=None, measure=None) for variable in taken.variables]
            first = variables[0]
        kinds = {_kind(variable): variable for variable in variables}
        if len(kinds) > 1 and not all(variable.dtype in FLOATS for variable in variables):
            one, two = list(kinds.values())[:2]
            text = f"{one.name!r} is of type {one.dtype}, {two.name!r} of type {two.dtype}"
            self._problems.error(f"{name!r} mixes types: {text}", where)
            return None
        known = len({variable.unit for variable in variables}) == 1 or all(v.measure is not None for v in variables)
        starts = [variable.start for variable in variables]
        dependencies = [variable.dependencies for variable in variables]
        return replace(
            first,
            name=name,
            causality=causality,
            dtype=first.dtype if len(kinds) == 1 else "Float64",
            variability="continuous" if any(v.variability == "continuous" for v in variables) else first.variability,
            shape=taken.shape,
            references=(),
            unit=first.unit if known else None,
            measure=first.measure if known else None,
            start=None if None in starts else tuple(start[0] for start in starts if start),
            description=first.description if len({v.description for v in variables}) == 1 else "",
            dependencies=None if None in dependencies else tuple(x for some in dependencies if some for x in some),
            initial="calculated" if any(v.initial == "calculated" for v in variables) else first.initial,
            derivative_of=None,
            limits=(),  # those of the component's own variables count
            elements=tuple(element for variable in variables for element in elements_of(variable)),
        )

    # --- all of them --------------------------------------------------------------------------------------------------
    def _check_shadows(self, named: Mapping[str, Variable]) -> None:
        """A name may not hide an input or an output of the component's own that is still there."""
        taken = self._taken()
        for name, variable in named.items():
            own = self._own.variables.get(name)
            behind = {variable for variable, _ in self._behind[name]}
            if own is not None and own.causality in ("input", "output") and own.name not in {*taken, *behind}:
                kind = f"{variable.causality}s"
                self._problems.error(
                    f"the component has an {own.causality} {name!r} of its own; map that under another name as well",
                    self._node.locate(kind, name, key=True),
                )

    def _taken(self) -> dict[str, str]:
        """Own inputs and outputs that other names stand for as a whole, and one of these names."""
        names: dict[str, str] = {}
        counts: dict[str, set[int]] = {}
        for name, own in self._behind.items():
            for variable, index in own:
                names.setdefault(variable, name)
                counts.setdefault(variable, set()).add(index)
        return {own: name for own, name in names.items() if len(counts[own]) == self._own.variables[own].size}

    def _present(self, named: Mapping[str, Variable]) -> Mapped:
        instead = self._taken()
        given = {own for own, _ in self._fed}
        variables = dict(named)
        for own in self._own.variables.values():
            if own.name in instead or own.name in named:
                continue
            held = own.causality == "input" and own.name in given  # in part: the rest keeps its start value
            variables[own.name] = replace(own, causality="local") if held else own
        names: dict[str, list[str]] = {}
        for name in self._spec.inputs:
            for own_name, _ in self._behind.get(name, ()):
                names.setdefault(own_name, []).append(name)
        renamed = {name: _renamed(variable, names) for name, variable in variables.items()}
        description = replace(self._own, variables=renamed, own=self._own)
        return Mapped(description, instead, frozenset(self._broken))


def in_words(variable: Variable) -> str:
    """A unit, and what it is in base units where that says more."""
    if variable.unit is None:
        return "no unit"
    plain = set(re.findall("[^\\W\\d]+", variable.unit)) <= set(BASE)
    return variable.unit if plain or variable.measure is None else f"{variable.unit} ({variable.measure})"


def _usable(variable: Variable, causality: str) -> bool:
    fits = variable.causality == "input" if causality == "input" else variable.causality in _READABLE
    return fits and variable.dtype in NUMERIC


def _alone(variable: Variable, element: Element, index: int) -> Variable:
    """One element as a scalar."""
    return replace(
        variable,
        shape=(),
        references=(),
        start=None if variable.start is None else (variable.start[index],),
        initial=variable.initials[index] if variable.initials else variable.initial,
        initials=(),
        elements=(element,),
    )


def _kind(variable: Variable) -> tuple[Any, ...]:
    return variable.dtype, tuple(variable.items.items())


def _renamed(variable: Variable, names: Mapping[str, list[str]]) -> Variable:
    """Direct dependencies under the names that stand for the component's own inputs."""
    if variable.dependencies is None or not names:
        return variable
    found = (name for own in variable.dependencies for name in names.get(own, [own]))
    return replace(variable, dependencies=tuple(dict.fromkeys(found)))
