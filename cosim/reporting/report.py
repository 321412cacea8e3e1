"""`cosim report`: the figures of a run, and one page that shows everything.

Drawing the same run again gives the same files.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.reporting import findings, network, page
from cosim.reporting.meanwhile import AFTER_S, meanwhile_table
from cosim.reporting.words import NOTHING
from cosim.results import load
from cosim.running.stopping import StopRequest

if TYPE_CHECKING:
    from cosim.reporting.figures import Scene

PAGE = "report.html"


def main(args: argparse.Namespace) -> int:
    """Draw the report of the run folder `args.run`."""
    stop = StopRequest()
    with stop.listening():
        drawn = draw(args.run, stop)
    if drawn is None:
        return stop.exit_code
    print(drawn)
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
    from cosim.reporting.figures import Scene, figures_of

    results = load(folder)
    scene = Scene(results)
    return page.write(
        folder / PAGE,
        "report.html.jinja",
        figures_of(results),
        scene,
        lambda: _facts(scene),
        stop_requested=stop_requested,
    )


def _facts(scene: Scene) -> dict[str, Any]:
    results = scene.results
    manifest, conditions = results.manifest, findings.conditions(results)
    edges = scene.edges
    told = network.is_told(edges)
    return {
        "name": manifest["name"],
        "title": manifest["title"] or manifest["name"],
        "complete": results.complete,
        "digest": manifest["digest"] or NOTHING,
        "outcome": findings.outcome(results),
        "agreement": findings.agreement(results),
        "graph": findings.graph(results),
        "conditions": conditions,
        "published": any(line.mu != NOTHING for line in conditions),
        "network": network.totals(edges),
        "freshness": network.freshness_table(edges) if told else None,
        "traffic": network.traffic_table(edges) if told else None,
        "breaks": network.breaks_table(edges) if told else None,
        "broken": network.broken(edges) if told else None,
        "readings": network.readings(edges),
        "meanwhile": meanwhile_table(scene) if told else None,
        "realtime": findings.realtime(results),
        "provenance": findings.provenance(results),
        "after_s": f"{AFTER_S:g}",
    }
