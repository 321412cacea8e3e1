"""What the figures look at: the signals of a run under their roles, at no more points than a figure can show."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cosim.reporting.edges import Edges
from cosim.reporting.figures.style import agent_colours
from cosim.results import Results
from network.messages import Floats

MAX_POINTS = 2000
"""Along the time axis: more than the pixels of a column printed at 500 dpi."""

MAX_AXES = 6
"""Elements of a vector that get a panel of their own."""


class NotDrawn(Exception):  # noqa: N818 - not an error: most runs lack something that some figure shows
    """A figure does not apply to a run; the text is a sentence for the reader of the report."""


def need_messages(edges: Edges) -> None:
    """What every figure of a network needs.

    Raises:
        NotDrawn: there is no edge, or no tick at which a message could arrive.
    """
    if len(edges) == 0:
        raise NotDrawn("Nobody hears anybody: there is no channel to show.")
    if edges.results.n_ticks < 2:
        raise NotDrawn("The run ended before its second tick.")


@dataclass(frozen=True)
class Signal:
    """One vector quantity of the agents that record it.

    Attributes:
        name: `component.variable`.
        unit: as declared, or None.
        agents: (n_agents,) indices into the run's agents.
        values: (n_times, n_agents, size)
    """

    name: str
    unit: str | None
    agents: list[int]
    values: Floats

    @property
    def size(self) -> int:
        """Elements of the vector that are shown."""
        return min(int(self.values.shape[2]), MAX_AXES)

    @property
    def unit_text(self) -> str:
        """` (rad)`, or nothing."""
        return f" ({self.unit.replace('.', '·')})" if self.unit and self.unit != "1" else ""


class Scene:
    """A run, as the figures see it.

    Args:
        results: of the run.
    """

    def __init__(self, results: Results) -> None:
        self.results = results
        self.edges = Edges(results)
        self.every = max(1, -(-results.n_ticks // MAX_POINTS))
        self.time = results.times(self.every)
        self.colours = agent_colours(len(results.agents))
        self._signals: dict[str, Signal] = {}

    @property
    def agents(self) -> tuple[str, ...]:
        """Names."""
        return self.results.agents

    @cached_property
    def reference_velocity(self) -> Floats | None:
        """(m,) v_d, where the scenario gives it."""
        reference = self.results.analysis["reference_velocity"]
        return None if reference is None else np.array(reference, dtype=np.float64)

    def signal(self, role: str) -> Signal:
        """The variable that plays a role of the analysis: `position`, `velocity`, `estimate` or `parameters`.

        Raises:
            NotDrawn: there is none, or nothing was recorded.
        """
        variable = self.results.analysis[role]
        if variable is None:
            raise NotDrawn(f"The scenario does not say which variable is the {role} (analysis.{role}).")
        if variable not in self._signals:
            self._signals[variable] = self._read(variable)
        return self._signals[variable]

    def several(self, role: str) -> Signal:
        """As `signal`, for figures that compare agents.

        Raises:
            NotDrawn: as `signal`, or fewer than two agents record it.
        """
        signal = self.signal(role)
        if len(signal.agents) < 2:
            raise NotDrawn(f"Only one agent records {signal.name}: there is nothing to compare it with.")
        return signal

    def _read(self, variable: str) -> Signal:
        if variable not in self.results.variables:
            raise NotDrawn(f"{variable} was not recorded.")
        if self.results.n_ticks < 2:
            raise NotDrawn("The run ended before its second tick.")
        values = self.results.array(variable, self.every)
        values = values.reshape(*values.shape[:2], -1)
        agents = np.flatnonzero(~np.isnan(values[0]).all(axis=-1)).tolist()
        return Signal(variable, self.results.unit(variable), agents, values[:, agents])


def short_name(agent: str, otherwise: str) -> str:
    """A name that can be an index in a formula, or what stands for it."""
    return agent if len(agent) <= 3 and agent.isalnum() else otherwise
