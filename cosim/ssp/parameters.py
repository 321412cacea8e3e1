"""Parameter sets, mappings and bindings (SSP 1.0 and 2.0, chapters 5.3, 6 and 7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from cosim.components.component import Value
from cosim.components.units import Measure, Scale
from cosim.errors import ConfigError, Problem
from cosim.ssp.package import Node, Package
from cosim.ssp.transformations import INTEGERS, REALS, Table, boolean, transformation

_SET = "application/x-ssp-parameter-set"
_MAPPING = "application/x-ssp-parameter-mapping"


@dataclass(frozen=True)
class Parameter:
    """A value.

    Attributes:
        values: as many as it has elements.
        kind: `Real`, `Integer`, `Boolean`, …
        unit: that the set gives, or None.
        items: what the names of its enumeration stand for, as far as the set says so.
    """

    name: str
    values: tuple[Value, ...]
    kind: str
    unit: str | None
    items: Mapping[str, int]
    node: Node


@dataclass(frozen=True)
class Entry:
    """Which parameter of a set goes where."""

    source: str
    target: str
    transformation: Scale | Table | None
    suppressed: bool
    node: Node


@dataclass(frozen=True)
class Binding:
    """Values for a component or system.

    Attributes:
        mapping: None where names in the set are those of the parameters.
        units: what the units of the set mean.
    """

    prefix: str
    parameters: Mapping[str, Parameter]
    mapping: Sequence[Entry] | None
    units: Mapping[str, Measure] = field(default_factory=dict)


def read_bindings(package: Package, owner: Node) -> tuple[list[Binding], list[Problem]]:
    """The bindings of a component or system, and what is wrong with them or not supported."""
    found: list[Binding] = []
    problems: list[Problem] = []
    for node in owner.all("ParameterBindings", "ParameterBinding"):
        try:
            found.append(_binding(package, node))
        except ConfigError as error:
            problems += error.problems
    return found, problems


def _binding(package: Package, node: Node) -> Binding:
    from cosim.ssp.structure import units_of

    values = _document(package, node, node, "ParameterValues", "ParameterSet", _SET)
    if values is None:
        raise node.error("a binding with neither source nor ParameterValues")
    mapping = None
    for child in node.all("ParameterMapping"):
        written = _document(package, child, node, "ParameterMapping", "ParameterMapping", _MAPPING)
        mapping = [_entry(entry) for entry in written.all("MappingEntry")] if written is not None else []
    enumerations = {x.required("name"): _items(x) for x in values.all("Enumerations", "Enumeration")}
    parameters = {x.required("name"): _parameter(x, enumerations) for x in values.all("Parameters", "Parameter")}
    return Binding(node.get("prefix") or "", parameters, mapping, dict(units_of(values)))


def _document(package: Package, node: Node, binding: Node, inline: str, root: str, kind: str) -> Node | None:  # noqa: PLR0917
    """What an element refers to, or holds itself."""
    if (node.get("type") or kind) != kind:
        raise node.error(f"{node.kind} of the type {node.get('type')} is not supported; only {kind} is")
    if (node.get("sourceBase") or "SSD") != "SSD":
        raise node.error("sourceBase='component' is not supported: copy the file out of the FMU into the package")
    source = node.get("source")
    if source is not None:
        return package.document(package.resolve(node, source), root)
    found = binding.all(inline, root)
    return found[0] if found else None


def _entry(node: Node) -> Entry:
    suppressed = node.flag("suppressUnitConversion")
    return Entry(node.required("source"), node.required("target"), transformation(node), suppressed, node)


def _items(enumeration: Node) -> dict[str, int]:
    return {item.required("name"): int(item.number("value", 0.0)) for item in enumeration.all("Item")}


def _parameter(node: Node, enumerations: Mapping[str, Mapping[str, int]]) -> Parameter:
    name = node.required("name")
    for child in node.children():
        if child.kind in _READ:
            read, separated = _READ[child.kind]
            single = child.get("value")
            several = [value.required("value") for value in child.all("Value")]
            words = several or (single.split() if separated and single is not None else [single or ""])
            try:
                values = tuple(read(word) for word in words)
            except ValueError:
                raise child.error(f"{name}: {single!r} is no value of the type {child.kind}") from None
            items = enumerations.get(child.get("name") or "", {})
            return Parameter(name, values, child.kind, child.get("unit"), items, child)
    raise node.error(f"{name} has no value")


_READ: Mapping[str, tuple[Callable[[str], Value], bool]] = {
    **dict.fromkeys(REALS, (float, True)),
    **dict.fromkeys(INTEGERS, (int, True)),
    "Boolean": (boolean, True),
    **dict.fromkeys(("String", "Enumeration", "Binary"), (str, False)),
}
"""How the values of a type are read, and whether a list of them is separated by spaces."""
