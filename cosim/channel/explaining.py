"""`cosim channel --explain`: what docs/channels.md says of a parameter."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cosim import documents
from cosim.documents import ANCHOR, cells, plain
from cosim.errors import ConfigError, Problem, suggest


@dataclass(frozen=True)
class Entry:
    """A place in the docs.

    Attributes:
        term: such as `loss.gemodel.p`.
        line: of the page, from 1.
        text: what it says: a parameter in lines, or a section.
    """

    term: str
    line: int
    text: str


def page() -> Path:
    """The page."""
    return documents.page("channels.md")


def entries() -> dict[str, Entry]:
    """Every place by its term, in the order of the page."""
    lines = page().read_text(encoding="utf-8").splitlines()
    found = {}
    for number, line in enumerate(lines):
        for term in ANCHOR.findall(line):
            text = _row(term, lines, number) if line.startswith("|") else _section(lines, number + 1)
            found[term] = Entry(term, number + 1, text)
    return found


def explain(term: str) -> Iterator[Entry]:
    """The places that a term may mean: that of this name, else those that end in it.

    Raises:
        ConfigError: there is none.
    """
    known = entries()
    if term in known:
        yield known[term]
        return
    ending = [entry for name, entry in known.items() if name.endswith(f".{term}")]
    if not ending:
        last = {name.rpartition(".")[2]: name for name in known}
        hint = suggest(term, [*known, *last]) or "; cosim channel --explain shows them all"
        raise ConfigError([Problem(f"nothing is called {term!r}{hint}")])
    yield from ending


def _row(term: str, lines: list[str], number: int) -> str:
    """A row of a table: what it means, then the other cells under their heads."""
    head = next(i for i in range(number, -1, -1) if not lines[i].startswith("|")) + 1
    heads, row = cells(lines[head]), cells(lines[number])
    width = max(map(len, heads))
    others = [f"  {name:{width}}  {cell}" for name, cell in zip(heads[1:-1], row[1:-1], strict=True)]
    return "\n".join((f"{term}: {row[-1]}", *others))


def _section(lines: list[str], begin: int) -> str:
    """Up to the next heading of the same level, or of a higher one."""
    level = len(lines[begin]) - len(lines[begin].lstrip("#"))
    end = next(
        (i for i in range(begin + 1, len(lines)) if re.match(rf"#{{1,{level}}} ", lines[i])),
        len(lines),
    )
    body = lines[begin:end]
    while body and (not body[-1].strip() or ANCHOR.fullmatch(body[-1].strip())):
        body.pop()
    return "\n".join(plain(line) for line in body)
