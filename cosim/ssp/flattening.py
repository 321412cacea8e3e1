"""One system of nested ones: every connection from an FMU's output to an FMU's input, every parameter at its FMU."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from cosim.components.component import Value
from cosim.components.units import Measure, Scale
from cosim.errors import Problem, Severity
from cosim.ssp.parameters import Binding, Entry, Parameter
from cosim.ssp.structure import Component, Connection, Connector, System
from cosim.ssp.transformations import Table

Path = tuple[str, ...]
End = tuple[Path, str]
"""A connector: whose, by the names that lead there, and which."""


@dataclass(frozen=True)
class Wire:
    """From one FMU to another.

    Attributes:
        source, target: variables of components.
        ends: the connectors that the value passes, from the first to the last, as far as they are declared.
        through: the connections between them.
    """

    source: End
    target: End
    ends: Sequence[Connector | None]
    through: Sequence[Connection]


@dataclass(frozen=True)
class Setting:
    """A start value of a variable of an FMU.

    Attributes:
        transformation: on its way, or None.
        suppressed: its unit is not converted.
        units: what the units of its set mean.
    """

    parameter: Parameter
    transformation: Scale | Table | None
    suppressed: bool
    units: Mapping[str, Measure]

    def looked_up(self, items: Mapping[str, int]) -> tuple[Value, ...]:
        """The values of the parameter, after the table on their way, if there is one.

        Args:
            items: of the variable, which say what the names of an enumeration stand for where their set does not.

        Raises:
            ConfigError: the table is none for such values.
        """
        if not isinstance(self.transformation, Table):
            return self.parameter.values
        return self.transformation.apply(self.parameter.values, self.parameter.kind, self.parameter.items or items)


@dataclass
class Flat:
    """A system without systems in it.

    Attributes:
        names: of the components in a scenario, by where they were.
        settings: by component and variable; that which counts.
        outputs: per output of the outermost system, the variable that feeds it.
        open_inputs: per input of the outermost system, the variables that it feeds.
    """

    names: dict[Path, str] = field(default_factory=dict)
    components: dict[Path, Component] = field(default_factory=dict)
    wires: list[Wire] = field(default_factory=list)
    settings: dict[End, Setting] = field(default_factory=dict)
    outputs: dict[str, End] = field(default_factory=dict)
    open_inputs: dict[str, list[End]] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)


def flatten(system: System) -> Flat:
    """All of a system and of those in it."""
    flat = Flat()
    systems: dict[Path, System] = {}
    _collect(system, (), systems, flat)
    incoming: dict[End, tuple[End, Connection]] = {}
    outgoing: dict[End, list[End]] = {}
    for path, each in systems.items():
        for connection in each.connections:
            found = [_end(path, each, name, connection, flat) for name in (connection.start, connection.end)]
            if None in found:
                continue
            start, end = _in_the_direction_of_the_flow([end for end in found if end], path, connection, systems, flat)
            if end in incoming:
                text = f"{'.'.join((*end[0], end[1]))} is connected twice"
                flat.problems.append(Problem(text, connection.node.where))
            incoming[end] = start, connection
            outgoing.setdefault(start, []).append(end)
    for path, component in flat.components.items():
        ends = [end for end in incoming if end[0] == path]
        for end in ends:
            _wire(end, component, incoming, systems, flat)
    _outermost(system, incoming, outgoing, flat)
    for path in sorted(systems, key=len, reverse=True):  # what lies further out counts
        _bind(path, systems[path], incoming, outgoing, systems, flat)
    return flat


def _collect(system: System, path: Path, systems: dict[Path, System], flat: Flat) -> None:
    systems[path] = system
    for name, element in system.elements.items():
        if isinstance(element, System):
            _collect(element, (*path, name), systems, flat)
        else:
            flat.components[*path, name] = element
            flat.names[*path, name] = _free("_".join((*path, name)), flat.names.values())


def _free(text: str, taken: object) -> str:
    """A name that a component of a scenario may have."""
    name = re.sub(r"\W+", "_", text).strip("_") or "component"
    if name[0].isdigit():
        name = f"c{name}"
    number, free = 1, name
    while free in taken:  # type: ignore[operator]
        number += 1
        free = f"{name}_{number}"
    return free


def _end(path: Path, system: System, end: tuple[str | None, str], connection: Connection, flat: Flat) -> End | None:
    element, connector = end
    if element is None:
        if connector not in system.connectors:
            text = f"system {system.name!r} has no connector {connector!r}"
            flat.problems.append(Problem(text, connection.node.where))
            return None
        return path, connector
    if element not in system.elements:
        text = f"system {system.name!r} has no element {element!r}"
        flat.problems.append(Problem(text, connection.node.where))
        return None
    return (*path, element), connector


_GIVES = {"output", "calculatedParameter", "constant", "local"}
_TAKES = {"input", "parameter", "structuralParameter", "inout"}


def _in_the_direction_of_the_flow(
    ends: Sequence[End], path: Path, connection: Connection, systems: Mapping[Path, System], flat: Flat
) -> Sequence[End]:
    """Which of them gives the value: kinds decide, not the words start and end (SSP 2.0, 5.3.4)."""
    gives = [_gives(end, path, systems, flat) for end in ends]
    if gives[0] is not None and gives[0] == gives[1]:
        names, what = [".".join((*end[0], end[1])) for end in ends], "give" if gives[0] else "take"
        text = f"connects {names[0]} and {names[1]}, which both {what} a value"
        flat.problems.append(Problem(text, connection.node.where))
    return ends[::-1] if gives[0] is False or gives[1] is True else ends


def _gives(end: End, path: Path, systems: Mapping[Path, System], flat: Flat) -> bool | None:
    """Whether a connector gives a value to the connections of a system; None where nothing says so."""
    declared = _declared(end, systems, flat)
    if declared is None or declared.kind not in _GIVES | _TAKES:
        return None
    return (declared.kind in _GIVES) is (end[0] != path)  # a system's own input gives to what is inside


def _declared(end: End, systems: Mapping[Path, System], flat: Flat) -> Connector | None:
    owner = systems.get(end[0]) or flat.components[end[0]]
    return owner.connectors.get(end[1])


def _wire(
    target: End,
    component: Component,
    incoming: Mapping[End, tuple[End, Connection]],
    systems: Mapping[Path, System],
    flat: Flat,
) -> None:
    """Follow a component's input back to an output of an FMU, or to an input of the outermost system."""
    kind = component.connectors[target[1]].kind if target[1] in component.connectors else "input"
    ends, end = [_declared(target, systems, flat)], target
    through: list[Connection] = []
    while end in incoming and len(through) <= len(incoming):
        end, connection = incoming[end]
        through.append(connection)
        ends.append(_declared(end, systems, flat))
        if end[0] in flat.components and kind != "input":
            text = f"a connection to the {kind} {'.'.join((*target[0], target[1]))} is not supported; bind its value"
            flat.problems.append(Problem(text, incoming[target][1].node.where))
            return
        if end[0] in flat.components:
            flat.wires.append(Wire(end, target, ends[::-1], through[::-1]))
            return


