"""How large the coupling error is: the scenario is played with twice as many micro steps first, and compared.

Every interval between two events gets twice as many, however short it is: where arrivals cut steps, half of the
longest step would change little, or nothing.

Nothing is asked of a component for this, not even to save its state, and the network is the same in both plays, since
every draw is keyed. For a method of order p the difference is (1 - 2^-p) of the error of the longer step, to leading
order (Richardson; Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I, II.4). What is meant is the error
of the whole run, of all agents together, in what is recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.agents.transfers import target_of
from cosim.components.component import Floats
from cosim.errors import CosimError, RunEndedError
from cosim.plan import AgentPlan, Method, Plan, Port
from cosim.recording.columns import arriving_names
from cosim.running.inline import run
from network.messages import Fates
from network.units import format_duration

if TYPE_CHECKING:
    from cosim.running.watching import Watch

POOR = 0.01
"""An error of more than so much of a variable's range is worth a warning."""

_MOST_NUMBERS = 1 << 23


@dataclass(frozen=True)
class AgentError:
    """The largest error of an agent, relative to the range of the variable in this run.

    Attributes:
        variable: `component.variable`, with the element's index where it is an array.
        error: in the variable's unit.
        relative: to the variable's range.
        time: at which it was found, in seconds.
    """

    agent: str
    variable: str
    error: float
    relative: float
    time: float

    def __str__(self) -> str:
        return f"{self.error:.2g} in {self.variable} of agent {self.agent}, {100 * self.relative:.2g} % of its range"


def order(agent: AgentPlan) -> int | None:
    """Of convergence, where the step is fixed and can be halved; `midpoint` has 1 where inputs jump at arrivals."""
    coupling = agent.coupling
    if coupling.grid or coupling.control:
        return None
    return 1 if coupling.method is Method.MIDPOINT and _inputs_may_jump(agent) else coupling.order


def _inputs_may_jump(agent: AgentPlan) -> bool:
    """Whether what is heard feeds straight through to an output that a component reads."""
    heard = (*agent.mailbox.values.values(), agent.mailbox.stamp, agent.mailbox.time)
    jumping = {target_of(port) for port in heard if port is not None} if agent.neighbours else set()
    reached = 0
    while reached < len(jumping):
        reached = len(jumping)
        jumping |= {target_of(x.target) for x in agent.connections if _depends_on(x.source, jumping)}
    return any(target_of(x.target) in jumping for x in agent.connections)


def _depends_on(output: Port, inputs: Set[tuple[int, str]]) -> bool:
    behind = {name for component, name in inputs if component == output.component}
    return not behind.isdisjoint(behind if output.variable.dependencies is None else output.variable.dependencies)


class Estimate:
    """An observer of a run that compares it with one of half the step; `prepare` comes before all else.

    Args:
        plan: that is run.

    Raises:
        CosimError: it cannot be played twice.
    """

    def __init__(self, plan: Plan) -> None:
        if plan.bridge.subscribe and plan.bridge.replay is None:
            raise CosimError("--estimate-error plays a scenario twice; what comes from outside comes but once")
        if plan.bridge.subscribe:
            raise CosimError("--estimate-error is not for runs that replay what came from outside")
        self._plan = plan
        self._orders = [order(agent) for agent in plan.agents]
        if not any(self._orders):
            raise CosimError("--estimate-error halves fixed steps, and no agent has one that can be halved")
        self._columns = [arriving_names(agent) for agent in plan.agents]
        width = sum(map(len, self._columns))
        self._stride = 1 + (plan.ticks + 1) * width // _MOST_NUMBERS
        self._finer: list[Floats] = []
        self._most, self._at = np.zeros(width), np.zeros(width, np.int64)
        self._low, self._high = np.full(width, np.inf), np.full(width, -np.inf)

    def prepare(self, stop_requested: Callable[[], bool], watch: Watch | None = None) -> None:
        """Play it with twice as many micro steps.

        Raises:
            CosimError: a component failed.
            Interrupted: `stop_requested` said so.
        """
        with suppress(RunEndedError):  # as many ticks as there are will be compared
            run(_halved(self._plan), [_Keeper(self._finer, self._stride)], stop_requested, watch=watch)

    def tick(self, tick: int, row: Floats) -> None:
        if tick % self._stride or tick // self._stride >= len(self._finer):
            return
        difference = np.abs(row - self._finer[tick // self._stride])
        larger = difference > self._most
        self._most[larger] = difference[larger]
        self._at[larger] = tick
        np.minimum(self._low, row, out=self._low)
        np.maximum(self._high, row, out=self._high)

    def fates(self, fates: Fates) -> None:
        """The same in both."""

    def errors(self) -> list[AgentError]:
        """Of each agent that records something and whose step was halved, the largest error."""
        found, first = [], 0
        for agent, columns, p in zip(self._plan.agents, self._columns, self._orders, strict=True):
            part = slice(first, first + len(columns))
            first += len(columns)
            if p is None or not columns:
                continue
            errors = self._most[part] / (1.0 - 0.5**p)
            ranges = self._high[part] - self._low[part]
            relative = np.divide(errors, ranges, out=np.zeros_like(errors), where=ranges > 0.0)
            worst = int(np.argmax(relative))
            time = float(self._at[part][worst]) * self._plan.period
            found.append(AgentError(agent.name, columns[worst], float(errors[worst]), float(relative[worst]), time))
        return found

    def account(self) -> list[Mapping[str, Any]]:
        """For the manifest."""
        return [vars(error) for error in self.errors()]

    def warnings(self) -> Iterator[str]:
        """About the agents whose steps are too long."""
        for error in self.errors():
            if error.relative > POOR:
                coupling = next(agent.coupling for agent in self._plan.agents if agent.name == error.agent)
                step, shorter = format_duration(coupling.step_ns), format_duration(max(1, coupling.step_ns // 4))
                yield (
                    f"agent {error.agent}: the estimated error of {error.variable} is {100 * error.relative:.2g} % of "
                    f"its range, at t = {error.time:.9g} s; the step {step} is too long for {coupling.method}: try "
                    f'`--set coupling.step="{shorter}"`'
                )


class _Keeper:
    """An observer that keeps every so many rows."""

    def __init__(self, rows: list[Floats], stride: int) -> None:
        self._rows = rows
        self._stride = stride

    def tick(self, tick: int, row: Floats) -> None:
        if tick % self._stride == 0:
            self._rows.append(row)

    def fates(self, fates: Fates) -> None:
        """Not needed."""


def _halved(plan: Plan) -> Plan:
    agents = []
    for agent in plan.agents:
        coupling = agent.coupling
        if order(agent) is not None:
            coupling = replace(coupling, refinement=2)
        agents.append(replace(agent, coupling=coupling))
    return replace(plan, agents=tuple(agents))
