"""Deliveries one by one: when messages left, when they arrived, and which were lost."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.scene import need_messages
from network.freshness import ages_at_ticks
from network.messages import Fate

TICKS = 60
"""That are shown."""

MAX_LANES = 5
"""Edges that are shown: the worst one, then others of its receiver."""

NAMED_LETTERS = 8
"""Of the longest name that fits beside the lanes."""


def draw_timeline(edges: Edges) -> tuple[Figure, str]:
    """A lane per edge: above when messages left, below when they arrived."""
    results = edges.results
    need_messages(edges)
    worst = edges.worst_first[0]
    same = results.links.receiver == results.links.receiver[worst]
    lanes = [worst, *(link for link in edges.worst_first if same[link] and link != worst)][:MAX_LANES]
    begin, end = window(edges, worst, TICKS)
    labels = ["delivered", "superseded", "lost"]
    figure, (ax,) = style.panels(1, 0.2 + 0.42 * len(lanes), lines=1)
    for lane, link in enumerate(lanes):
        _draw_lane(ax, edges, link, float(lane), (begin, end))
    style.time_axis(ax, begin, end)
    ax.set_ylim(len(lanes) - 0.15, -0.2)
    names = [edges.name(link).replace(" ", "") for link in lanes]
    fits = max(map(len, names)) <= NAMED_LETTERS
    ax.set_yticks(np.arange(len(lanes)) + 0.35, names if fits else [str(i + 1) for i in range(len(lanes))])
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    handles = [
        Line2D([], [], color=style.ACCENT, marker="o", markersize=2.5, linewidth=0.8),
        Line2D([], [], color=style.WARM, marker="o", markersize=2.5, markerfacecolor="white", linewidth=0.8),
        Line2D([], [], color=style.INK, marker="x", markersize=3.5, linestyle="none", markeredgewidth=0.8),
    ]
    style.legend(figure, handles, labels)
    text = f"Every message around the largest age of the worst edge, {edges.name(worst)}"
    text += ", and on other edges to the same receiver" if len(lanes) > 1 else ""
    text += ": from the tick at which it left (above) to its arrival (below); a cross where it was lost."
    if not fits:
        text += f" Top to bottom: {edges.names(lanes)}."
    return figure, text


def window(edges: Edges, link: int, ticks: int) -> tuple[float, float]:
    """From a little before the largest age at ticks builds up, in seconds: so many ticks, or all there are."""
    ages = ages_at_ticks(edges.logs[link], edges.span)
    period = edges.span.period_ns
    peak = int(np.argmax(ages))
    built = peak - int(ages[peak]) // period  # the tick of the sample that was last known
    length = min(ticks, edges.span.n_ticks)
    room = length - (peak - built)
    wanted = built - room // 3 if room > 6 else peak - length * 5 // 6
    first = int(np.clip(wanted, 0, edges.span.n_ticks - length))
    return first * period / 1e9, (first + length) * period / 1e9


def _draw_lane(axes: Axes, edges: Edges, link: int, top: float, shown: tuple[float, float]) -> None:
    log, period, (begin, end) = edges.logs[link], edges.span.period_ns, shown
    sent, bottom = log.sent * period / 1e9, top + 0.7
    arrival = log.arrival_ns / 1e9
    style_of = ((Fate.DELIVERED, style.ACCENT, style.ACCENT), (Fate.SUPERSEDED, style.WARM, "white"))
    axes.hlines((top, bottom), begin, end, color="#C4C4C4", linewidth=0.6, zorder=1)
    for fate, colour, face in style_of:
        chosen = (log.fate == fate) & (arrival >= begin) & (sent < end)
        x = np.stack((sent[chosen], arrival[chosen]))
        axes.plot(x, np.array([[top], [bottom]]) + 0 * x, color=colour, linewidth=0.6, zorder=2)
        axes.plot(
            *(arrival[chosen], np.full(chosen.sum(), bottom), "o"),
            color=colour,
            markerfacecolor=face,
            markersize=2.2,
            markeredgewidth=0.5,
            zorder=3,
        )
    lost = (log.fate == Fate.LOST) & (sent >= begin) & (sent < end)
    axes.plot(
        *(sent[lost], np.full(lost.sum(), top), "x"),
        color=style.INK,
        markersize=3.0,
        markeredgewidth=0.7,
        zorder=3,
    )
