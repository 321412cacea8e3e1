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
    from cosim.reporting.figures.disagreement import deviations
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
        curves.append((deviations(scene, signal, role), [results.agents[i] for i in signal.agents]))
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
        values = []
        for of_agent, names in curves:
            curve = of_agent.max(axis=1)
            most = during.start + int(np.argmax(curve[during]))
            before, largest, after = (number(float(curve[i]), digits=2) for i in (at[0], most, at[2]))
            values.append(f"{before} → {largest} ({names[int(np.argmax(of_agent[most]))]}) → {after}")
        rows.append((f"{begin:g} – {end:g} s", edges.names(links), *values))
    return Table(tuple(columns), rows, len(edges.incidents) - len(rows))
