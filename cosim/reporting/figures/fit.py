"""A measured log beside the profile that was fitted to it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.delays import delay_axis, distribution
from cosim.reporting.figures.losses import draw_geometric, draw_survival, run_axes
from cosim.reporting.figures.scene import NotDrawn
from network.messages import Fate
from network.traffic import loss_runs, one_way_delays

MAX_POINTS = 4000
"""Of the log over time: as many messages are drawn, evenly chosen."""

_DASHED: Any = (0, (4, 2))


class Compared(Protocol):
    """A log, and a profile that was played on many edges."""

    @property
    def measured(self) -> Edges:
        """The log."""

    @property
    def smooth(self) -> Edges:
        """The profile."""


def draw_log(fit: Compared) -> tuple[Figure, str]:
    """Delay of every message over time; ticks along the bottom where messages were lost."""
    edges = fit.measured
    (log,), period = edges.logs, edges.span.period_ns
    every = max(1, -(-len(log.sent) // MAX_POINTS))
    lost = log.sent[log.fate == Fate.LOST] * period / 1e9
    arrived = np.flatnonzero(log.fate != Fate.LOST)[::every]
    labels = ["arrived", "lost"] if len(lost) else ["arrived"]
    figure, (axes,) = style.panels(1, 1.3, lines=1)
    time = log.sent[arrived] * period / 1e9
    delay = log.arrival_ns[arrived] / 1e9 - time
    axes.plot(time, delay, ".", color=style.ACCENT, markersize=1.8, markeredgewidth=0)
    top = 1.06 * float(delay.max())
    axes.vlines(lost, -0.07 * top, -0.015 * top, color=style.WARM, linewidth=0.5)
    style.time_axis(axes, 0.0, edges.span.n_ticks * period / 1e9)
    axes.set_ylim(-0.09 * top, top)
    style.seconds_axis(axes.yaxis, "delay", top)
    handles = [
        Line2D([], [], color=style.ACCENT, marker=".", markersize=4, linestyle="none"),
        Line2D([], [], color=style.WARM, marker="|", markersize=4, linestyle="none"),
    ]
    style.legend(figure, handles[: len(labels)], labels)
    text = "The log: the one-way delay of every message, and below when messages were lost."
    if every > 1:
        text += f" One in {every} of those that arrived is shown."
    return figure, text + " A profile fits a log that looks alike all along."


def draw_fitted_delays(fit: Compared) -> tuple[Figure, str]:
    """Distribution functions of what arrived."""
    labels = ["log", "fitted profile"]
    figure, (axes,) = style.panels(1, 1.5, lines=1)
    handles = []
    for edges, colour, line, width in ((fit.measured, style.ACCENT, "-", 1.3), (fit.smooth, style.INK, _DASHED, 0.8)):
        values = np.concatenate([one_way_delays(log, edges.span) for log in edges.logs])
        handles += axes.plot(*distribution(values, len(values)), color=colour, linestyle=line, linewidth=width)
        if edges is fit.measured:
            delay_axis(axes, values)
    style.legend(figure, handles, labels)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("share of arrived")
    return figure, "Share of the messages that arrived which had so short a delay, in the log and by the profile."


def draw_fitted_losses(fit: Compared) -> tuple[Figure, str]:
    """Runs of losses."""
    edges = fit.measured
    logged, model = (np.concatenate([loss_runs(log) for log in one.logs]) for one in (edges, fit.smooth))
    if not len(logged):
        raise NotDrawn("No message was lost.")
    labels = ["log", "fitted profile", "independent losses"]
    figure, (axes,) = style.panels(1, 1.3, lines=style.legend_lines(labels))
    (one,) = edges.traffic
    longest = int(logged.max())
    handles = [draw_survival(axes, logged, style.ACCENT)]
    lengths = np.arange(1, max(longest, 2) + 1)
    at_least = np.array([np.mean(model >= length) for length in lengths]) if len(model) else np.zeros(len(lengths))
    shown = at_least > 0
    handles += axes.plot(lengths[shown], at_least[shown], color=style.INK, linewidth=0.8, linestyle=_DASHED)
    handles.append(draw_geometric(axes, 1 - one.delivery_ratio, longest, style.FAINT))
    style.legend(figure, handles, labels)
    run_axes(axes, longest, 1 / len(logged))
    return figure, "Of the times at which messages were lost in a row, the share at which so many or more were."
