"""A page and its figures: one by one as SVG and PDF, and a self-contained HTML file that shows everything."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from cosim import documents
from cosim.recording.atomic import write_atomically
from cosim.recording.manifest import folder_problem

if TYPE_CHECKING:
    from cosim.reporting.figures import Entry

FIGURES = "figures"
"""Folder beside the page."""

Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Shown:
    """A figure in the page: its SVG, or why there is none."""

    name: str
    title: str
    caption: str
    svg: str = ""


def write(
    page: Path,
    template: str,
    entries: Sequence[Entry[Subject]],
    subject: Subject,
    facts: Callable[[], dict[str, Any]],
    *,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Path | None:
    """Draw figures, and the page that shows them.

    Args:
        page: the file; the figures go to a folder beside it.
        template: its name.
        entries: the figures.
        subject: what they show.
        facts: gives what the template asks for beside the figures.
        stop_requested: asked before each figure.

    Returns:
        The page; None if it was stopped before that.

    Raises:
        ConfigError: the folder cannot be written.
    """
    try:
        shown = _draw(entries, subject, page.parent / FIGURES, stop_requested)
        if shown is None:
            return None
        figures = {"figures": [one for one in shown if one.svg], "missing": [one for one in shown if not one.svg]}
        write_atomically(page, _render(template, {**facts(), **figures, "folder": FIGURES}))
    except OSError as error:
        where = Path(error.filename or page.parent)
        raise folder_problem(where, f"cannot write {page.name}: {error.strerror or error}") from None
    return page


def _draw(
    entries: Sequence[Entry[Subject]], subject: Subject, folder: Path, stop_requested: Callable[[], bool]
) -> list[Shown] | None:
    from cosim.reporting.figures import NotDrawn
    from cosim.reporting.figures.style import save, styled

    folder.mkdir(parents=True, exist_ok=True)
    shown = []
    with styled():
        for entry in entries:
            if stop_requested():
                return None
            try:
                figure, caption = entry.draw(subject)
            except NotDrawn as reason:
                _remove(folder / f"{entry.name}{suffix}" for suffix in (".svg", ".pdf"))
                shown.append(Shown(entry.name, entry.title, str(reason)))
                continue
            svg = save(figure, folder, entry.name)
            shown.append(Shown(entry.name, entry.title, caption, inline(svg, entry.name)))
    return shown


def _remove(paths: Iterable[Path]) -> None:
    """Of an earlier page, which another version may have drawn."""
    for path in paths:
        path.unlink(missing_ok=True)


def inline(svg: str, name: str) -> str:
    """An SVG as an element of a page: no prologue, no fixed size, identifiers that no other figure has."""
    element = svg[svg.index("<svg") :]
    element = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", element, count=1)
    element = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", element, count=1)
    element = re.sub(r'\bid="', f'id="{name}-', element)
    return re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", element)


def _render(template: str, facts: dict[str, Any]) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["measures"] = documents.measures
    return environment.get_template(template).render(facts)
