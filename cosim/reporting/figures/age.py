"""Age of information: the sawtooth of one edge, and mean, mean peak and largest age of every edge."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.scene import need_messages
from cosim.reporting.figures.timeline import window
from network.freshness import EdgeLog, Span
from network.messages import Fate, Floats
from network.units import to_seconds

TICKS = 80
"""Of the sawtooth; the whole run is longer than a column is wide."""

NAMED_EDGES = 24
"""Up to as many edges are named on the axis."""

JOINED_EDGES = 100
"""Up to as many edges have a line from mean to largest age."""


def draw_age(edges: Edges) -> tuple[Figure, str]:
    """The age on the worst edge, around its largest; below, a summary of all edges if there are several."""
    results = edges.results
    need_messages(edges)
    bounded = any(results.age_bound(link) is not None for link in range(len(edges)))
    link = edges.worst_first[0]
    on = "On edge" if len(edges) == 1 else "On the worst edge,"
    text = f"{on} {edges.name(link)}, around its largest; it drops at every arrival of a fresher sample."
    if len(edges) == 1:
        figure, (ax,) = style.panels(1, 1.3, lines=0)
        _sawtooth(ax, edges, link)
    else:
        labels = ["mean", "mean peak", "largest", *(["bound at ticks"] if bounded else [])]
        figure, (upper, lower) = style.panels(2, 1.05, lines=style.legend_lines(labels), gap=0.5, share=False)
        _sawtooth(upper, edges, link)
        style.legend(figure, _summary(lower, edges), labels)
        figure.align_ylabels([upper, lower])
        order = "" if _named(edges) else ", the edges in the order of their mean age"
        text = f"Top: {text[0].lower()}{text[1:]} Bottom: over the whole run, per edge{order}."
    if edges.assumed[link].h_star_ns is not None or bounded:
        of = "the largest age that the channel lets a receiver read at a tick"
        if not bounded or results.age_bound(link) is None:
            of = f"the largest age at ticks that was assumed ({edges.assumed[link].origin}"
            of += "; below, the channels' bounds)" if bounded and len(edges) > 1 else ")"
        text += f" Dashed: {of}; between ticks it can be older."
    return figure, text


def sawtooth(log: EdgeLog, span: Span, until_ns: int) -> tuple[Floats, Floats]:
    """Corners of the age over time, in seconds, from 0 to `until_ns`."""
    fresh = (log.fate == Fate.DELIVERED) & (log.arrival_ns < until_ns)
    order = np.argsort(log.arrival_ns[fresh], kind="stable")
    arrival = np.concatenate(([0], log.arrival_ns[fresh][order], [until_ns]))
    taken = np.concatenate(([0], log.stamp[fresh][order] * span.period_ns))
    time = np.repeat(arrival, 2)[1:-1]
    corners = np.repeat(taken, 2)
    return time / 1e9, (time - corners) / 1e9


def _named(edges: Edges) -> bool:
    """Whether the axis has room for the names of all edges."""
    return len(edges) <= NAMED_EDGES and max(len(edges.name(link)) for link in range(len(edges))) <= 10


def _sawtooth(axes: Axes, edges: Edges, link: int) -> None:
    begin, end = window(edges, link, TICKS)
    until_ns = min(edges.span.end_ns, round(end * 1e9))
    time, values = sawtooth(edges.logs[link], edges.span, until_ns)
    shown = max(0, int(np.searchsorted(time, begin)) - 1)
    axes.plot(time[shown:], values[shown:], color=style.ACCENT, linewidth=0.7)
    assumed = edges.assumed[link].h_star_ns
    if assumed is not None:
        axes.axhline(assumed / 1e9, color=style.INK, linewidth=0.8, linestyle=(0, (4, 2)))
    style.time_axis(axes, begin, to_seconds(until_ns))
    axes.set_ylim(bottom=0)
    axes.set_ylabel("age (s)")


def _summary(axes: Axes, edges: Edges) -> list[object]:
    """Mean, mean peak and largest age of every edge, and the channels' bounds; the handles of those there are."""
    results, ages = edges.results, edges.ages
    mean, peak, largest = (np.array([getattr(one, name) for one in ages]) for name in ("mean", "peak_mean", "sup"))
    bounds = np.array([results.age_bound(i) or np.nan for i in range(len(ages))])
    x = np.arange(len(ages))
    named = _named(edges)
    order = x if named else np.argsort(mean, kind="stable")
    size = max(1.0, 3.0 * min(1.0, NAMED_EDGES / len(ages)) ** 0.5)
    if len(ages) <= JOINED_EDGES:
        axes.vlines(x, mean[order], largest[order], color="#D0D0D0", linewidth=0.6)
    handles: list[object] = []
    for values, marker, colour in ((mean, "o", style.ACCENT), (peak, "s", style.WARM), (largest, "^", style.GREEN)):
        look: dict[str, Any] = {"linestyle": "none", "marker": marker, "color": colour, "markeredgewidth": 0}
        axes.plot(x, values[order], markersize=size, **look)
        handles.append(Line2D([], [], markersize=3.0, **look))
    if np.isfinite(bounds).any():
        sides = np.concatenate((x - 0.5, [len(ages) - 0.5]))
        handles.append(
            axes.stairs(bounds[order], sides, color=style.INK, linewidth=0.8, linestyle=(0, (4, 2)), baseline=None)
        )
    axes.set_xlim(-0.6, len(ages) - 0.4)
    axes.set_ylim(bottom=0)
    axes.grid(axis="x", visible=False)
    axes.set_ylabel("age (s)")
    if named:
        names = [edges.name(i).replace(" ", "") for i in range(len(ages))]
        upright = max(map(len, names)) > 4 or len(names) > 12
        axes.set_xticks(x, names, rotation=90 if upright else 0, fontsize=6.5)
    else:
        axes.set_xticks([])
        axes.set_xlabel(f"{len(ages)} edges, by mean age", labelpad=3)
    return handles
