"""Age of information of every edge over time, as a map."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.scene import need_messages
from network.freshness import ages_at_ticks
from network.messages import Floats, Ints

MAX_ROWS = 300
"""Edges that are shown: the worst, if there are more."""

NAMED_ROWS = 40
"""Up to as many edges are named; beyond, receivers are, where there is room."""

NAMED_LETTERS = 12
"""Of the longest name that fits beside the map."""

MAX_BINS = 300
"""Along the time axis."""

_COLOURS = LinearSegmentedColormap.from_list("age", ["#F7FBFF", "#A2C8E1", "#3F83BC", "#08306B"])


def draw_heat(edges: Edges) -> tuple[Figure, str]:
    """Edges, grouped by receiver, against time; the colour is the age read at ticks."""
    results = edges.results
    need_messages(edges)
    shown = sorted(edges.worst_first[:MAX_ROWS])  # the plan's order is by receiver
    values, width = binned(edges, shown)
    names = [edges.name(link).replace(" ", "") for link in shown]
    named = len(shown) <= NAMED_ROWS and max(map(len, names)) <= NAMED_LETTERS
    height = float(np.clip(0.085 * len(shown), 0.7 if named else 1.2, 4.2))
    broken = any(len(edges.breaks[link]) for link in shown)
    labels = ["older than assumed"] if broken else []
    figure, (ax,) = style.panels(1, height, lines=style.legend_lines(labels))
    if (grid := ax.get_gridspec()) is not None:
        grid.update(right=0.895)  # for the label of the colour bar
    end = edges.span.n_ticks * results.period_ns / 1e9
    largest = float(values.max())
    image = ax.imshow(
        values,
        aspect="auto",
        interpolation="nearest",
        cmap=_COLOURS,
        norm=PowerNorm(0.5, 0.0, largest or 1.0),
        extent=(0.0, values.shape[1] * width, len(shown) - 0.5, -0.5),
    )
    bar = figure.colorbar(image, ax=ax, pad=0.02, fraction=0.05, aspect=max(8.0, 12 * height))
    bar.ax.yaxis.set_major_locator(MaxNLocator(5))
    bar.set_label("age (s)", labelpad=2)
    bar.outline.set_linewidth(0.4)
    bar.ax.tick_params(width=0.5, size=2)
    thickness = float(np.clip(72 * height / len(shown) / 4, 0.5, 1.5))
    for row, link in enumerate(shown):
        spans = edges.breaks[link] * results.period_ns / 1e9
        ax.hlines(np.full(len(spans), row + 0.3), spans[:, 0], spans[:, 1], color=style.WARM, linewidth=thickness)
    style.legend(figure, [Line2D([], [], color=style.WARM, linewidth=1.5)] if broken else [], labels)
    style.time_axis(ax, 0.0, end)
    ax.grid(visible=False)
    _name_rows(ax, edges.results.links.receiver[shown], names if named else [])
    text = "The largest age read at a tick, per edge and time; edges with the same receiver lie together."
    if len(shown) < len(edges):
        text += f" Of {len(edges)} edges the worst {len(shown)} are shown."
    if broken:
        text += " Orange: the age exceeded the h* that was assumed of the edge, so that Assumption 1 was broken."
    return figure, f"{text} The colours follow the root of the age."


def binned(edges: Edges, shown: list[int]) -> tuple[Floats, float]:
    """(n_shown, n_bins) largest age at the ticks of each bin, in seconds; and the length of a bin in seconds."""
    n_ticks = edges.span.n_ticks
    per_bin = -(-n_ticks // MAX_BINS)
    begins = np.arange(0, n_ticks, per_bin)
    rows = [np.maximum.reduceat(ages_at_ticks(edges.logs[link], edges.span), begins) for link in shown]
    return np.array(rows) / 1e9, per_bin * edges.span.period_ns / 1e9


def _name_rows(axes: Axes, receiver: Ints, names: list[str]) -> None:
    changes = np.flatnonzero(np.diff(receiver)) + 1
    n = len(receiver)
    if names:
        axes.set_yticks(range(n), names, fontsize=5.5)
        axes.tick_params(axis="y", length=0, pad=1.5)
    else:
        axes.set_yticks([])
        axes.set_ylabel(f"{n} edges, by receiver")
    if len(changes) <= 60:
        axes.hlines(changes - 0.5, *axes.get_xlim(), color="white", linewidth=1.2 if n <= NAMED_ROWS else 0.4)
