"""The figures of a report, one module per subject. Importing this imports matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure

from cosim.reporting.figures.age import draw_age
from cosim.reporting.figures.channel import draw_channel
from cosim.reporting.figures.disagreement import draw_disagreement
from cosim.reporting.figures.graph import draw_graph
from cosim.reporting.figures.heat import draw_heat
from cosim.reporting.figures.lateness import draw_lateness
from cosim.reporting.figures.scene import NotDrawn, Scene
from cosim.reporting.figures.signals import (
    parameter_estimates,
    relative_positions,
    relative_velocities,
    velocity_estimates,
)
from cosim.reporting.figures.timeline import draw_timeline
from cosim.results import Results


@dataclass(frozen=True)
class Entry:
    """A figure that a report may have.

    Attributes:
        name: of its files.
        title: in the report.
        draw: the figure and its caption; raises `NotDrawn` where it does not apply.
    """

    name: str
    title: str
    draw: Callable[[Scene], tuple[Figure, str]]


FIGURES = (
    Entry("graph", "Interconnection graph", draw_graph),
    Entry("channel", "Input and output of a communication channel", draw_channel),
    Entry("positions", "Relative positions", relative_positions),
    Entry("velocities", "Relative velocities", relative_velocities),
    Entry("estimates", "Velocity estimates", velocity_estimates),
    Entry("disagreement", "Disagreement", draw_disagreement),
    Entry("age", "Age of information", draw_age),
    Entry("heat", "Age of information over time", draw_heat),
    Entry("timeline", "Deliveries", draw_timeline),
    Entry("parameters", "Parameter estimates", parameter_estimates),
)
PACED = (Entry("lateness", "Lateness against the wall clock", draw_lateness),)


def figures_of(results: Results) -> tuple[Entry, ...]:
    """The figures that a run of its kind may have."""
    return FIGURES if results.realtime is None else FIGURES + PACED


__all__ = ["FIGURES", "PACED", "Entry", "NotDrawn", "Scene", "figures_of"]
