"""`cosim ssp import`: a package becomes a scenario of one agent, and a folder with its FMUs beside it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cosim.components.component import Description, Value, Variable
from cosim.components.start_values import start_values
from cosim.components.units import IDENTITY, Measure, Scale, conversion, measure
from cosim.errors import ConfigError, Problem, Severity, suggest
from cosim.scenario.source import Lines, dump
from cosim.ssp.flattening import End, Flat, Setting, Wire, flatten
from cosim.ssp.flattening import Path as Where
from cosim.ssp.package import Package
from cosim.ssp.placing import Placement
from cosim.ssp.structure import Connection, Connector, Reader, Structure
from cosim.ssp.transformations import INTEGERS, REALS, Table
from network.units import NANOSECONDS_PER_SECOND, format_duration

_ELEMENT = re.compile(r"(?P<array>.+)\[(?P<indices>\d+(?:, ?\d+)*)\]")


def import_package(path: Path, out: Path) -> tuple[list[Path], list[Problem]]:
    """Write the scenario of a package, and its FMUs into a folder beside it; the files written, and warnings.

    Raises:
        ConfigError: the package is broken, or holds what is not supported; or a file exists already.
    """
    package = Package(path)
    structure = Reader(package).read()
    flat = flatten(structure.system)
    if not flat.components:
        raise structure.system.node.error(f"system {structure.system.name!r} has no components")
    folder = f"{out.stem}_fmus"
    with Placement(out.parent / folder) as placement:
        for member in dict.fromkeys(component.member for component in flat.components.values()):
            placement.place(member, package.read(member))
        work = _Import(structure, flat, placement.fmus, folder)
        placement.write(out, work.text(path.name).encode())
    return [out, *placement.fmus.values()], work.warnings


class _Import:
    """Builds the scenario, once the FMUs lie where it will find them."""

    def __init__(self, structure: Structure, flat: Flat, files: Mapping[str, Path], folder: str) -> None:
        from cosim.components.fmu import describe

        self._structure = structure
        self._flat = flat
        self._files = files
        self._folder = folder
        self._problems = list(flat.problems)
        self._inputs: dict[str, dict[str, Any]] = {}
        self._outputs: dict[str, dict[str, Any]] = {}
        self._descriptions: dict[tuple[str, ...], Description] = {}
        for path, component in flat.components.items():
            structural = {
                name: number
                for (owner, name), setting in flat.settings.items()
                if owner == path and isinstance(number := self._looked_up(setting)[0], int)
            }
            try:
                self._descriptions[path] = describe(files[component.member], structural)
            except ConfigError as error:
                self._problems += [Problem(problem.message, component.node.where) for problem in error.problems]

    def text(self, source: str) -> str:
        """The scenario.

        Raises:
            ConfigError: everything that is wrong.
        """
        self._raise_if_any()
        connections = [line for wire in self._flat.wires if (line := self._connection(wire)) is not None]
        starts = self._starts()
        record = [self._reference(end, self._outputs) for end in self._flat.outputs.values() if self._variable(end)]
        self._raise_if_any()
        components = {}
        for path in self._order():
            component, name = self._flat.components[path], self._flat.names[path]
            tree: dict[str, Any] = {"fmu": f"{self._folder}/{self._files[component.member].name}"}
            for key, found in (("inputs", self._inputs), ("outputs", self._outputs), ("start", starts)):
                if name in found:
                    tree[key] = found[name]
            components[name] = tree
        name = re.sub(r"[^A-Za-z0-9_-]+", "_", self._structure.system.name).strip("_-") or "system"
        agent: dict[str, Any] = {"components": components, "connections": Lines(connections)}
        if record:
            agent["record"] = Lines(dict.fromkeys(record))
        period, duration, step = map(format_duration, _times(self._duration(), self._structure.step))
        scenario: dict[str, Any] = {"name": name, "period": period, "duration": duration}
        scenario["agents"] = {name: {key: value for key, value in agent.items() if value}}
        method = self._method()
        coupling = {"method": method} if method is not None else {}
        if self._structure.step is not None and method != "joint":
            coupling["step"] = step
        if coupling:
            scenario["coupling"] = coupling
        return "".join(f"# {line}\n" for line in self._preface(source)) + dump(scenario)

    @property
    def warnings(self) -> list[Problem]:
        """What is left out."""
        return [problem for problem in self._problems if problem.severity is Severity.WARNING]

    def _raise_if_any(self) -> None:
        if any(problem.severity is Severity.ERROR for problem in self._problems):
            raise ConfigError(self._problems)

    def _preface(self, source: str) -> Iterator[str]:
        yield f"From {source}. A package has neither a network nor a period: choose the one at which values"
        yield "are recorded and exchanged with others; in between the agent takes micro steps (`coupling: {step: …}`)."
        if self._structure.start:
            yield f"Its experiment begins at {self._structure.start:g} s; here time begins at 0."
        if self._flat.open_inputs:
            yield "Inputs of the system, which `receive:` or `bridge:` can feed:"
            for name, ends in self._flat.open_inputs.items():
                yield f"  {name}: {', '.join(f'{self._flat.names[p]}.{v}' for p, v in ends) or 'leads nowhere'}"

    def _duration(self) -> float:
        stop, start = self._structure.stop, self._structure.start or 0.0
        return stop - start if stop is not None and stop > start else 10.0

    def _method(self) -> str | None:
        """What the package asks for, if all its components ask for the same."""
        asked = {x.implementation for x in self._flat.components.values()} - {"any"}
        return {"ModelExchange": "joint", "CoSimulation": "midpoint"}.get(asked.pop()) if len(asked) == 1 else None

    def _order(self) -> list[Where]:
        """The components, those with direct feedthrough after those that they read, as far as there is no loop: so
        couplings of Co-Simulation keep their order.
        """
        before: dict[Where, set[Where]] = {path: set() for path in self._flat.components}
        for wire in self._flat.wires:
            fed = self._variable(wire.target)
            outputs = [v for v in self._descriptions[wire.target[0]].variables.values() if v.causality == "output"]
            if fed is not None and any(v.dependencies is None or fed.name in v.dependencies for v in outputs):
                before[wire.target[0]].add(wire.source[0])
        left, order = list(before), list[Where]()
        while left:
            following = next((path for path in left if not before[path].intersection(left) - {path}), left[0])
            left.remove(following)
            order.append(following)
        return order

    # --- connections ------------------------------------------------------------------------------------------------
    def _variable(self, end: End) -> Variable | None:
        """The variable, or the array that it is an element of."""
        variables = self._descriptions[end[0]].variables
        element = _ELEMENT.fullmatch(end[1])
        return variables.get(end[1]) or (variables.get(element["array"]) if element else None)

    def _connection(self, wire: Wire) -> str | None:
        found = []
        for end, connection in ((wire.source, wire.through[0]), (wire.target, wire.through[-1])):
            variable = self._variable(end)
            if variable is None:
                known = self._descriptions[end[0]].variables
                fmu = self._flat.components[end[0]].member
                self._problem(f"{fmu} has no variable {end[1]!r}{suggest(end[1], known)}", connection)
                return None
            found.append(variable)
        source = self._reference(wire.source, self._outputs)
        scale = self._scale(wire, *found)
        return f"{source} -> {self._reference(wire.target, self._inputs, scale)}"

    def _scale(self, wire: Wire, source: Variable, target: Variable) -> Scale | None:
        """What must be said of a wire's scaling; None where the units of the FMUs say enough."""
        plain = all(connection.scale is None and not connection.suppressed for connection in wire.through)
        declared = [self._measure(connector) for connector in wire.ends]
        measures = [source.measure or declared[0], *declared[1:-1], target.measure or declared[-1]]
        if plain and None not in (source.measure, target.measure):
            return None
        total, at = IDENTITY, measures[0]
        for connection, following in zip(wire.through, measures[1:], strict=True):
            if at is not None and following is not None and not connection.suppressed:
                converted = conversion(at, following)
                if converted is None:
                    self._problem(f"units that measure different things: {at} and {following}", connection)
                    return None
                total = converted.after(total)
            if connection.scale is not None:
                total = connection.scale.after(total)
            at = following if following is not None or connection.suppressed else at
        return None if plain and total == IDENTITY else total

    def _measure(self, connector: Connector | None) -> Measure | None:
        if connector is None or connector.unit is None:
            return None
        return self._structure.units.get(connector.unit) or measure(connector.unit)

    def _reference(self, end: End, mapped: dict[str, dict[str, Any]], scale: Scale | None = None) -> str:
        """`component.variable`, after what is scaled, local or an element of an array got a name."""
        name, variable, own = self._flat.names[end[0]], end[1], self._variable(end)
        is_element = variable not in self._descriptions[end[0]].variables
        is_offered = mapped is self._inputs or (own is not None and own.causality == "output")
        if not is_element and scale is None and is_offered:
            return f"{name}.{variable}"
        alias = re.sub(r"\W+", "_", variable).strip("_") if is_element else variable
        written: Any = variable
        if scale is not None:
            written = {"to": variable, "gain": scale.gain, "offset": scale.offset}
        mapped.setdefault(name, {})[alias] = written
        return f"{name}.{alias}"

    def _problem(self, message: str, connection: Connection) -> None:
        self._problems.append(Problem(message, connection.node.where))

    # --- start values -----------------------------------------------------------------------------------------------
    def _starts(self) -> dict[str, dict[str, Any]]:
        starts: dict[str, dict[str, Any]] = {}
        for (path, name), setting in self._flat.settings.items():
            variable = self._variable((path, name))
            if variable is None:
                known = self._descriptions[path].variables
                fmu = self._flat.components[path].member
                text = f"{fmu} has no variable {name!r}{suggest(name, known)}; its value is ignored"
                self._problems.append(Problem(text, setting.parameter.node.where, Severity.WARNING))
                continue
            if name in self._inputs.get(self._flat.names[path], {}):
                continue  # it is connected, and so never has this value
            values = self._values(setting, variable)
            own = starts.setdefault(self._flat.names[path], {})
            element = _ELEMENT.fullmatch(name) if variable.name != name else None
            if element is None:
                own[name] = _nested(values, variable.shape)
            else:
                own[variable.name] = _with_element(own.get(variable.name), variable, element["indices"], values[0])
        return starts

    def _values(self, setting: Setting, variable: Variable) -> list[Value]:
        parameter, transformation = setting.parameter, setting.transformation
        if isinstance(transformation, Table):
            return [self._item(x, variable, transformation) for x in self._looked_up(setting, variable.items)]
        unit = setting.units.get(parameter.unit or "") or measure(parameter.unit)
        scale = IDENTITY
        if unit is not None and variable.measure is not None and not setting.suppressed:
            converted = conversion(unit, variable.measure)
            if converted is None:
                text = f"{parameter.name} is in {parameter.unit}, and {variable.name} in {variable.unit}"
                self._problems.append(Problem(text, parameter.node.where))
            scale = converted or IDENTITY
        if transformation is not None:
            scale = transformation.after(scale)
            if parameter.kind not in REALS and not (parameter.kind in INTEGERS and variable.dtype.startswith("Float")):
                text = f"LinearTransformation is for real numbers, and {parameter.name} is {parameter.kind}"
                self._problems.append(Problem(text, parameter.node.where))
                return list(parameter.values)
        if scale == IDENTITY:
            return list(parameter.values)
        return [scale(x) if isinstance(x, (int, float)) else x for x in parameter.values]

    def _looked_up(self, setting: Setting, items: Mapping[str, int] = MappingProxyType({})) -> tuple[Value, ...]:
        try:
            return setting.looked_up(items)
        except ConfigError as error:
            self._problems += [problem for problem in error.problems if problem not in self._problems]
            return setting.parameter.values

    def _item(self, value: Value, variable: Variable, table: Table) -> Value:
        """A value that comes from a table, which the variable must know; that of an enumeration by its name."""
        names = {number: name for name, number in variable.items.items()}
        if variable.dtype == "Enumeration" and not isinstance(value, str) and names:
            if value not in names:
                known = ", ".join(f"{number} ({name})" for number, name in names.items())
                text = f"{variable.name} has no item with the value {value}, only {known}"
                self._problems.append(Problem(text, table.node.where))
            return names.get(int(value), value)
        try:
            start_values(replace(variable, shape=()), [value])
        except ValueError as error:
            self._problems.append(Problem(f"{variable.name} {error}", table.node.where))
        return value


