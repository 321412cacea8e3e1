"""What becomes of a value on its way (SSP 2.0, 4.5.2: Transformation Choice; the elements are those of 1.0)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from cosim.components.component import Value
from cosim.components.units import Scale
from cosim.ssp.package import Node


@dataclass(frozen=True)
class Table:
    """What some values are replaced by; all others stay.

    Attributes:
        kind: of the values: `Boolean`, `Integer` or `Enumeration`, whose items are told by their names.
        targets: by what they replace.
    """

    kind: str
    targets: Mapping[Value, Value]
    node: Node

    def apply(self, values: Sequence[Value], kind: str, items: Mapping[str, int]) -> tuple[Value, ...]:
        """The values after it.

        Args:
            values: of a parameter.
            kind: theirs, `Int32` as well as `Integer`.
            items: what the names of an enumeration stand for, which a table of integers looks at.

        Raises:
            ConfigError: it is none for such values.
        """
        wanted = {"Integer": "Integer or Enumeration"}.get(self.kind, self.kind)
        numbers = self.kind == "Integer" and kind in {*INTEGERS, "Enumeration"}
        if not numbers and kind != self.kind:
            raise self.node.error(f"{self.node.kind} is for values of the type {wanted}, and this is {kind}")
        return tuple(self.targets.get(items.get(x, x) if numbers and isinstance(x, str) else x, x) for x in values)


def linear(node: Node) -> Scale | None:
    """The linear transformation of a connection, if there is one.

    Raises:
        ConfigError: it is another kind of transformation.
    """
    found = transformation(node)
    if isinstance(found, Table):
        text = f"{found.node.kind} is not supported on connections, only in parameter mappings"
        raise found.node.error(f"{text}; LinearTransformation is")
    return found


def transformation(node: Node) -> Scale | Table | None:
    """What an entry of a parameter mapping, or a connection, does to values.

    Raises:
        ConfigError: there is no such transformation, or it contradicts itself.
    """
    for child in node.children():
        if child.kind == "LinearTransformation":
            return Scale(child.number("factor", 1.0), child.number("offset", 0.0))
        if child.kind in _TABLES:
            return _table(child)
        if child.kind.endswith("Transformation"):
            raise child.error(f"{child.kind} is not known")
    return None


def _table(node: Node) -> Table:
    kind, read = _TABLES[node.kind]
    targets: dict[Value, Value] = {}
    for entry in node.all("MapEntry"):
        source, target = (_value(entry, name, kind, read) for name in ("source", "target"))
        if source in targets:
            raise entry.error(f"two entries for {entry.get('source')!r}")
        targets[source] = target
    return Table(kind, targets, node)


def _value(entry: Node, name: str, kind: str, read: Callable[[str], Value]) -> Value:
    text = entry.required(name)
    try:
        return read(text)
    except ValueError:
        raise entry.error(f"{name}={text!r} is no value of the type {kind}") from None


def boolean(text: str) -> bool:
    """As XML has it.

    Raises:
        ValueError: it is none.
    """
    if text not in ("true", "false", "0", "1"):
        raise ValueError(text)
    return text in ("true", "1")


REALS = ("Real", "Float64", "Float32")
"""The types of real numbers."""
INTEGERS = ("Integer", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
"""The types of whole numbers."""

_TABLES: Mapping[str, tuple[str, Callable[[str], Value]]] = {
    "BooleanMappingTransformation": ("Boolean", boolean),
    "IntegerMappingTransformation": ("Integer", int),
    "EnumerationMappingTransformation": ("Enumeration", str),
}
