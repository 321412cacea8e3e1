"""Input and output of a communication channel: what one agent sent, and what another one held of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, Scene
from cosim.results import Results
from network.messages import Fate, Floats
from network.units import to_seconds

WINDOW_S = 15.0
"""Seconds shown: single messages can be told apart."""


@dataclass(frozen=True)
class Transmitted:
    """One published number of an edge.

    Attributes:
        link: index of the edge.
        scalar: `component.variable[1]` as it was recorded at the sender.
        unit: of the variable, or None.
        samples: (n_ticks,) what the sender published.
    """

    link: int
    scalar: str
    unit: str | None
    samples: Floats


def draw_channel(scene: Scene) -> tuple[Figure, str]:
    """φ(t) at the sender, and φ̃ as the receiver has it from the arrivals."""
    results = scene.results
    what = _choose(results, int(WINDOW_S * 1e9) // results.period_ns + 1)
    log = scene.edges.logs[what.link]
    until_ns = min(scene.edges.span.end_ns, round(WINDOW_S * 1e9))
    arrived = (log.arrival_ns >= 0) & (log.arrival_ns < until_ns)
    fresh, stale = arrived & (log.fate == Fate.DELIVERED), arrived & (log.fate == Fate.SUPERSEDED)

    labels = ["sent", "held", "arrived", "superseded"]
    figure, (ax,) = style.panels(1, 1.45, lines=style.legend_lines(labels))
    time = np.arange(len(what.samples)) * results.period_ns / 1e9
    handles = ax.plot(time, what.samples, color=style.FAINT, linewidth=1.1)
    arrival = log.arrival_ns[fresh] / 1e9
    values = what.samples[log.stamp[fresh]]
    order = np.argsort(log.arrival_ns[fresh], kind="stable")
    end = to_seconds(until_ns)
    handles += ax.step(
        np.append(arrival[order], end),
        np.append(values[order], values[order][-1:] if len(values) else np.nan),
        where="post",
        color=style.ACCENT,
        linewidth=0.7,
    )
    handles += ax.plot(arrival, values, "o", color=style.ACCENT, markersize=2.2, markeredgewidth=0)
    handles += ax.plot(
        log.arrival_ns[stale] / 1e9,
        what.samples[log.stamp[stale]],
        "o",
        markerfacecolor="none",
        markeredgecolor=style.WARM,
        markersize=2.4,
        markeredgewidth=0.5,
    )
    style.time_axis(ax, 0.0, end)
    unit = f" ({what.unit.replace('.', '·')})" if what.unit and what.unit != "1" else ""
    ax.set_ylabel(f"{what.scalar}{unit}")
    style.legend(figure, handles, labels)
    share = len(log.stamp[fresh | stale]) / max(1, int(until_ns // results.period_ns))
    text = f"Input and output of the channel {scene.edges.name(what.link)}: {what.scalar} as sampled by the sender, and"
    text += f" what the receiver holds of it. In the {end:g} s shown, {share:.0%} of the samples arrived."
    return figure, text


def _choose(results: Results, n_ticks: int) -> Transmitted:
    """The first edge whose sender recorded what it published, and the first number of that."""
    if len(results.links) == 0:
        raise NotDrawn("Nobody hears anybody: there is no channel to show.")
    if results.n_ticks < 2:
        raise NotDrawn("The run ended before its second tick.")
    for link, sender in enumerate(results.links.sender.tolist()):
        for variable in results.manifest["agents"][sender]["publish"].values():
            shape = results.variables.get(variable)
            if shape is None or 0 in shape:
                continue
            scalar = f"{variable}[{','.join('1' for _ in shape)}]" if shape else variable
            samples = results.array(scalar, stop=n_ticks)[:, sender]
            if not np.isnan(samples).all():
                return Transmitted(link, scalar, results.unit(variable), samples)
    raise NotDrawn("No sender recorded a variable that it published.")