def _outermost(
    system: System, incoming: Mapping[End, tuple[End, Connection]], outgoing: Mapping[End, list[End]], flat: Flat
) -> None:
    for name, connector in system.connectors.items():
        if connector.kind == "output":
            end: End = ((), name)
            for _ in incoming:
                if end not in incoming or end[0] in flat.components:
                    break
                end = incoming[end][0]
            if end[0] in flat.components:
                flat.outputs[name] = end
        elif connector.kind == "input":
            flat.open_inputs[name] = list(_inner(((), name), outgoing, flat))


def _inner(end: End, outgoing: Mapping[End, list[End]], flat: Flat, depth: int = 0) -> Iterator[End]:
    """The variables of FMUs that a connector of a system leads to."""
    for following in outgoing.get(end, ()):
        if following[0] in flat.components:
            yield following
        elif depth < 100:
            yield from _inner(following, outgoing, flat, depth + 1)


# --- parameters -------------------------------------------------------------------------------------------------------


def _bind(  # noqa: PLR0917
    path: Path,
    system: System,
    incoming: Mapping[End, tuple[End, Connection]],
    outgoing: Mapping[End, list[End]],
    systems: Mapping[Path, System],
    flat: Flat,
) -> None:
    """The bindings of a system's components, then those of the system itself."""
    for name, element in system.elements.items():
        if isinstance(element, Component):
            for binding in element.bindings:
                for variable, setting, _ in _settings(binding):
                    flat.settings[(*path, name), variable] = setting
    for binding in system.bindings:
        for name, setting, entry in _settings(binding):
            targets = list(_targets(path, name, outgoing, systems, flat))
            if not targets and not _knows(path, name, systems):
                node = setting.parameter.node if entry is None else entry.node
                text = f"system {system.name!r} has no parameter {name!r}; it is ignored"
                flat.problems.append(Problem(text, node.where, Severity.WARNING))
            for begin, target in targets:
                flat.settings[target] = setting
                flat.problems += _scaled(begin, target, incoming)


def _scaled(begin: End, target: End, incoming: Mapping[End, tuple[End, Connection]]) -> Iterator[Problem]:
    """The transformations of connections that a value takes from a system's connector to a variable."""
    end = target
    for _ in incoming:
        if end == begin or end not in incoming:
            return
        end, connection = incoming[end]
        if connection.scale is not None:
            name = ".".join((*target[0], target[1]))
            text = f"the value of {name} comes through a LinearTransformation, which is not supported; bind it itself"
            yield Problem(text, connection.node.where)


def _knows(path: Path, name: str, systems: Mapping[Path, System]) -> bool:
    """Whether a hierarchical name is that of a connector of the system or of one in it."""
    inner = [(element, each) for element, each in systems[path].elements.items() if isinstance(each, System)]
    return name in systems[path].connectors or any(
        name.startswith(f"{element}.") and _knows((*path, element), name.removeprefix(f"{element}."), systems)
        for element, _ in inner
    )


def _settings(binding: Binding) -> Iterator[tuple[str, Setting, Entry | None]]:
    """What a binding sets, under which name."""
    named = {binding.prefix + name: parameter for name, parameter in binding.parameters.items()}
    if binding.mapping is None:
        for name, parameter in named.items():
            yield name, Setting(parameter, None, False, binding.units), None
        return
    for entry in binding.mapping:
        if entry.source in named:
            yield entry.target, _mapped(named[entry.source], entry, binding), entry


def _mapped(parameter: Parameter, entry: Entry, binding: Binding) -> Setting:
    return Setting(parameter, entry.transformation, entry.suppressed, binding.units)


def _targets(
    path: Path, name: str, outgoing: Mapping[End, list[End]], systems: Mapping[Path, System], flat: Flat
) -> Iterator[tuple[End, End]]:
    """All variables of FMUs that a hierarchical name stands for in a system (SSP 2.0, 5.3.2), each after the connector
    that leads to it, or after itself.
    """
    system = systems[path]
    if name in system.connectors:
        yield from (((path, name), end) for end in _inner((path, name), outgoing, flat))
    for element, found in system.elements.items():
        if not name.startswith(f"{element}."):
            continue
        rest = name.removeprefix(f"{element}.")
        if isinstance(found, Component):
            yield ((*path, element), rest), ((*path, element), rest)
        else:
            yield from _targets((*path, element), rest, outgoing, systems, flat)
