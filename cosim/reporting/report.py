"""`cosim report`: the figures of a run, one by one as SVG and PDF, and one page that shows everything.

The page is self-contained: the figures are in it, and it loads nothing. Drawing the same run again gives the same
files.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.recording.manifest import folder_problem, write_atomically
from cosim.reporting import findings, network
from cosim.reporting.meanwhile import AFTER_S, meanwhile_table
from cosim.reporting.words import NOTHING
from cosim.results import load
from cosim.stopping import StopRequest

if TYPE_CHECKING:
    from cosim.reporting.figures import Scene

PAGE = "report.html"
FIGURES = "figures"
_TEMPLATE = Path(__file__).with_name("report.html.jinja")


@dataclass(frozen=True)
class Shown:
    """A figure in the page: its SVG, or why there is none."""

    name: str
    title: str
    caption: str
    svg: str = ""


def main(args: argparse.Namespace) -> int:
    """Draw the report of the run folder `args.run`."""
    stop = StopRequest()
    with stop.listening():
        page = draw(args.run, stop)
    if page is None:
        return stop.exit_code
    print(page)
    return 0


def draw(folder: Path, stop_requested: Callable[[], bool] = lambda: False) -> Path | None:
    """Draw all figures that apply to a run, and the page.

    Args:
        folder: of a run that has ended, whole or aborted.
        stop_requested: asked before each figure.

    Returns:
        The page; None if it was stopped before that.

    Raises:
        ConfigError: the folder is no run folder, or cannot be written.
    """
    from cosim.reporting.figures import Scene

    results = load(folder)
    page = folder / PAGE
    try:
        scene = Scene(results)
        shown = _draw_figures(scene, folder / FIGURES, stop_requested)
        if shown is None:
            return None
        write_atomically(page, _render(scene, shown))
    except OSError as error:
        where = Path(error.filename or folder)
        raise folder_problem(where, f"cannot write the report: {error.strerror or error}") from None
    return page


def _draw_figures(scene: Scene, folder: Path, stop_requested: Callable[[], bool]) -> list[Shown] | None:
    from cosim.reporting.figures import NotDrawn, figures_of
    from cosim.reporting.figures.style import save, styled

    folder.mkdir(exist_ok=True)
    shown = []
    with styled():
        for entry in figures_of(scene.results):
            if stop_requested():
                return None
            try:
                figure, caption = entry.draw(scene)
            except NotDrawn as reason:
                _remove(folder / f"{entry.name}{suffix}" for suffix in (".svg", ".pdf"))
                shown.append(Shown(entry.name, entry.title, str(reason)))
                continue
            svg = save(figure, folder, entry.name)
            shown.append(Shown(entry.name, entry.title, caption, inline(svg, entry.name)))
    return shown


def _remove(paths: Iterable[Path]) -> None:
    """Of an earlier report, which another version may have drawn."""
    for path in paths:
        path.unlink(missing_ok=True)


def inline(svg: str, name: str) -> str:
    """An SVG as an element of a page: no prologue, no fixed size, identifiers that no other figure has."""
    element = svg[svg.index("<svg") :]
    element = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", element, count=1)
    element = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", element, count=1)
    element = re.sub(r'\bid="', f'id="{name}-', element)
    return re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", element)


def _render(scene: Scene, shown: list[Shown]) -> str:
    import jinja2

    results = scene.results
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    manifest, conditions = results.manifest, findings.conditions(results)
    edges = scene.edges
    told = network.is_told(edges)
    return template.render(
        name=manifest["name"],
        title=manifest["title"] or manifest["name"],
        complete=results.complete,
        digest=manifest["digest"] or NOTHING,
        outcome=findings.outcome(results),
        agreement=findings.agreement(results),
        graph=findings.graph(results),
        conditions=conditions,
        published=any(line.mu != NOTHING for line in conditions),
        network=network.totals(edges),
        freshness=network.freshness_table(edges) if told else None,
        traffic=network.traffic_table(edges) if told else None,
        breaks=network.breaks_table(edges) if told else None,
        readings=network.readings(edges),
        meanwhile=meanwhile_table(scene) if told else None,
        realtime=findings.realtime(results),
        provenance=findings.provenance(results),
        figures=[figure for figure in shown if figure.svg],
        missing=[figure for figure in shown if not figure.svg],
        folder=FIGURES,
        after_s=f"{AFTER_S:g}",
    )
