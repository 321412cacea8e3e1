"""The columns of the trajectories: what every recorded scalar is called, and which agents record it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.plan import AgentPlan


def scalar_names(variable: str, shape: tuple[int, ...]) -> list[str]:
    """`plant.p[1]`, `plant.p[2]`, or `x[1,1]`, `x[1,2]`, …, row-major and counted from 1, as FMI writes them.

    A variable of shape () keeps its name.
    """
    if not shape:
        return [variable]
    indices = itertools.product(*(range(1, length + 1) for length in shape))
    return [f"{variable}[{','.join(map(str, index))}]" for index in indices]


def arriving_names(agent: AgentPlan) -> tuple[str, ...]:
    """The scalars of one row of an agent, as they arrive."""
    return tuple(name for variable, port in agent.record for name in scalar_names(variable, port.variable.shape))


@dataclass(frozen=True)
class Columns:
    """Where every recorded scalar of one tick goes.

    A tick arrives as one flat vector: agent by agent, each in the order of its `AgentPlan.record`. It is kept agent by
    agent with the scalars of an agent in the order of the columns.

    Attributes:
        names: all columns, in the order in which the agents name them first.
        of_agent: per agent, the columns that it records, in the order of `names`.
        source: (width,) position in the vector that arrives of every number that is kept; None if all are, in place.
        positions: (n_columns, n_agents) position in the kept vector, -1 where an agent does not record a column.
    """

    names: tuple[str, ...]
    of_agent: tuple[tuple[str, ...], ...]
    source: NDArray[np.int64] | None
    positions: NDArray[np.int64]

    @property
    def width(self) -> int:
        """Numbers kept per tick."""
        return sum(map(len, self.of_agent))

    @classmethod
    def of(cls, agents: Sequence[AgentPlan]) -> Columns:
        """The union of what the agents record."""
        return cls.of_names([arriving_names(agent) for agent in agents])

    @classmethod
    def of_names(cls, arriving: Sequence[Sequence[str]]) -> Columns:
        """The same, from the names of the scalars that arrive of each agent."""
        names = tuple(dict.fromkeys(itertools.chain.from_iterable(arriving)))
        rank = {name: i for i, name in enumerate(names)}
        source: list[int] = []
        positions = np.full((len(names), len(arriving)), -1, dtype=np.int64)
        of_agent = []
        offset = 0
        for a, recorded in enumerate(arriving):
            place = {name: offset + i for i, name in enumerate(recorded)}
            kept = tuple(sorted(place, key=rank.__getitem__))
            for name in kept:
                positions[rank[name], a] = len(source)
                source.append(place[name])
            of_agent.append(kept)
            offset += len(recorded)
        in_place = source == list(range(offset))
        return cls(names, tuple(of_agent), None if in_place else np.array(source, dtype=np.int64), positions)
