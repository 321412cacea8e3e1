"""What agents that are written alike and hear equally many others have in common: resolved and checked once."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

from cosim.components.component import Description, Interface, Value, Variable
from cosim.components.limits import outside
from cosim.components.presented import elements_of, find, in_unit_of
from cosim.errors import Location, suggest
from cosim.plan import Connection, CouplingPlan, Isolation, Port
from cosim.planning.coupling import choose_coupling
from cosim.planning.describing import Describer, Origin
from cosim.planning.mapping import Mapped, in_words, map_names
from cosim.planning.ports import Ports, a_or_an, numbers, type_mismatch, warn_of_units
from cosim.planning.problems import Problems
from cosim.planning.starts import FLOATS, INTEGERS, NUMERIC, Element, elements, is_drawn, is_settable
from cosim.recording.columns import scalar_names
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import Node
from cosim.scenario.spec import MAILBOX_PORTS, ComponentSpec
from network.units import to_seconds

_CVODE_TOLERANCE = 1e-8


@dataclass(frozen=True)
class Part:
    """One component: where it comes from, what it says of itself, and its start values before anything is drawn."""

    name: str
    origin: Origin
    mapped: Mapped
    start: Mapping[str, tuple[Element, ...]]
    isolation: Isolation | None = None
    cvode: float | None = None

    @property
    def description(self) -> Description:
        """As the rest of the agent sees it."""
        return self.mapped.description


@dataclass(frozen=True)
class Blueprint:
    """Agents alike.

    Attributes:
        entry: how they are written.
        n_neighbours: how many others each of them hears.
        assigned: parameters that are set to that number or to the period, as `component.variable`.
        publish: outputs by the message's variables.
    """

    entry: AgentEntry
    n_neighbours: int
    parts: tuple[Part, ...]
    ports: Ports
    assigned: tuple[str, ...]
    connections: tuple[Connection, ...]
    publish: Mapping[str, Port]
    record: tuple[tuple[str, Port], ...]
    coupling: CouplingPlan | None

    def where(self, *path: str | int, key: bool = False) -> Location:
        """Where a part of these agents was written."""
        return self.entry.node.locate(*path, key=key)


def draw_up(entry: AgentEntry, n_neighbours: int, describer: Describer, period_ns: int) -> Blueprint | None:
    """The blueprint of agents; None, and problems, if one of their components cannot be opened."""
    spec, node, problems = entry.spec, entry.node, describer.problems
    if not spec.components:
        problems.error("an agent without components; give it 'components' or a 'template'", node.key or node.where)
        return None
    names = tuple(spec.components)
    wanted: dict[str, Value] = {"count": n_neighbours, "period": to_seconds(period_ns)}
    assigned = {reference: wanted[key] for key, reference in spec.receive.items() if key in wanted}
    parts = []
    for name, component_spec in spec.components.items():
        at = node.find("components", name) or node
        part = _part(name, component_spec, at, assigned, describer)
        if part is not None:
            parts.append(part)
    ports = Ports(names, {part.name: part.mapped for part in parts}, problems)
    assigned_ports = tuple(_parameters(ports, entry, n_neighbours))
    connections = _connections(ports, entry)
    publish = _publish(ports, entry)
    record = _record(ports, entry)
    _check_columns(record, ports, entry)
    if len(parts) < len(names):
        return None
    readers = {names[x.target.component] for x in connections if x.source.component < x.target.component}
    coupling = choose_coupling(entry, ports.descriptions, readers, period_ns, problems)
    return Blueprint(entry, n_neighbours, tuple(parts), ports, assigned_ports, connections, publish, record, coupling)


def _part(
    name: str, spec: ComponentSpec, node: Node, assigned: Mapping[str, Value], describer: Describer
) -> Part | None:
    """The component written at `node`, described with its structural parameters in place.

    Args:
        name: of the component.
        spec: the component.
        node: where it was written.
        assigned: parameters of this and other components that the framework sets, by `component.variable`.
        describer: opens it.
    """
    where = node.locate("fmu") if spec.fmu is not None else node.locate("python")
    origin = describer.origin(name, spec, node.key or node.where, where)
    description = describer.describe(origin, {}, where) if origin else None
    if origin is None or description is None:
        return None
    if spec.sha256 not in (None, description.sha256):
        describer.problems.error(
            f"{spec.fmu or spec.python} is not the file that is asked for: "
            f"its SHA-256 is {description.sha256}, not {spec.sha256}",
            node.locate("sha256"),
        )
    variables, problems = description.variables, describer.problems
    start = dict(_start_values(spec, node, Mapped(description, {}, frozenset()), problems, structural=True))
    for reference, value in assigned.items():
        component, _, variable = reference.partition(".")
        if component == name and variable in spec.start:
            problems.error(f"'receive' sets {variable!r}; leave it out here", node.locate("start", variable, key=True))
        elif component == name and variable in variables:
            start[variable] = (value,)
    structural = {
        key: value[0]
        for key, value in start.items()
        if variables[key].causality == "structuralParameter" and value and isinstance(value[0], int)
    }
    if structural:
        sized_at = next((node.locate("start", name) for name in structural if name in spec.start), where)
        description = describer.describe(origin, structural, sized_at)
        if description is None:
            return None
    if spec.solver is not None:
        description = _with_solver(name, description, node, problems)
    elif spec.tolerance is not None:
        description = replace(description, tolerance=spec.tolerance)
    mapped = map_names(description, spec, node, problems)
    start.update(_start_values(spec, node, mapped, problems, structural=False))
    _check_complete(start, mapped.description, node, problems)
    cvode = None if spec.solver is None else spec.tolerance or _CVODE_TOLERANCE
    return Part(name, origin, mapped, start, _isolation(spec, node, problems), cvode)


def _with_solver(name: str, description: Description, node: Node, problems: Problems) -> Description:
    """A component that offers Model Exchange, as one of Co-Simulation."""
    if Interface.MODEL_EXCHANGE not in description.interfaces:
        problems.error(
            f"'solver' takes Model Exchange, which {name!r} does not offer; leave it out", node.locate("solver")
        )
    return replace(
        description,
        interfaces=(Interface.CO_SIMULATION,),
        variable_step=True,
        internal_step=None,
        asynchronous=False,
        can_get_and_set_state=False,
    )


def _isolation(spec: ComponentSpec, node: Node, problems: Problems) -> Isolation | None:
    if spec.isolate is None:
        return None
    if os.name == "nt":
        problems.error("'isolate' takes Linux or macOS; leave it out here", node.locate("isolate", key=True))
    return Isolation(spec.isolate.deadline)


def _start_values(
    spec: ComponentSpec, node: Node, mapped: Mapped, problems: Problems, *, structural: bool
) -> Mapping[str, tuple[Element, ...]]:
    """The start values of the structural parameters, or those of all other variables."""
    found = {}
    variables = mapped.description.variables
    for name, value in spec.start.items():
        variable = find(variables, name)
        if variable is None and (structural or name in mapped.broken):
            continue
        if variable is None:
            known = [other.name for other in variables.values() if is_settable(other)]
            hint = f"; it is called {mapped.instead[name]!r} here" if name in mapped.instead else suggest(name, known)
            problems.error(f"no variable {name!r}{hint}", node.locate("start", name, key=True))
        elif (variable.causality == "structuralParameter") is structural:
            try:
                if value_of_each := elements(value, variable):
                    if structural:
                        _check_limits(variable, value_of_each)
                    found[name] = value_of_each
            except ValueError as error:
                problems.error(str(error), node.locate("start", name))
    return found


def _check_limits(variable: Variable, value: Sequence[Element]) -> None:
    """Structural parameters size what the component holds: beyond their limits it need not have room for it.

    Raises:
        ValueError: it lies outside.
    """
    for index, number in enumerate(value):
        if not is_drawn(number) and (said := outside(variable, index, cast(Value, number))):
            raise ValueError(f"{variable.name!r} is {number}, {said}")


def _check_complete(
    start: Mapping[str, tuple[Element, ...]], description: Description, node: Node, problems: Problems
) -> None:
    """A start value of a part of an array needs those of the rest, which are not known once its size was changed."""
    variables = description.variables
    given: dict[str, set[int]] = {}
    for name in start:
        for element in elements_of(variables[name]) if name in variables else ():
            given.setdefault(element.variable.name, set()).add(element.index)
    for name in start:
        for element in (variables[name].elements if name in variables else None) or ():
            own = element.variable
            if own.start is None and len(given[own.name]) < own.size:
                problems.error(
                    f"{name!r} is a part of {own.name!r}, which has {numbers(own.size)}, and nothing says what the "
                    "others start with; give all of them start values",
                    node.locate("start", name),
                )
                break


def _parameters(ports: Ports, entry: AgentEntry, n_neighbours: int) -> Iterator[str]:
    """What `receive: count` and `receive: period` name, where that is a parameter of the right type and unit."""
    for key, types in (("count", INTEGERS), ("period", FLOATS)):
        where = entry.node.locate("receive", key)
        reference = entry.spec.receive.get(key)
        port = ports.find(reference, where) if reference else None
        if reference is None or port is None:
            continue
        variable = port.variable
        if variable.causality not in ("structuralParameter", "parameter") or variable.dtype not in types:
            kind = "a whole-number parameter" if key == "count" else "a floating-point parameter"
            ports.problems.error(
                f"{key!r} sets {kind}; {reference!r} is {a_or_an(variable.causality)} of type {variable.dtype}", where
            )
        elif variable.causality == "structuralParameter" and (said := outside(variable, 0, n_neighbours)):
            ports.problems.error(f"an agent here hears {n_neighbours} others: {reference!r} would be {said}", where)
        elif key == "period" and variable.unit not in (None, "s"):
            ports.problems.error(f"the period is in s, but {reference!r} is in {variable.unit}", where)
        else:
            yield reference


def _connections(ports: Ports, entry: AgentEntry) -> tuple[Connection, ...]:
    made: list[Connection] = []
    fed: dict[str, Location] = {}
    for index, (source_name, target_name) in enumerate(entry.spec.connections):
        where = entry.node.locate("connections", index)
        source, target = ports.output(source_name, where), ports.input(target_name, where)
        if target is not None and target_name in fed:
            ports.problems.error(f"{target_name!r} is connected twice, first {fed[target_name].short}", where)
        fed.setdefault(target_name, where)
        if source is not None and target is not None and (fitting := _fitting(ports, source, target, where)):
            made.append(Connection(source, fitting))
    return tuple(made)


def _fitting(ports: Ports, source: Port, target: Port, where: Location) -> Port | None:
    """An input in the unit of the output that feeds it; None, and a problem, if size, type or unit do not fit."""
    names = f"{ports.name(source)!r}", f"{ports.name(target)!r}"
    if source.variable.size != target.variable.size:
        sizes = source.variable.size, target.variable.size
        message = f"{names[0]} has {numbers(sizes[0])}, but {names[1]} takes {numbers(sizes[1])}"
    elif (converted := in_unit_of(target.variable, source.variable)) is None:
        message = f"{names[0]} is in {in_words(source.variable)}, but {names[1]} is in {in_words(target.variable)}"
    elif mismatch := type_mismatch(source.variable, target.variable):
        message = f"{names[0]} {mismatch.format(names[1])}"
    else:
        warn_of_units(names, source.variable, target.variable, where, ports.problems)
        return Port(target.component, converted)
    ports.problems.error(message, where)
    return None


def _publish(ports: Ports, entry: AgentEntry) -> Mapping[str, Port]:
    published = {}
    for name, reference in entry.spec.publish.items():
        if name in MAILBOX_PORTS:
            where = entry.node.locate("publish", name, key=True)
            message = f"a message cannot have a variable {name!r}: under 'receive' that is the mailbox's own"
            ports.problems.error(message, where)
            continue
        port = ports.output(reference, entry.node.locate("publish", name))
        if port is not None:
            published[name] = port
    return published


def _record(ports: Ports, entry: AgentEntry) -> tuple[tuple[str, Port], ...]:
    """What is asked for, else every numeric output."""
    if entry.spec.record is None:
        return tuple(
            (f"{name}.{variable.name}", Port(index, variable))
            for index, name in enumerate(ports.components)
            if name in ports.descriptions
            for variable in ports.descriptions[name].variables.values()
            if variable.causality == "output" and variable.dtype in NUMERIC and variable.size
        )
    recorded: dict[str, Port] = {}
    for index, reference in enumerate(entry.spec.record):
        where = entry.node.locate("record", index)
        if reference in recorded:
            ports.problems.error(f"{reference!r} is recorded twice", where)
        elif (port := ports.find(reference, where)) is not None:
            recorded[reference] = port
    return tuple(recorded.items())


def _check_columns(record: Sequence[tuple[str, Port]], ports: Ports, entry: AgentEntry) -> None:
    """Every recorded number has a column of its own: `x[1]` may be a variable beside an array `x`."""
    first: dict[str, str] = {}
    for index, (name, port) in enumerate(record):
        columns = scalar_names(name, port.variable.shape)
        same = next((column for column in columns if column in first), None)
        if same is not None:
            whole = entry.spec.record is None
            path = ("components", ports.components[port.component]) if whole else ("record", index)
            instead = "list under 'record' what to record, without one of them" if whole else "leave one of them out"
            ports.problems.error(
                f"{first[same]!r} and {name!r} are both recorded in a column {same!r}; {instead}, or give it another "
                "name under 'outputs'",
                entry.node.locate(*path, key=whole),
            )
        first |= dict.fromkeys(columns, name)
