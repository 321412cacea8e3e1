"""What the micro-step loops remember, in one array per kind of thing for all agents of a process."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.components.component import Floats


@dataclass(frozen=True)
class LoopState:
    """What a loop remembers of an agent from one call to the next; both loops work on the same memory.

    Attributes:
        signals: (n_signals,) see `Wiring`.
        previous: (n_signals,) signals at the start of the previous micro step (`midpoint`).
        steps: (2,) length of the previous micro step in seconds (`midpoint`) or, after a state event, the longest that
            the next may be, in whole nanoseconds (`joint`; 0 for any); and proposed length of the next one, in seconds
            (`dormand-prince`) or whole nanoseconds (`cosim.agents.step_control`); 0 before the first.
        next_event: (n_components,) time of each component's next time event in seconds, infinity for none.
        time: (1,) the time reached, for error messages.
    """

    signals: Floats
    previous: Floats
    steps: Floats
    next_event: Floats
    time: Floats


class LoopMemory:
    """The `LoopState` of many agents in one array each, agent by agent.

    Args:
        sizes: per agent, the numbers of its signals and of its components.

    Attributes:
        first_signal: (n_agents + 1,) where each agent's signals begin, and the end. One number that stays zero follows.
        first_component: (n_agents + 1,) likewise.
        signals, previous, steps, next_event, time: see `LoopState`.
    """

    def __init__(self, sizes: Sequence[tuple[int, int]]) -> None:
        ends = np.cumsum([(0, 0), *sizes], axis=0, dtype=np.int64)
        self.first_signal, self.first_component = ends[:, 0], ends[:, 1]
        self.signals = np.zeros(ends[-1, 0] + 1)
        self.previous = np.zeros(ends[-1, 0])
        self.steps = np.zeros((len(sizes), 2))
        self.next_event = np.full(ends[-1, 1], math.inf)
        self.time = np.zeros(len(sizes))

    def state(self, agent: int) -> LoopState:
        """That of one agent."""
        (i, c), (j, d) = ((int(self.first_signal[k]), int(self.first_component[k])) for k in (agent, agent + 1))
        return LoopState(
            self.signals[i:j],
            self.previous[i:j],
            self.steps[agent],
            self.next_event[c:d],
            self.time[agent : agent + 1],
        )
