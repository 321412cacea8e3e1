"""`component.variable` to a port of an agent, and whether one port can feed another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cosim.components.component import Description, Variable
from cosim.errors import Location, suggest
from cosim.plan import Port
from cosim.planning.problems import Problems
from cosim.planning.starts import FLOATS, INTEGERS, NUMERIC
from cosim.scenario.source import dump_on_one_line

if TYPE_CHECKING:
    from cosim.planning.mapping import Mapped

_WHOLE = INTEGERS | {"Boolean", "Enumeration"}


@dataclass(frozen=True)
class Ports:
    """The ports of one agent.

    Attributes:
        components: names, in the agent's order.
        mapped: those that could be opened; the others have been reported.
    """

    components: Sequence[str]
    mapped: Mapping[str, Mapped]
    problems: Problems

    @property
    def descriptions(self) -> Mapping[str, Description]:
        """Of those that could be opened."""
        return {name: mapped.description for name, mapped in self.mapped.items()}

    def find(self, reference: str, where: Location) -> Port | None:
        """The numeric port that `component.variable` names; None, and a problem, if there is none."""
        component, _, name = reference.partition(".")
        if component not in self.components:
            self.problems.error(f"unknown component {component!r}{suggest(component, self.components)}", where)
            return None
        mapped = self.mapped.get(component)
        if mapped is None or name in mapped.broken:
            return None
        variables = mapped.description.variables
        variable = variables.get(name)
        if variable is None:
            instead = mapped.instead.get(name)
            hint = f"; it is called {instead!r} here" if instead else suggest(name, variables)
            self.problems.error(f"{component!r} has no variable {name!r}{hint}", where)
            return None
        if variable.dtype not in NUMERIC:
            self.problems.error(f"{reference!r} is of type {variable.dtype}; only numbers can be used here", where)
            return None
        return Port(self.components.index(component), variable)

    def output(self, reference: str, where: Location) -> Port | None:
        """As `find`; it must be an output."""
        return self._with_causality(reference, "output", where)

    def input(self, reference: str, where: Location) -> Port | None:
        """As `find`; it must be an input."""
        return self._with_causality(reference, "input", where)

    def _with_causality(self, reference: str, wanted: str, where: Location) -> Port | None:
        port = self.find(reference, where)
        if port is None or port.variable.causality == wanted:
            return port
        variables = self.descriptions[self.components[port.component]].variables.values()
        those = _short_list(variable.name for variable in variables if variable.causality == wanted)
        has = f"; the {wanted}s of {self.components[port.component]!r}: {those}" if those else ""
        if wanted == "output" and port.variable.causality in {"local", "calculatedParameter"}:
            own = dump_on_one_line({port.variable.name: port.variable.name})
            has = f"; `outputs: {own}` beside 'fmu' makes it one"
        self.problems.error(f"{reference!r} is {a_or_an(port.variable.causality)}, not {a_or_an(wanted)}{has}", where)
        return None

    def name(self, port: Port) -> str:
        """`component.variable`."""
        return f"{self.components[port.component]}.{port.variable.name}"


def type_mismatch(source: Variable, target: Variable) -> str | None:
    """Why values of one type cannot feed another, or None."""
    same = source.dtype == target.dtype
    whole = source.dtype in _WHOLE and target.dtype in INTEGERS
    item = source.dtype in INTEGERS and target.dtype == "Enumeration"
    if same or whole or item or target.dtype in FLOATS:
        return None
    return f"is of type {source.dtype} and cannot feed {{}} of type {target.dtype}"


def warn_of_units(
    names: Sequence[str], source: Variable, target: Variable, where: Location, problems: Problems
) -> None:
    """Two units of which one is not known: values pass as they are. Or a difference where a value is meant."""
    one, other = source.measure, target.measure
    if one and other and one.relative != other.relative and one.offset != other.offset:
        difference, value = names if one.relative else reversed(names)
        text = f"{difference} is a difference (relativeQuantity), {value} is not; of the units only the factor counts"
        problems.warning(text, where)
    if source.unit is None or target.unit is None or source.unit == target.unit:
        return
    unknown = [v.unit for v in (source, target) if v.measure is None]
    if unknown:
        problems.warning(
            f"{names[0]} is in {source.unit}, {names[1]} is in {target.unit}; nothing says what {unknown[0]!r} is, so "
            "values pass as they are",
            where,
        )


def numbers(size: int) -> str:
    """`1 number`, `2 numbers`."""
    return "1 number" if size == 1 else f"{size} numbers"


def a_or_an(causality: str) -> str:
    """A causality in words, with its article."""
    words = {
        "structuralParameter": "structural parameter",
        "calculatedParameter": "calculated parameter",
        "local": "local variable",
    }
    word = words.get(causality, causality)
    return f"an {word}" if word[0] in "aeiou" else f"a {word}"


def _short_list(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed) if len(listed) <= 12 else ""
