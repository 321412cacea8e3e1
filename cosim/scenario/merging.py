"""Trees over trees: templates and entries merged, single values replaced, every location kept."""

from __future__ import annotations

import re
from collections.abc import Sequence

from cosim.errors import ConfigError, Location, Problem
from cosim.scenario.source import Node, parse

_ALTERNATIVES = (frozenset({"fmu", "python"}), frozenset({"uniform", "normal"}))
"""Keys that exclude each other: writing one replaces what was written under another."""


def merge(base: Node, over: Node) -> Node:
    """`over` laid over `base`: mappings key by key at every level; lists and scalars are replaced whole.

    A merged mapping keeps the place of `base`, so that what is wrong with the whole points to where it began.
    """
    if not isinstance(base.value, dict) or not isinstance(over.value, dict):
        return over
    merged = dict(base.value)
    for group in _ALTERNATIVES:
        if group & over.value.keys():
            for name in group - over.value.keys():
                merged.pop(name, None)
    for name, node in over.value.items():
        merged[name] = merge(merged[name], node) if name in merged else node
    return Node(merged, base.where, base.key)


def relocated(node: Node, where: Location) -> Node:
    """The same tree, every node at one place."""
    if isinstance(node.value, dict):
        return Node({name: relocated(child, where) for name, child in node.value.items()}, where, where)
    if isinstance(node.value, list):
        return Node([relocated(child, where) for child in node.value], where, where)
    return Node(node.value, where, where)


class Override:
    """One `--set KEY=VALUE`.

    Attributes:
        path: the keys from the root.
        value: at the place that problems are reported with.
    """

    def __init__(self, key: str, text: str, label: str | None = None) -> None:
        """The override of `key` by the YAML value in `text`; problems call it `label`, `--set KEY` by default.

        Raises:
            ConfigError: the value is no YAML.
        """
        where = Location(label or f"--set {key}")
        try:
            self.value = relocated(parse(text, where.file), where) if text.strip() else Node(None, where, where)
        except ConfigError as error:
            raise ConfigError(Problem(problem.message, where) for problem in error.problems) from None
        self.path = _split(key)

    @classmethod
    def from_setting(cls, setting: str) -> Override:
        """The override that `KEY=VALUE` stands for.

        Raises:
            ConfigError: no `=`, an empty key, or a value that is no YAML.
        """
        key, equals, text = setting.partition("=")
        if not equals or not key.strip():
            raise ConfigError(
                [Problem("write --set KEY=VALUE, such as coupling.step='1 ms'", Location(f"--set {setting}"))]
            )
        return cls(key.strip(), text)

    @property
    def where(self) -> Location:
        """The place that problems are reported with."""
        return self.value.where

    def apply(self, root: Node) -> Node:
        """`root` with the value replaced; mappings on the way are made where there are none.

        Raises:
            ConfigError: something on the way is no mapping.
        """
        return self._set(root, self.path)

    def _set(self, node: Node, path: Sequence[str]) -> Node:
        if not path:
            return self.value
        step, rest = path[0], path[1:]
        if isinstance(node.value, dict):
            child = node.value.get(step, Node({}, self.where, self.where))
            changed = self._set(child, rest)
            key = child.key if rest else self.where
            return Node({**node.value, step: Node(changed.value, changed.where, key)}, node.where, node.key)
        if isinstance(node.value, list) and step.isdecimal() and int(step) < len(node.value):
            elements = list(node.value)
            elements[int(step)] = self._set(elements[int(step)], rest)
            return Node(elements, node.where, node.key)
        parent = ".".join(self.path[: len(self.path) - len(path)])
        kind = f"a list of {len(node.value)} elements" if isinstance(node.value, list) else "a single value"
        raise ConfigError([Problem(f"{parent!r} is {kind}; it has no {step!r}", self.where)])


def _split(key: str) -> tuple[str, ...]:
    """`templates.arm.components.plant.start.a.b` in its keys; ranges (`1..10`) and names of variables stay whole."""
    steps = re.split(r"(?<!\.)\.(?!\.)", key)
    for i, step in enumerate(steps):
        if (step == "start" and i >= 2 and steps[i - 2] == "components") or steps[: i + 1] == ["analysis", "leaders"]:
            return (*steps[: i + 1], *([".".join(steps[i + 1 :])] if steps[i + 1 :] else []))
    return tuple(steps)
