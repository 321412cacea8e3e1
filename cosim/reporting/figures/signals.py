"""Signals of all agents over time, one panel per element: relative positions and velocities, estimates, parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.reporting.figures import style
from cosim.reporting.figures.scene import MAX_AXES, Scene, Signal, short_name
from network.messages import Floats

_DASHED: dict[str, Any] = {"color": style.INK, "linewidth": 0.9, "linestyle": (0, (4, 2))}


def relative_positions(scene: Scene) -> tuple[Figure, str]:
    """p_1 - p_i of every other agent i."""
    position = scene.several("position")
    first = scene.agents[position.agents[0]]
    text = f"Positions of the other agents relative to agent {first}."
    return _relative(scene, position, "p"), text + _reading(scene, position)


def relative_velocities(scene: Scene) -> tuple[Figure, str]:
    """v_1 - v_i of every other agent i, and v_1 - v_d where v_d is given."""
    velocity = scene.several("velocity")
    first = scene.agents[velocity.agents[0]]
    text = f"Velocities of the other agents relative to agent {first}"
    text += "." if scene.reference_velocity is None else "; dashed: the desired velocity relative to it."
    return _relative(scene, velocity, "v", scene.reference_velocity), text + _reading(scene, velocity)


def velocity_estimates(scene: Scene) -> tuple[Figure, str]:
    """The estimates v̂_i in force, and v_d where it is given."""
    estimate = scene.signal("estimate")
    reference = scene.reference_velocity
    names = [scene.agents[agent] for agent in estimate.agents]
    labels = _Labels(names, "" if reference is None else "$v_d$")
    figure, axes = style.panels(estimate.size, lines=labels.lines)
    colours = [scene.colours[agent] for agent in estimate.agents]
    for k, ax in enumerate(axes):
        handles = style.spread(ax, scene.time, estimate.values[:, :, k], colours, steps=True)
        if reference is not None:
            handles.append(ax.axhline(float(reference[k]), **_DASHED))
        ax.set_ylabel(rf"$[\hat{{v}}_i]_{k + 1}${estimate.unit_text}")
    _finish(scene, figure, axes, handles, labels)
    text = "Every agent's estimate of the common velocity"
    text += "." if reference is None else "; dashed: the desired velocity."
    return figure, text + _reading(scene, estimate)


def parameter_estimates(scene: Scene) -> tuple[Figure, str]:
    """The estimates θ̂_i of every agent's physical parameters."""
    parameters = scene.signal("parameters")
    labels = _Labels([scene.agents[agent] for agent in parameters.agents])
    height = 0.72 if parameters.size > 3 else 1.0
    figure, axes = style.panels(parameters.size, height, lines=labels.lines, gap=0.09)
    colours = [scene.colours[agent] for agent in parameters.agents]
    for k, ax in enumerate(axes):
        handles = style.spread(ax, scene.time, parameters.values[:, :, k], colours)
        ax.set_ylabel(rf"$[\hat{{\theta}}_i]_{k + 1}${parameters.unit_text}")
        ax.locator_params(axis="y", nbins=4, steps=[1, 2, 5, 10])  # never 2.5: its labels are a digit wider
    _finish(scene, figure, axes, handles, labels)
    text = "Every agent's estimates of its physical parameters; they need not converge to the true values."
    return figure, text + _reading(scene, parameters)


def _relative(scene: Scene, signal: Signal, letter: str, reference: Floats | None = None) -> Figure:
    """The first agent's signal less every other agent's, and less the reference."""
    names = [scene.agents[agent] for agent in signal.agents]
    one = short_name(names[0], "1")
    extra = "$d$" if len(names) - 1 <= style.FEW else rf"${letter}_{{{one}}} - {letter}_d$"
    labels = _Labels(names[1:], "" if reference is None else extra)
    figure, axes = style.panels(signal.size, lines=labels.lines)
    colours = [scene.colours[agent] for agent in signal.agents[1:]]
    for k, ax in enumerate(axes):
        first = signal.values[:, :1, k]
        handles = style.spread(ax, scene.time, first - signal.values[:, 1:, k], colours)
        if reference is not None:
            handles += ax.plot(scene.time, first[:, 0] - reference[k], **_DASHED)
        ax.set_ylabel(rf"$[{letter}_{{{one}}} - {letter}_i]_{k + 1}${signal.unit_text}")
    _finish(scene, figure, axes, handles, labels)
    return figure


class _Labels:
    """Of the legend: the agents if they are few, the bands if they are many, nothing in between; and one more line."""

    def __init__(self, agents: Sequence[str], extra: str = "") -> None:
        self.title = "$i$ =" if len(agents) <= style.FEW else ""
        self.texts = list(agents) if len(agents) <= style.FEW else []
        if len(agents) > style.MANY:
            self.texts = list(style.BAND_LABELS)
        self.texts += [extra] if extra else []

    @property
    def lines(self) -> int:
        return style.legend_lines(self.texts, self.title)


def _finish(scene: Scene, figure: Figure, axes: Sequence[Axes], handles: Sequence[Any], labels: _Labels) -> None:
    """The time axis, aligned labels and the legend; of the handles, the last ones have labels."""
    style.time_axis(axes[-1], float(scene.time[0]), float(scene.time[-1]))
    figure.align_ylabels(axes)
    style.legend(figure, handles[len(handles) - len(labels.texts) :], labels.texts, labels.title)


def _reading(scene: Scene, signal: Signal) -> str:
    """How the panels are to be read, and whom they do not show."""
    n_agents, size = signal.values.shape[1:]
    text = ""
    if n_agents > style.MANY:
        text += " Bands: quantiles over agents."
    elif n_agents > style.FEW:
        text += " One line per agent, dark to light in the order of the file."
    if size > MAX_AXES:
        text += f" The first {MAX_AXES} of {size} elements."
    if n_agents < len(scene.agents):
        text += f" {n_agents} of {len(scene.agents)} agents: the others record no {signal.name} of this shape."
    return text
