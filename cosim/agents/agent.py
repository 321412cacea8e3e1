"""One agent: its components and the loop that advances them. Pure given its components.

Rule: nothing in here knows a clock, a socket, a thread or a process. What changes in its mailbox goes in; an in-process
run and a worker process make the same calls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cosim.agents.coupling import PythonLoop
from cosim.agents.mailbox import Updates
from cosim.agents.memory import LoopState
from cosim.agents.step_control import StepAccount
from cosim.agents.wiring import Wiring
from cosim.components.component import Component, Floats
from cosim.errors import ComponentError, DiscardedStepError, EndRequestedError, RunEndedError, RunError
from cosim.plan import AgentPlan
from network.units import format_duration


class Agent:
    """The call order is `initialise`, then `take` and `advance` for every tick; at the end `terminate`.

    A native agent is advanced by `cosim.kernel.NativeBlock` instead, on the same state. What an agent publishes and
    what is recorded of it are signals, which `cosim.agents.group` gathers.

    Args:
        plan: what the agent consists of.
        wiring: of the agent.
        period_ns: T.
        components: opened and with their start values set, in the plan's order.
        state: zeros, to be filled.
    """

    def __init__(
        self, plan: AgentPlan, wiring: Wiring, period_ns: int, components: Sequence[Component], state: LoopState
    ) -> None:
        self.plan = plan
        self.wiring = wiring
        self.components = components
        self.state = state
        self._period_ns = period_ns
        self._loop = PythonLoop(wiring, components, plan.coupling, state)
        wiring.fill(state.signals, plan)
        self._external = [(x.subscription, at) for x, at in zip(plan.external, wiring.external, strict=True)]

    def initialise(self, stop_ns: int) -> None:
        """Bring all components to tick 0.

        Args:
            stop_ns: end of the run, which some FMUs want to know.

        Raises:
            RunError: a component failed.
        """
        try:
            self._loop.initialise(0, stop_ns)
        except ComponentError as error:
            raise self.failure(error, begun=False) from error

    def take(self, tick: int, taken: Mapping[int, Floats]) -> None:
        """Let values from outside take effect, at an event of its own; inputs that are not among them keep theirs.

        Args:
            tick: at which they were taken.
            taken: new values by subscription.

        Raises:
            RunError: a component failed.
        """
        own = [(positions, taken[index]) for index, positions in self._external if index in taken]
        if not own:
            return
        for positions, values in own:
            self.state.signals[positions] = values
        try:
            self._loop.listen(tick * self._period_ns)
        except ComponentError as error:
            raise self.failure(error) from error

    def advance(self, tick: int, updates: Updates, index: int = 0) -> None:
        """From `tick` to the next one.

        Args:
            tick: at which the agent is.
            updates: what changes in mailboxes; each takes effect at its exact time of arrival.
            index: of the agent among those whose mailboxes change.

        Raises:
            RunError: a component failed, or (`RunEndedError`) asked for the end.
        """
        try:
            self._loop.advance(tick * self._period_ns, (tick + 1) * self._period_ns, updates, index)
        except ComponentError as error:
            raise self.failure(error) from error

    def account(self) -> StepAccount | None:
        """What became of its steps, where they are controlled."""
        return None if self._loop.control is None else self._loop.control.account(self.plan.name)

    def terminate(self) -> None:
        """End all components; safe after a failure, and twice."""
        for component in self.components:
            component.terminate()

    def failure(self, error: ComponentError, *, begun: bool = True) -> RunError:
        """What a component's failure means for the run; its wish to end is none once that has begun."""
        time = float(self.state.time[0])
        kind = RunEndedError if begun and isinstance(error, EndRequestedError) else RunError
        return kind(
            self.plan.name, error.component, time, error.message + (self._hint(error) if begun else ""), error.log
        )

    def _hint(self, error: ComponentError) -> str:
        """What may help: shorter steps, where one was discarded or where numbers are not finite."""
        if isinstance(error, DiscardedStepError):
            return self._hint_to_retry()
        if "not finite" not in f"{error.message} {error.log}":
            return ""
        coupling = self.plan.coupling
        if coupling.control is not None:
            tolerance = coupling.control.relative_tolerance
            return (
                f"; either the scenario is unstable, or a tolerance of {tolerance:g} is too large for the coupling "
                f"{coupling.method}: try `--set coupling.tolerance={tolerance / 100:g}`"
            )
        step, shorter = format_duration(coupling.step_ns), format_duration(coupling.step_ns // 10)
        return (
            f"; either the scenario is unstable, or a step of {step} is too long for the coupling {coupling.method}: "
            f'try `--set coupling.step="{shorter}"`'
        )

    def _hint_to_retry(self) -> str:
        coupling = self.plan.coupling
        can = all(component.description.can_get_and_set_state for component in self.components)
        if coupling.retries or coupling.control is not None or not can:
            return ""
        return "; `--set coupling.retries=6` tries it in halves"
