"""A Model Exchange component as one of Co-Simulation: CVODE of SUNDIALS integrates it between communication points.

Variable order and step (BDF), for stiff models; Hindmarsh et al., "SUNDIALS", ACM Transactions on Mathematical Software
31 (2005). Events are handled on the way: time events and step events, and state events where CVODE finds a root or an
event indicator has another sign than before, which inputs that jump at a communication point can cause as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Component, Floats, Interface, Value, Variable
from cosim.errors import ComponentError

EVENTS_PER_STEP = 1000
"""How many events may happen within one communication step."""

SHORTEST = 1e-12
"""Seconds: CVODE's shortest step; still shorter ways are rounding, and are not integrated."""

INTERNAL_STEPS = 10_000
"""How many steps of its own CVODE may make up to the next event or communication point."""


class _NoInput:
    """FMPy's solver applies inputs, which are held here."""

    def apply(self, time: float) -> None: ...


class CvodeComponent(Component):
    """Co-Simulation of a component that offers Model Exchange.

    Args:
        model: open for Model Exchange.
        tolerance: relative; absolute as a part of a state's nominal value.
    """

    interface = Interface.CO_SIMULATION
    uses_events = True

    def __init__(self, model: Component, tolerance: float) -> None:
        self.name = model.name
        self.description = model.description
        self._model = model
        self._tolerance = tolerance
        self._solver: Any = None
        self._next_event = math.inf
        self._indicators = np.empty(0)  # as they were when the last event, or step towards the next one, was over
        self._disturbed = True  # inputs or states have jumped: what CVODE remembers is void
        self._error: ComponentError | None = None

    # --- values -----------------------------------------------------------------------------------------------------
    def get(self, variable: Variable) -> Floats:
        return self._model.get(variable)

    def set(self, variable: Variable, values: Floats) -> None:
        self._disturbed = True
        self._model.set(variable, values)

    def start(self, variable: Variable, values: Sequence[Value]) -> None:
        self._model.start(variable, values)

    # --- life cycle -------------------------------------------------------------------------------------------------
    def attend(self, attended: NDArray[np.int64], place: int) -> None:
        self._model.attend(attended, place)

    @property
    def last_log(self) -> str | None:
        return self._model.last_log

    def await_open(self) -> None:
        self._model.await_open()

    def enter_initialization(self, start_time: float, stop_time: float) -> None:
        self._model.enter_initialization(start_time, stop_time)

    def exit_initialization(self) -> None:
        self._model.exit_initialization()

    def terminate(self) -> None:
        self._solver = None
        self._model.terminate()

    # --- events -----------------------------------------------------------------------------------------------------
    def enter_event_mode(self) -> None:
        self._model.enter_event_mode()

    def update_discrete_states(self) -> float | None:
        event = self._model.update_discrete_states()
        self._next_event = math.inf if event is None else event
        return event

    def enter_step_mode(self) -> None:
        self._model.enter_continuous_time_mode()
        self._indicators = self._get_indicators()
        self._disturbed = True

    # --- steps ------------------------------------------------------------------------------------------------------
    def step(self, time: float, step: float) -> None:
        end, events = time + step, 0
        event = self._has_crossed()
        while time < end:
            if not (event or time >= self._next_event):
                time, event = self._advance(time, min(self._next_event, end))
                event |= self._has_crossed()
            if event or time >= self._next_event:
                self._handle_event(time)
                event, events = False, events + 1
                if events > EVENTS_PER_STEP:
                    raise ComponentError(
                        self.name, f"had more than {EVENTS_PER_STEP} events within one step: it chatters"
                    )

    def _handle_event(self, time: float) -> None:
        self._model.set_time(time)  # by rounding, a step may begin later than the one before has ended
        self.enter_event_mode()
        self.update_discrete_states()
        if self._next_event <= time:  # it was this one
            self._next_event = math.inf
        self.enter_step_mode()

    def _has_crossed(self) -> bool:
        """Whether an event indicator has changed its sign since this was asked, or an event was over."""
        before, self._indicators = self._indicators, self._get_indicators()
        return bool(np.any((before > 0.0) != (self._indicators > 0.0)))

    def _get_indicators(self) -> Floats:
        return self._model.event_indicators() if self._model.n_indicators else np.empty(0)

    def _advance(self, time: float, stop: float) -> tuple[float, bool]:
        """Up to a time, or the first root of an event indicator; where it is, and whether it wants an event."""
        if stop - time < SHORTEST:
            self._model.set_time(stop)
            return stop, False
        if self._solver is None:
            self._solver = self._create(time)
        elif self._disturbed:
            self._solver.reset(time)
        self._disturbed = False
        try:
            root, _, reached = self._solver.step(time, stop)
        except (RuntimeError, TypeError) as error:  # the latter where CVODE gives no reason
            reason = str(error).rpartition(": ")[2]  # before it is where in SUNDIALS it was noticed
            raise self._error or ComponentError(self.name, f"CVODE gave up: {reason}") from error
        if self._error is not None:
            raise self._error
        self._model.set_time(reached)
        bad = np.flatnonzero(~np.isfinite(self._model.get_states()))
        if bad.size:
            raise ComponentError(self.name, f"continuous state {bad[0] + 1} is not finite")
        wants_event = self._model.completed_step()
        return (reached if root else stop), bool(root or wants_event)

    def _create(self, time: float) -> Any:
        from cosim.components.fmu.library import cvode_solver

        model = self._model
        solver = cvode_solver(
            self.name,
            lambda: self._error is not None,
            SHORTEST,
            nx=model.n_states,
            nz=model.n_indicators,
            get_x=self._into(model.get_states),
            set_x=self._from(model.set_states),
            get_dx=self._into(model.derivatives),
            get_z=self._into(model.event_indicators),
            get_nominals=self._into(model.nominals),
            set_time=self._guarded(model.set_time),
            input=_NoInput(),
            startTime=time,
            relativeTolerance=self._tolerance,
            maxNumSteps=INTERNAL_STEPS,
        )
        if self._error is not None:
            raise self._error
        return solver

    def _guarded(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """A call out of native code, through which no exception passes: it is kept, and nothing is called any more."""

        def guarded(*arguments: Any) -> Any:
            if self._error is None:
                try:
                    return call(*arguments)
                except ComponentError as error:
                    self._error = error
            return None

        return guarded

    def _into(self, call: Callable[[], Floats]) -> Callable[[Any, int], None]:
        """Fill memory of CVODE with what a call returns; with NaN, on which it gives up, after an error."""
        guarded = self._guarded(call)

        def fill(pointer: Any, size: int) -> None:
            values = guarded()
            np.ctypeslib.as_array(pointer, (size,))[:] = np.nan if values is None else values

        return fill

    def _from(self, call: Callable[[Floats], None]) -> Callable[[Any, int], None]:
        guarded = self._guarded(call)
        return lambda pointer, size: guarded(np.ctypeslib.as_array(pointer, (size,)).copy())
