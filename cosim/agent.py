"""One agent: its components, its mailbox and the loop that advances them. Pure given its components.

Rule: nothing in here knows a clock, a socket, a thread or a process. Deliveries go in, samples come out; an in-process
run and a worker process make the same calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from cosim.components.component import Component, Floats
from cosim.coupling import LoopState, PythonLoop
from cosim.errors import ComponentError, RunError
from cosim.mailbox import Mailbox, Updates
from cosim.plan import AgentPlan, Loop
from cosim.wiring import wire
from network.messages import Deliveries, MessageLayout
from network.units import format_duration


class MicroSteps(Protocol):
    """What the Python loop and the native one have in common."""

    def advance(self, start_ns: int, end_ns: int, updates: Updates) -> None:
        """See `cosim.coupling.PythonLoop.advance`."""


class Agent:
    """The call order is `initialise`, then for every tick: `message`, `row`, `advance`; at the end `terminate`.

    Args:
        plan: what the agent consists of.
        layout: of the network's messages.
        period_ns: T.
        components: opened and with their start values set, in the plan's order.

    Every method raises `RunError` when a component fails.
    """

    def __init__(self, plan: AgentPlan, layout: MessageLayout, period_ns: int, components: Sequence[Component]) -> None:
        self.plan = plan
        self._period_ns = period_ns
        self._components = components
        self._mailbox = Mailbox(len(plan.neighbours), period_ns)
        wiring = wire(plan, layout)
        self._published = wiring.published
        self._recorded = wiring.recorded
        self._state = LoopState(wiring.initial_signals(plan), len(components))
        self._python_loop = PythonLoop(wiring, components, plan.coupling, self._state)
        self._loop: MicroSteps = self._python_loop
        if plan.coupling.loop is Loop.NATIVE:
            from cosim.kernel import NativeLoop

            self._loop = NativeLoop(wiring, components, plan.coupling, self._state)

    def initialise(self, stop_ns: int) -> None:
        """Bring all components to tick 0.

        Args:
            stop_ns: end of the run, which some FMUs want to know.
        """
        try:
            self._python_loop.initialise(0, stop_ns)
        except ComponentError as error:
            raise self._failure(error) from error

    def message(self) -> Floats:
        """What the agent publishes at the current tick, shape (width,); empty where nobody hears it."""
        return self._state.signals[self._published]

    def row(self) -> Floats:
        """What is recorded at the current tick, before the deliveries of this very instant take effect."""
        return self._state.signals[self._recorded]

    def advance(self, tick: int, deliveries: Deliveries) -> None:
        """From `tick` to the next one; deliveries take effect at their exact time of arrival."""
        updates = self._mailbox.accept(deliveries)
        try:
            self._loop.advance(tick * self._period_ns, (tick + 1) * self._period_ns, updates)
        except ComponentError as error:
            raise self._failure(error) from error

    def terminate(self) -> None:
        """End all components; safe after a failure, and twice."""
        for component in self._components:
            component.terminate()

    def _failure(self, error: ComponentError) -> RunError:
        time = float(self._state.time[0])
        return RunError(self.plan.name, error.component, time, error.message + self._hint(error), error.log)

    def _hint(self, error: ComponentError) -> str:
        """Numbers that are not finite: say which step would tell an unstable scenario from too long a step."""
        if "not finite" not in f"{error.message} {error.log}":
            return ""
        coupling = self.plan.coupling
        step, shorter = format_duration(coupling.step_ns), format_duration(coupling.step_ns // 10)
        return (
            f"; either the scenario is unstable, or a step of {step} is too long for the coupling {coupling.method}: "
            f'try `--set coupling.step="{shorter}"`'
        )
