"""How far the agents are from agreeing, on a logarithmic scale: the rate of convergence is a slope."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, Scene, Signal
from network.messages import Floats

SMALLEST = 1e-16
"""Beyond the resolution of a float next to 1, nothing is drawn."""


def draw_disagreement(scene: Scene) -> tuple[Figure, str]:
    """Largest deviation over agents and elements: of positions, of velocities, of velocity estimates."""
    curves = _curves(scene)
    labels = [label for _, _, label, _ in curves]
    figure, (ax,) = style.panels(1, 1.7, lines=style.legend_lines(labels))
    handles = []
    for colour, dashes, _, values in curves:
        shown = np.where(values > SMALLEST, values, np.nan)
        handles += ax.semilogy(scene.time, shown, color=colour, linestyle=dashes)
    incidents = _incidents(scene)
    for begin, end in incidents:
        ax.axvspan(begin, end, color=style.WARM, alpha=0.12, linewidth=0)
    style.time_axis(ax, float(scene.time[0]), float(scene.time[-1]))
    ax.set_ylabel("largest deviation")
    low, high = np.log10(ax.get_ylim())
    if high - low < 2:  # fewer than two powers of ten inside: their labels alone would say nothing of the scale
        ax.set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))
    ax.yaxis.set_major_locator(LogLocator(numticks=9))
    ax.yaxis.set_minor_formatter(NullFormatter())  # labels such as 3 x 10^0 are too wide for the margin
    style.legend(figure, handles, labels)
    centre = "the mean over agents" if scene.reference_velocity is None else "the desired velocity"
    text = "Largest deviation over all agents and elements, in the units of the signals: of positions from the first"
    text += f" agent's, of velocities and of their estimates from {centre}."
    if incidents:
        text += " Shaded: an edge was older than the design assumed."
    return figure, text


def _incidents(scene: Scene) -> list[tuple[float, float]]:
    if len(scene.edges) == 0 or scene.results.n_ticks < 2:
        return []
    period = scene.results.period_ns / 1e9
    return [(first * period, stop * period) for first, stop, _ in scene.edges.incidents]


def _curves(scene: Scene) -> list[tuple[str, object, str, Floats]]:
    """Colour, dashes, label and values (n_times,) of every curve there is data for."""
    curves: list[tuple[str, object, str, Floats]] = []
    reasons = []
    target = r"\bar{v}" if scene.reference_velocity is None else "v_d"
    for role, colour, dashes, formula in (
        ("position", style.ACCENT, "solid", r"$|p_1 - p_i|$"),
        ("velocity", style.WARM, (0, (4, 1)), rf"$|v_i - {target}|$"),
        ("estimate", style.GREEN, (0, (1, 1)), rf"$|\hat{{v}}_i - {target}|$"),
    ):
        try:
            signal = scene.several(role)
        except NotDrawn as reason:
            reasons.append(str(reason))
            continue
        curves.append((colour, dashes, formula, largest_deviation(scene, signal, role)))
    if not curves:
        raise NotDrawn(reasons[0])
    return curves


def largest_deviation(scene: Scene, signal: Signal, role: str) -> Floats:
    """Largest of the `deviations` over the agents; (n_times,)."""
    largest: Floats = deviations(scene, signal, role).max(axis=1)
    return largest


def deviations(scene: Scene, signal: Signal, role: str) -> Floats:
    """Largest magnitude over the elements of each agent's deviation; (n_times, n_agents).

    Positions count from the first agent; velocities and estimates from the reference, or without one from the mean over
    agents at the time. (Of the leaderless scheme the final velocity is known only at the end.)
    """
    centre = signal.values[:, :1]
    if role != "position":
        reference = scene.reference_velocity
        centre = signal.values.mean(axis=1, keepdims=True) if reference is None else reference
    deviation: Floats = np.abs(signal.values - centre).max(axis=2)
    return deviation
