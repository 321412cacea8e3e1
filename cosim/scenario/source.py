"""YAML text to a tree that knows where everything was written, and back.

PyYAML reads YAML 1.1, keeps only the last of two equal keys and forgets where a value stood. Here its parser composes
the nodes, and this module makes the values: the core schema of YAML 1.2 (section 10.3), every key as the text that was
written, equal keys refused, line and column kept.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from cosim.errors import ConfigError, Location, Problem

Scalar: TypeAlias = "str | int | float | bool | None"

MAX_NODES = 1_000_000
"""Aliases can make a short text expand without bound; no scenario needs more values than this."""
MAX_DEPTH = 100
_MAX_DIGITS = 400


@dataclass(frozen=True, slots=True)
class Node:
    """A value and where it was written.

    Attributes:
        value: a scalar, a list of nodes, or a mapping of names to nodes.
        where: where the value begins.
        key: where its key begins, for a value of a mapping.
    """

    value: Scalar | list[Node] | dict[str, Node]
    where: Location
    key: Location | None = None

    @property
    def mapping(self) -> Mapping[str, Node]:
        """The entries, or nothing if this is no mapping."""
        return self.value if isinstance(self.value, dict) else {}

    @property
    def items(self) -> list[Node]:
        """The elements, or nothing if this is no list."""
        return self.value if isinstance(self.value, list) else []

    def plain(self) -> Any:
        """The value without its locations, as `dict`, `list` and scalars."""
        if isinstance(self.value, dict):
            return {name: node.plain() for name, node in self.value.items()}
        if isinstance(self.value, list):
            return [node.plain() for node in self.value]
        return self.value

    def child(self, step: str | int) -> Node | None:
        """The entry of a mapping or the element of a list, if there is one."""
        if isinstance(self.value, dict):
            return self.value.get(str(step))
        if isinstance(self.value, list) and isinstance(step, int) and -len(self.value) <= step < len(self.value):
            return self.value[step]
        return None

    def find(self, *path: str | int) -> Node | None:
        """The node at `path`, if there is one."""
        node: Node | None = self
        for step in path:
            node = node.child(step) if node is not None else None
        return node

    def locate(self, *path: str | int, key: bool = False) -> Location:
        """Where the value at `path` was written (its key, with `key`); of what is not there, where its parent was."""
        node = self
        for step in path:
            child = node.child(step)
            if child is None:
                return node.where
            node = child
        return node.key if key and node.key is not None else node.where


# --- YAML 1.2's core schema, section 10.3.2 ---------------------------------------------------------------------------

_NULL = "tag:yaml.org,2002:null"
_BOOL = "tag:yaml.org,2002:bool"
_INT = "tag:yaml.org,2002:int"
_FLOAT = "tag:yaml.org,2002:float"
_TEXT = "tag:yaml.org,2002:str"
_MERGE = "tag:yaml.org,2002:merge"  # of YAML 1.1, but editors and people use it

_CORE = (
    (_NULL, re.compile(r"^(?:null|Null|NULL|~|)$"), ["n", "N", "~", ""]),
    (_BOOL, re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    (_INT, re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$"), list("-+0123456789")),
    (
        _FLOAT,
        re.compile(
            r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        list("-+.0123456789"),
    ),
    (_MERGE, re.compile(r"^<<$"), ["<"]),
)


def _with_core_schema(base: type) -> type[Any]:
    """`base` (a loader or a dumper of PyYAML) with the implicit types of YAML 1.2 instead of its own."""
    derived = type(f"Core{base.__name__}", (base,), {"yaml_implicit_resolvers": {}})
    for tag, pattern, first in _CORE:
        derived.add_implicit_resolver(tag, pattern, first)  # type: ignore[attr-defined]
    return derived


_PythonLoader = _with_core_schema(yaml.SafeLoader)
_Loader = _with_core_schema(getattr(yaml, "CSafeLoader", yaml.SafeLoader))
_Dumper = _with_core_schema(getattr(yaml, "CSafeDumper", yaml.SafeDumper))


def _integer(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise ValueError(text)
    return int(text, 0) if text[:2] in ("0o", "0x") else int(text)


def _boolean(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(text)
    return text.lower() == "true"


def _number(text: str) -> float:
    special = text.lower().lstrip("+-")
    if special == ".inf":
        return -math.inf if text.startswith("-") else math.inf
    return math.nan if special == ".nan" else float(text)


_SCALARS: Mapping[str, Callable[[str], Scalar]] = {
    _NULL: lambda _: None,
    _BOOL: _boolean,
    _INT: _integer,
    _FLOAT: _number,
    _TEXT: str,
    _MERGE: str,
}


# --- reading ----------------------------------------------------------------------------------------------------------


def read(path: Path, name: str | None = None, problems: list[Problem] | None = None) -> Node:
    """The tree of a file.

    Args:
        path: the file.
        name: what locations call it; `path` as given, by default.
        problems: see `parse`.

    Raises:
        ConfigError: it cannot be read, is not UTF-8, or is refused by `parse`.
    """
    name = name or str(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError([Problem(f"cannot be read: {error.strerror or error}", Location(name))]) from None
    try:
        return parse(data.decode("utf-8-sig"), name, problems)
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8-sig", errors="replace")
        raise ConfigError([Problem("not UTF-8 text; save the file as UTF-8", _location_after(before, name))]) from None


def parse(text: str, name: str, problems: list[Problem] | None = None) -> Node:
    """The tree of a YAML text.

    Args:
        text: one YAML document.
        name: what locations call it.
        problems: takes what is wrong with single keys and values, so that the rest can be checked as well; without it
            that is raised.

    Raises:
        ConfigError: no YAML, equal keys, a tag that is none of YAML's core types; every such problem at once, except
            that a text that is no YAML gives only the first.
    """
    try:
        root = yaml.compose(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigError([_syntax_problem(text, name, error)]) from None
    if root is None:
        raise ConfigError([Problem("the file is empty", Location(name, 1, 1))])
    builder = _Builder(name)
    tree = builder.build(root)
    if problems is not None:
        problems += builder.problems
    elif builder.problems:
        raise ConfigError(builder.problems)
    return tree


def _location_after(before: str, name: str) -> Location:
    lines = before.split("\n")
    return Location(name, len(lines), len(lines[-1]) + 1)


_PLAIN_WORDS = (
    ("mapping values are not allowed", "a second ': ' on this line; put the value in quotes, or start a new line"),
    ("'\\t' that cannot start", "a tab in the indentation; YAML wants spaces"),
    ("'@' that cannot start", "text that begins with '@' must be in quotes"),
    ("'%' that cannot start", "text that begins with '%' must be in quotes"),
    ("'`' that cannot start", "text that begins with '`' must be in quotes"),
    ("but got '['", "a '[' inside a list or a mapping; a name with brackets must be in quotes, such as 'x[1]'"),
    ("found another document", "a second document ('---'); a scenario is one document"),
)


def _syntax_problem(text: str, name: str, error: Exception) -> Problem:
    """The sentence for a text that is no YAML, from PyYAML's Python parser, whose words are better than the C one's."""
    if _Loader.__base__ is not _PythonLoader.__base__:
        try:
            yaml.compose(text, Loader=_PythonLoader)
        except yaml.YAMLError as better:
            error = better
        except RecursionError:
            pass
    if isinstance(error, yaml.reader.ReaderError):
        where = _location_after(text[: error.position], name)
        return Problem("a control character, which YAML does not allow", where)
    if not isinstance(error, yaml.MarkedYAMLError):
        return Problem("not valid YAML: nested too deeply", Location(name))
    mark = error.problem_mark or error.context_mark
    where = Location(name, mark.line + 1, mark.column + 1) if mark else Location(name)
    said = error.problem or str(error)
    for words, plain in _PLAIN_WORDS:
        if words in said:
            return Problem(f"not valid YAML: {plain}", where)
    context = f" {error.context}" if error.context else ""
    if error.context_mark and mark and error.context_mark.line != mark.line:
        context += f" that begins at line {error.context_mark.line + 1}"
    return Problem(f"not valid YAML{context}: {said}", where)


class _Builder:
    """Makes the tree from PyYAML's nodes and collects what is wrong."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.problems: list[Problem] = []
        self._count = 0
        self._open: list[yaml.Node] = []  # the nodes that are being built, to find an alias inside its own anchor

    def build(self, node: yaml.Node, key: Location | None = None) -> Node:
        where = self._where(node)
        self._count += 1
        if self._count > MAX_NODES:
            raise ConfigError([Problem(f"more than {MAX_NODES} values, counting those behind aliases", where)])
        if any(node is outer for outer in self._open):
            return self._refuse("an alias inside the very value that it stands for", where, key)
        if len(self._open) > MAX_DEPTH:
            return self._refuse(f"more than {MAX_DEPTH} levels deep", where, key)
        self._open.append(node)
        try:
            if isinstance(node, yaml.ScalarNode):
                return Node(self._scalar(node, where), where, key)
            if node.tag not in ("tag:yaml.org,2002:map", "tag:yaml.org,2002:seq"):
                return self._refuse(f"the tag {_short(node.tag)} means nothing here", where, key)
            if isinstance(node, yaml.SequenceNode):
                return Node([self.build(element) for element in node.value], where, key)
            return Node(self._mapping(node), where, key)
        finally:
            self._open.pop()

    def _scalar(self, node: yaml.ScalarNode, where: Location) -> Scalar:
        make = _SCALARS.get(node.tag)
        if make is None:
            self._refuse(f"the tag {_short(node.tag)} means nothing here", where)
            return None
        try:
            return make(node.value)
        except ValueError:
            self._refuse(f"{node.value[:40]!r} is no {_short(node.tag)}", where)
            return None

    def _mapping(self, node: yaml.Node) -> dict[str, Node]:
        own: dict[str, Node] = {}
        merged: dict[str, Node] = {}
        merge_at: Location | None = None
        for key_node, value_node in node.value:
            at = self._where(key_node)
            if not isinstance(key_node, yaml.ScalarNode):
                self._refuse("a key must be text, not a list or a mapping", at)
            elif key_node.tag == _MERGE:
                if merge_at is not None:
                    self._refuse(f"duplicate key '<<', first {merge_at.short}", at)
                merge_at = at
                for name, value in self._merged(value_node):
                    merged.setdefault(name, value)
            else:
                value = self.build(value_node, at)
                first = own.setdefault(key_node.value, value)
                if first is not value:
                    first_at = first.key or first.where
                    self._refuse(f"duplicate key {key_node.value!r}, first {first_at.short}", at)
        return {**merged, **own}

    def _merged(self, node: yaml.Node) -> Iterator[tuple[str, Node]]:
        """The entries that `<<` brings; of several mappings, those of an earlier one first."""
        sources = node.value if isinstance(node, yaml.SequenceNode) else [node]
        for source in sources:
            if isinstance(source, yaml.MappingNode):
                yield from self.build(source).mapping.items()
            else:
                self._refuse("'<<' takes a mapping or a list of mappings", self._where(source))

    def _where(self, node: yaml.Node) -> Location:
        return Location(self.name, node.start_mark.line + 1, node.start_mark.column + 1)

    def _refuse(self, message: str, where: Location, key: Location | None = None) -> Node:
        self.problems.append(Problem(message, where))
        return Node(None, where, key)


def _short(tag: str) -> str:
    return tag.replace("tag:yaml.org,2002:", "!!")


# --- writing ----------------------------------------------------------------------------------------------------------


class Lines(list[Any]):
    """A list that is written one element a line."""


_Dumper.add_representer(Lines, lambda dumper, rows: dumper.represent_sequence("tag:yaml.org,2002:seq", rows, False))


def dump(tree: Any) -> str:
    """YAML text of plain values; `parse` gives back the same values, floats to the last bit."""
    text: str = yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=118)
    return text


_OneLineDumper = _with_core_schema(_Dumper)
_OneLineDumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar(
        "tag:yaml.org,2002:str", text, style='"' if len(text.splitlines()) > 1 or text.endswith("\n") else None
    ),
)


def dump_on_one_line(value: Any) -> str:
    """YAML text of a plain value that may stand behind a key."""
    text: str = yaml.dump(
        value, Dumper=_OneLineDumper, sort_keys=False, allow_unicode=True, default_flow_style=True, width=2**30
    )
    return text.removesuffix("\n").removesuffix("\n...")