_USUAL_PERIODS_NS = tuple(n * 10**e for e in (6, 5, 4, 3) for n in (10, 5, 2))
"""From 10 ms to 2 us."""


def _times(duration: float, step: float | None) -> tuple[int, int, int]:
    """Period, duration and step in nanoseconds, each a multiple of what follows: 10 ms if that is one, or less.

    A duration that no usual period divides becomes longer by a part of one.
    """
    step_ns = max(round((step or 0.0) * NANOSECONDS_PER_SECOND), 1)
    duration_ns = max(round(duration * NANOSECONDS_PER_SECOND), 1)
    for period_ns in _USUAL_PERIODS_NS:
        if period_ns % step_ns == 0 and duration_ns % period_ns == 0:
            return period_ns, duration_ns, step_ns
    period_ns = max(_USUAL_PERIODS_NS[0] // step_ns, 1) * step_ns
    return period_ns, -(-duration_ns // period_ns) * period_ns, step_ns


def _nested(values: list[Value], shape: tuple[int, ...]) -> Any:
    """As a scenario writes start values: one, or one per element."""
    return values if shape and len(values) > 1 else values[0]


def _with_element(present: Any, variable: Variable, indices: str, value: Value) -> list[Any]:
    """All start values of an array, one of them new."""
    if isinstance(present, list):
        values = list(present)
    else:
        given = variable.start if present is None else (present,) * variable.size
        values = list(given or (0.0,) * variable.size)
    place = 0
    for index, size in zip(indices.split(","), variable.shape, strict=True):
        place = place * size + int(index) - 1
    values[place] = value
    return values
