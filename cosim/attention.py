"""What a process that carries agents is at, in memory that others can look at even while it is in native code."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cosim.plan import AgentPlan

TICK, AGENT, COMPONENT = 0, 1, 2
"""What the numbers are: the tick from which agents are being advanced; which agent of the process is being opened,
initialised or advanced, -1 for none; which of its components was called last, -1 for none yet."""

SIZE = 3


def idle() -> NDArray[np.int64]:
    """(3,) numbers of a process that is at nothing."""
    return np.array([0, -1, -1])


@dataclass(frozen=True)
class Spot:
    """An agent and one of its components, by their indices; None where there is none, or none yet."""

    agent: int | None = None
    component: int | None = field(default=None, compare=False)  # of two moments, it is the agent that counts

    @classmethod
    def of(cls, attended: NDArray[np.int64]) -> Spot:
        """The one that a process is at."""
        _, agent, component = attended.tolist()
        return cls(None if agent < 0 else agent, None if agent < 0 or component < 0 else component)

    def names(self, agent: AgentPlan) -> str:
        """That of the component; of all components of the agent if it is not known which."""
        names = [component.name for component in agent.components]
        return ", ".join(names) if self.component is None else names[self.component]

    def within(self, agent: AgentPlan) -> str:
        """`agent 3, component plant`, or `agent 3 (plant, controller)`."""
        names = self.names(agent)
        return f"agent {agent.name} ({names})" if self.component is None else f"agent {agent.name}, component {names}"


NOWHERE = Spot()
