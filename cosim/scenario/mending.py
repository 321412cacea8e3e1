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


def _with(node: Node, step: Step, child: Node | None) -> Node:
    """The node with another child, or without one."""
    if isinstance(node.value, list):
        index = int(step)
        return replace(node, value=[*node.value[:index], *([child] if child else []), *node.value[index + 1 :]])
    entries = {name: value for name, value in node.mapping.items() if name != str(step) or child is not None}
    return replace(node, value={**entries, **({str(step): child} if child is not None else {})})


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
        wrong = next((step for step in reversed(path) if isinstance(step, str)), "")
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
        """Whether a complaint may only be there because of what was cut."""
        said = re.sub(r" \((did you mean|known:).*", "", message)
        return any(re.search(rf"(?<!\w){re.escape(word)}(?!\w)", said) for word in self._words)
