"""One-way delay: which share of the messages has arrived so long after it left."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, need_messages
from cosim.reporting.words import number
from network.messages import Floats
from network.traffic import QUANTILES, one_way_delays

MAX_POINTS = 1500
"""Of a curve: more than a column has pixels."""

WIDE = 30.0
"""If the 99.5 % quantile is so many times the 0.5 % one, the axis is logarithmic."""


def draw_delays(edges: Edges) -> tuple[Figure, str]:
    """The distribution function of the delay, a curve per channel; what is lost never arrives."""
    need_messages(edges)
    groups = edges.by_channel
    delays = {name: _delays(edges, links) for name, links in groups.items()}
    everything = np.concatenate([values for values, _ in delays.values()])
    if not len(everything):
        raise NotDrawn("Nothing arrived: there is no delay to show.")
    labels = [*groups] if len(groups) > 1 else []
    figure, (axes,) = style.panels(1, 1.5, lines=style.legend_lines(labels))
    handles = []
    for colour, (values, settled) in zip(style.channel_colours(len(groups)), delays.values(), strict=True):
        handles += axes.plot(*distribution(values, settled), color=colour, linewidth=0.9)
    style.legend(figure, handles if labels else [], labels)
    delay_axis(axes, everything)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("share of messages")
    text = "Share of the messages that have arrived so long after they left; what is lost never does."
    if len(groups) == 1:
        marks = np.quantile(everything, QUANTILES)
        text += f" Dashed: {_names(marks)} of those that arrived."
        for mark in marks:
            axes.axvline(mark, color=style.INK, linewidth=0.6, linestyle=(0, (4, 2)), zorder=1)
    return figure, text


def distribution(values: Floats, settled: int) -> tuple[Floats, Floats]:
    """Corners of the distribution function of (n,) values of which `settled - n` are infinite."""
    ordered = np.sort(values)
    rank = np.arange(1, len(ordered) + 1)
    if len(ordered) > MAX_POINTS:
        chosen = np.unique(np.linspace(0, len(ordered) - 1, MAX_POINTS).astype(np.int64))
        ordered, rank = ordered[chosen], rank[chosen]
    x = np.repeat(ordered, 2)
    y = np.concatenate(([0.0], np.repeat(rank / max(1, settled), 2)))[:-1]
    return x, y


def delay_axis(axes: Axes, values: Floats) -> None:
    """Horizontal, in milliseconds or seconds; logarithmic for what spreads widely."""
    low, high = np.quantile(values, (0.005, 0.995))
    if values.min() > 0 and high > WIDE * low:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.set_xlim(float(values.min()) / 1.1, float(values.max()) * 1.1)
    else:
        room = 0.05 * (values.max() - values.min()) or max(0.1 * float(values.max()), 1e-3)
        axes.set_xlim(max(0.0, float(values.min()) - room), float(values.max()) + room)
        axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.labelpad = 2
    style.seconds_axis(axes.xaxis, "one-way delay", float(values.max()))


def _delays(edges: Edges, links: list[int]) -> tuple[Floats, int]:
    """Of what arrived over some edges; and how many messages' fate is known."""
    values = np.concatenate([one_way_delays(edges.logs[link], edges.span) for link in links])
    return values, len(values) + sum(edges.traffic[link].lost for link in links)


def _names(marks: Floats) -> str:
    names = ("median", *(f"{100 * q:g} %" for q in QUANTILES[1:]))
    return ", ".join(f"{name} {number(float(mark), 's', 3)}" for name, mark in zip(names, marks, strict=True))
