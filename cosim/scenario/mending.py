"""A scenario with mistakes, cut back just far enough that the rest of it can be checked as well.

A file may have mistakes in how it is written (an unknown key, a time without a unit) and in what it means (an edge to
an agent that does not exist). The second kind can only be looked for in something that has the right form. So whatever
has not is cut out; what was cut is remembered, so that nobody complains that it is missing.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from cosim.scenario.source import Node

Step = str | int

STAND_INS: Mapping[str, str] = {"period": "1 s", "duration": "1 s"}
"""What the top level cannot do without."""


def cut(root: Node, path: Sequence[Step]) -> tuple[Node, tuple[Step, ...]] | None:
    """The tree without what is at `path`, and the path of what was cut.

    What is not there cannot be cut: then its parent cannot do without it, and is cut instead. At the top level, a
    stand-in takes the place of what must be there. None if nothing would be left.
    """
    if not path:
        return None
    first, *rest = path
    child = root.child(first)
    if rest and child is not None and (smaller := cut(child, rest)) is not None:
        return _with(root, first, smaller[0]), (first, *smaller[1])
    if not rest and isinstance(first, str) and first in STAND_INS:
        return _with(root, first, Node(STAND_INS[first], root.where)), (first,)
    return None if child is None else (_with(root, first, None), (first,))


def in_one_piece(path: Sequence[Step]) -> Sequence[Step]:
    """The path of what must be cut for a mistake at `path`: a start value is cut whole, as its size counts."""
    for i in range(len(path) - 3):
        if path[i] == "components" and path[i + 2] == "start":
            return path[: i + 4]
    return path


def _with(node: Node, step: Step, child: Node | None) -> Node:
    """The node with another child, or without one."""
    if isinstance(node.value, list):
        index = int(step)
        return replace(node, value=[*node.value[:index], *([child] if child else []), *node.value[index + 1 :]])
    entries = {name: value for name, value in node.mapping.items() if name != str(step) or child is not None}
    return replace(node, value={**entries, **({str(step): child} if child is not None else {})})


_QUOTED = re.compile("'[^']*'|`[^`]*`")


class Doubts:
    """What was cut, and so which complaints are doubtful: those that name it, or what it probably was meant to be."""

    def __init__(self) -> None:
        self._words: set[str] = set()
        self._agents: set[str] = set()
        self._any_agent = False

    def add(self, path: Sequence[Step], known: Iterable[str] = ()) -> None:
        """Something at `path` was cut; `known` are the keys that there may be instead."""
        if len(path) <= 2 and path[0] == "agents":
            self._any_agent = True
        *before, wrong = [step for step in path if isinstance(step, str)] or [""]
        if before[-3:-2] == ["components"] and before[-1] == "start":  # one variable, of this component
            self._words.add(f"{before[-2]}.{wrong}")
            return
        self._words |= {wrong, *wrong.split(), *difflib.get_close_matches(wrong, list(known), n=1, cutoff=0.6)} - {""}

    def add_agent(self, name: str) -> None:
        """The agent exists, but what it is cannot be said."""
        self._agents.add(name)

    def about_agent(self, name: str) -> bool:
        """Whether there may be such an agent although nothing is known of it."""
        return self._any_agent or name in self._agents

    @property
    def all_agents_known(self) -> bool:
        """Whether something is known of every agent."""
        return not (self._any_agent or self._agents)

    def about(self, message: str) -> bool:
        """Whether a complaint may only be there because of what was cut: it names that in quotes, as it does a name."""
        named = _QUOTED.findall(re.sub(r" \((did you mean|known:).*", "", message))
        words = [re.compile(rf"(?<!\w){re.escape(word)}(?!\w)") for word in self._words]
        return any(word.search(name) for name in named for word in words)
