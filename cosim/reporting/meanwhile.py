"""What the agents did while edges were older than the design assumed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cosim.reporting.network import Table
from cosim.reporting.words import number

if TYPE_CHECKING:
    from cosim.reporting.figures import Scene

MOST_INCIDENTS = 10
"""The longest."""

AFTER_S = 5.0


def meanwhile_table(scene: Scene) -> Table | None:
    """Per incident the disagreement when it began, at its largest and afterwards; None where there was none."""
    from cosim.reporting.figures.disagreement import largest_deviation
    from cosim.reporting.figures.scene import NotDrawn

    edges, results = scene.edges, scene.results
    if len(edges) == 0 or results.n_ticks < 2 or not edges.incidents:
        return None
    columns, curves = ["From – to", "Edges too old"], []
    target = "mean" if scene.reference_velocity is None else "v_d"
    for role, label in (("position", "|p₁ − pᵢ|"), ("velocity", f"|vᵢ − {target}|"), ("estimate", f"|v̂ᵢ − {target}|")):
        try:
            signal = scene.several(role)
        except NotDrawn:
            continue
        columns.append(f"{label}{signal.unit_text}")
        curves.append(largest_deviation(scene, signal, role))
    if not curves:
        return None
    period = results.period_ns / 1e9
    longest = sorted(edges.incidents, key=lambda one: one[0] - one[1])[:MOST_INCIDENTS]
    rows = []
    for first, stop, links in sorted(longest):
        begin, end = first * period, stop * period
        wanted = np.array((begin, end, end + AFTER_S)) - period / 2
        at = np.searchsorted(scene.time, wanted).clip(max=len(scene.time) - 1)
        during = slice(int(at[0]), int(at[1]) + 1)
        values = [
            " → ".join(number(float(value), digits=2) for value in (curve[at[0]], curve[during].max(), curve[at[2]]))
            for curve in curves
        ]
        rows.append((f"{begin:g} – {end:g} s", edges.names(links), *values))
    return Table(tuple(columns), rows, len(edges.incidents) - len(rows))
