"""The message of a network, and which inputs of its receivers the mailbox feeds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from cosim.components.component import Variable, head
from cosim.components.presented import in_unit_of
from cosim.errors import Location, suggest
from cosim.plan import MailboxPlan, Port
from cosim.planning.blueprint import Blueprint, Part
from cosim.planning.mapping import in_words
from cosim.planning.ports import numbers, type_mismatch, warn_of_units
from cosim.planning.problems import Problems
from cosim.planning.starts import FLOATS
from cosim.scenario.spec import MAILBOX_PORTS, PARAMETER_PORTS


def mailbox_of(
    blueprint: Blueprint,
    message: Mapping[str, Variable | None],
    outside: Collection[tuple[int, str]] = (),
) -> MailboxPlan:
    """Which inputs the mailbox feeds.

    Args:
        blueprint: of the receivers.
        message: the variables that every agent publishes, by name; None for one that was reported already.
        outside: inputs, by component and name, that the bridge feeds.
    """
    receive, fed, problems = blueprint.entry.spec.receive, _fed(blueprint), blueprint.ports.problems
    feeding: dict[str, Port] = {}
    for name, reference in receive.items():
        if name in PARAMETER_PORTS:
            continue
        where = blueprint.where("receive", name)
        if name not in message and name not in MAILBOX_PORTS:
            at = blueprint.where("receive", name, key=True)
            problems.error(f"no agent publishes {name!r}{suggest(name, [*message, *MAILBOX_PORTS])}", at)
            continue
        port = blueprint.ports.input(reference, where)
        if port is not None and reference in fed:
            problems.error(f"{reference!r} is connected twice, first {fed[reference].short}", where)
            continue
        fed[reference] = where
        source = message.get(name)
        if port is None or (name in message and source is None):
            continue
        if (rows := _rows(blueprint, port, name, source, where)) is not None:
            feeding[name] = rows
    _check_unconnected(blueprint, fed, outside)
    if not blueprint.n_neighbours:
        return MailboxPlan({}, None, None, None)
    values = {name: port for name, port in feeding.items() if name not in MAILBOX_PORTS}
    return MailboxPlan(values, feeding.get("stamp"), feeding.get("time"), feeding.get("weight"))


def _fed(blueprint: Blueprint) -> dict[str, Location]:
    """The inputs that connections feed, and where."""
    spec = blueprint.entry.spec
    return {target: blueprint.where("connections", index) for index, (_, target) in enumerate(spec.connections)}


def _rows(blueprint: Blueprint, port: Port, name: str, source: Variable | None, where: Location) -> Port | None:
    """The port cut to one row per in-neighbour, where its FMU allows; None, and a problem, where it does not fit."""
    reference, variable, n = blueprint.ports.name(port), port.variable, blueprint.n_neighbours
    problems, width = blueprint.ports.problems, source.size if source else 1
    if n == 0:
        return None
    fitting = _first_rows(blueprint.parts[port.component], variable, n, width)
    if fitting is None:
        _report_size(blueprint, port, width, where)
    elif source is not None and (converted := in_unit_of(fitting, source)) is None:
        problems.error(
            f"{name!r} is published in {in_words(source)}, but {reference!r} is in {in_words(variable)}", where
        )
    elif source is not None and (mismatch := type_mismatch(source, variable)):
        problems.error(f"{name!r} {mismatch.format(repr(reference))}", where)
    elif name == "time" and variable.unit not in (None, "s"):
        problems.error(f"the sample times are in s, but {reference!r} is in {variable.unit}", where)
    elif source is None:
        return Port(port.component, fitting)
    elif converted is not None:
        warn_of_units((repr(name), repr(reference)), source, variable, where, problems)
        return Port(port.component, converted)
    return None


def _first_rows(part: Part, variable: Variable, n: int, width: int) -> Variable | None:
    """The variable with `n` rows of `width` numbers; of an FMI 2.0 array, declared at its largest, the head."""
    if variable.size == n * width:
        return variable
    flat = part.description.fmi == "2.0" or variable.elements is not None
    if not flat or variable.size < n * width:
        return None
    shape = (n * width,) if len(variable.shape) == 1 else (n, *variable.shape[1:])
    cut = head(variable, shape)
    return cut if cut.size == n * width else None


def _report_size(blueprint: Blueprint, port: Port, width: int, where: Location) -> None:
    """Why the rows of the mailbox do not fit an input, said where the remedy is."""
    reference, size, n = blueprint.ports.name(port), port.variable.size, blueprint.n_neighbours
    part, problems = blueprint.parts[port.component], blueprint.ports.problems
    hears = f"an agent that hears {n} other{'s' if n > 1 else ''}"
    count = blueprint.entry.spec.receive.get("count", "")
    sizing = [v.name for v in part.description.variables.values() if v.causality == "structuralParameter"]
    if count.startswith(f"{part.name}.") and count not in blueprint.assigned:
        return  # `count` is wrong, and has been reported
    if not count and sizing:
        problems.error(
            f"{part.name!r} is not told how many others an agent hears; add 'count: {part.name}.{sizing[0]}'",
            blueprint.where("receive", key=True),
        )
    elif part.description.fmi == "2.0" and size % width == 0:
        problems.error(f"{reference!r} has {size // width} rows, which FMI 2.0 fixes: too few for {hears}", where)
    else:
        problems.error(f"{reference!r} takes {numbers(size)}, but {hears} receives {n} x {width}", where)


def _check_unconnected(blueprint: Blueprint, fed: Mapping[str, Location], outside: Collection[tuple[int, str]]) -> None:
    """An input that nothing feeds keeps its start value, if it has one; without a word in the file that is rarely
    meant.
    """
    for index, part in enumerate(blueprint.parts):
        loose = [
            variable.name
            for variable in part.description.variables.values()
            if variable.causality == "input"
            and variable.dtype != "Clock"  # one that nobody activates
            and variable.size
            and f"{part.name}.{variable.name}" not in fed
            and variable.name not in part.start
            and (index, variable.name) not in outside
        ]
        where = blueprint.where("components", part.name, key=True)
        for name in [name for name in loose if part.description.variables[name].start is None]:
            loose.remove(name)
            blueprint.ports.problems.error(
                f"'{part.name}.{name}' has no value: nothing feeds it, and the component gives it none to start with; "
                "connect it, or give it a value under 'start'",
                where,
            )
        if loose:
            inputs = ", ".join(f"'{part.name}.{name}'" for name in loose[:8])
            inputs += f" and {len(loose) - 8} more" if loose[8:] else ""
            one = len(loose) == 1
            blueprint.ports.problems.warning(
                f"{inputs} {'is' if one else 'are'} not connected and {'keeps its' if one else 'keep their'} start "
                f"value{'' if one else 's'}; a value under 'start' says that this is meant",
                where,
            )


def message_variables(publishers: Sequence[tuple[str, Blueprint]], problems: Problems) -> Mapping[str, Variable]:
    """The variables of the network's message, in the units of the first who publishes it. Every publisher must have the
    same names, sizes and types, and units that convert.

    Args:
        publishers: agents that publish, in the order of the file; at least one.
        problems: where differences go.
    """
    first_name, first = publishers[0]
    message = {name: port.variable for name, port in first.publish.items()}
    for _, other in publishers[1:]:
        if other is first:
            continue
        where = other.where("publish", key=True)
        names = list(other.entry.spec.publish)
        expected = list(first.entry.spec.publish)
        if set(names) != set(expected):
            problems.error(
                f"every agent must publish the same message: here it is {', '.join(names)}; "
                f"agent {first_name!r} publishes {', '.join(expected)}",
                where,
            )
            continue
        for name, port in other.publish.items():
            if name in message and (difference := _difference(port.variable, message[name])):
                here, there = difference
                problems.error(
                    f"every agent must publish the same message: {name!r} is {here} here, "
                    f"{there} from agent {first_name!r}",
                    other.where("publish", name),
                )
    return message


def _difference(here: Variable, there: Variable) -> tuple[str, str] | None:
    """How two published variables differ, in words."""
    if here.size != there.size:
        return numbers(here.size), numbers(there.size)
    if published_as(here, there) is None:
        return f"in {in_words(here)}", f"in {in_words(there)}"
    if here.dtype != there.dtype and not {here.dtype, there.dtype} <= FLOATS:
        return f"of type {here.dtype}", f"of type {there.dtype}"
    return None


def published_as(here: Variable, message: Variable) -> Variable | None:
    """A published variable in the unit of the message; None where it is in one that does not convert."""
    one_unknown = here.measure is None or message.measure is None
    if one_unknown and here.unit != message.unit and here.unit is not None and message.unit is not None:
        return None
    return in_unit_of(here, message)
