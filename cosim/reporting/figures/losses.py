"""Losses in a row: how often as many messages, or more, were lost one after the other."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, need_messages
from network.messages import Ints
from network.traffic import loss_runs


def draw_losses(edges: Edges) -> tuple[Figure, str]:
    """Of the runs of losses, the share that are so long or longer; for one channel beside independent losses."""
    need_messages(edges)
    groups = edges.by_channel
    runs = {name: np.concatenate([loss_runs(edges.logs[link]) for link in links]) for name, links in groups.items()}
    found = {name: values for name, values in runs.items() if len(values)}
    if not found:
        raise NotDrawn("No message was lost.")
    alone = len(groups) == 1
    labels = ["observed", "independent losses"] if alone else [*found]
    figure, (axes,) = style.panels(1, 1.3, lines=style.legend_lines(labels))
    handles = []
    for colour, (name, values) in zip(style.channel_colours(len(groups)), runs.items(), strict=True):
        if name in found:
            handles.append(draw_survival(axes, values, colour))
    longest = max(int(values.max()) for values in found.values())
    if alone:
        lost = sum(one.lost for one in edges.traffic)
        share = lost / sum(one.lost + one.delivered + one.superseded for one in edges.traffic)
        handles.append(draw_geometric(axes, share, longest))
    style.legend(figure, handles, labels)
    run_axes(axes, longest, min(1 / len(values) for values in found.values()))
    text = "Of the times at which messages were lost in a row, the share at which so many or more were."
    if alone:
        text += f" Dashed: what independent losses of {100 * share:.3g} % would give."
    if len(found) < len(groups):
        text += f" Nothing was lost on {', '.join(name for name in groups if name not in found)}."
    return figure, text


def draw_survival(axes: Axes, runs: Ints, colour: object) -> object:
    """The share of runs of at least each length that occurs."""
    lengths, counts = np.unique(runs, return_counts=True)
    at_least = np.cumsum(counts[::-1])[::-1] / len(runs)
    return axes.plot(
        lengths, at_least, "o-", drawstyle="steps-pre", color=colour, markersize=2.4, markeredgewidth=0, linewidth=0.8
    )[0]


def draw_geometric(axes: Axes, share: float, longest: int, colour: str = style.INK) -> object:
    """Runs of independent losses: each goes on with the probability of a loss."""
    lengths = np.arange(1, max(longest, 2) + 1)
    (line,) = axes.plot(lengths, share ** (lengths - 1.0), color=colour, linewidth=0.8, linestyle=(0, (4, 2)))
    return line


def run_axes(axes: Axes, longest: int, least: float) -> None:
    """Lengths against a logarithmic share, down to the least that was observed."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_ylim(min(0.5, least / 1.6), 1.3)
    axes.set_xlim(0.5, max(longest, 2) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.set_xlabel("losses in a row", labelpad=2)
    axes.set_ylabel("share of runs")
