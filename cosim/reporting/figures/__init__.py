"""The figures of a report, one module per subject. Importing this imports matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from matplotlib.figure import Figure

from cosim.reporting.edges import Edges
from cosim.reporting.figures.age import draw_age
from cosim.reporting.figures.channel import draw_channel
from cosim.reporting.figures.delays import draw_delays
from cosim.reporting.figures.disagreement import draw_disagreement
from cosim.reporting.figures.fit import Compared, draw_fitted_delays, draw_fitted_losses, draw_log
from cosim.reporting.figures.front import draw_front
from cosim.reporting.figures.graph import draw_graph
from cosim.reporting.figures.heat import draw_heat
from cosim.reporting.figures.lateness import draw_lateness
from cosim.reporting.figures.losses import draw_losses
from cosim.reporting.figures.scene import NotDrawn, Scene
from cosim.reporting.figures.signals import (
    parameter_estimates,
    relative_positions,
    relative_velocities,
    velocity_estimates,
)
from cosim.reporting.figures.timeline import draw_timeline
from cosim.results import Results

Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Entry(Generic[Subject]):
    """A figure that a page may have.

    Attributes:
        name: of its files.
        title: on the page.
        draw: the figure and its caption; raises `NotDrawn` where it does not apply.
    """

    name: str
    title: str
    draw: Callable[[Subject], tuple[Figure, str]]


def _of_a_run(entry: Entry[Edges]) -> Entry[Scene]:
    return Entry(entry.name, entry.title, lambda scene: entry.draw(scene.edges))


_AGE = Entry("age", "Age of information", draw_age)
HEAT = Entry("heat", "Age of information over time", draw_heat)
_TIMELINE = Entry("timeline", "Deliveries", draw_timeline)
_NETWORK = (
    Entry("delays", "One-way delay", draw_delays),
    Entry("losses", "Losses in a row", draw_losses),
    Entry("front", "Assumption 1", draw_front),
)

CHANNEL = (_TIMELINE, _AGE, *_NETWORK)
"""Of a channel that is played alone."""

FITTED: tuple[Entry[Compared], ...] = (
    Entry("log", "The log", draw_log),
    Entry("delays", "One-way delay", draw_fitted_delays),
    Entry("losses", "Losses in a row", draw_fitted_losses),
)
"""Of a log and the profile that was fitted to it."""

FIGURES: tuple[Entry[Scene], ...] = (
    Entry("graph", "Interconnection graph", draw_graph),
    Entry("channel", "Input and output of a communication channel", draw_channel),
    Entry("positions", "Relative positions", relative_positions),
    Entry("velocities", "Relative velocities", relative_velocities),
    Entry("estimates", "Velocity estimates", velocity_estimates),
    Entry("disagreement", "Disagreement", draw_disagreement),
    *map(_of_a_run, (_AGE, HEAT, _TIMELINE, *_NETWORK)),
    Entry("parameters", "Parameter estimates", parameter_estimates),
)
PACED = (Entry("lateness", "Lateness against the wall clock", draw_lateness),)


def figures_of(results: Results) -> tuple[Entry[Scene], ...]:
    """The figures that a run of its kind may have."""
    return FIGURES if results.realtime is None else FIGURES + PACED


__all__ = ["CHANNEL", "FIGURES", "FITTED", "HEAT", "PACED", "Entry", "NotDrawn", "Scene", "figures_of"]
