"""How long the steps of a Co-Simulation coupling are, where a tolerance is given. Pure, given the components.

With components that can save their state a step is made once, taken back, and made as two of half the length. The
difference of all that changes continuously (`cosim.agents.watched`) estimates the error (Richardson; Hairer, Nørsett,
Wanner, Solving Ordinary Differential Equations I, II.4): divided by 2^p - 1, p the order of the coupling, it is that of
the two halves, which are kept. A step whose error exceeds the tolerance is taken back and made shorter.

Without saved states nothing is taken back. Half the difference between what the outputs are at the end of a step and
what the others were given for that instant (held, or extrapolated by `midpoint`) is the mean error of their inputs; it
is taken to act upon their outputs over the step, at a rate of one per period. It only says how long the next step is,
so that the first one after an arrival, where inputs may jump, is the shortest.

Steps are whole nanoseconds, and depend on nothing but the values: runs stay the same wherever they run. They never go
beyond the next event. Where an output jumps, no step is short enough: at most as many steps of the least length as a
jump needs to pass through all components are let pass in a row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from cosim.agents.extrapolation import LONGER, middle_weight
from cosim.agents.memory import LoopState
from cosim.agents.watched import watched_outputs
from cosim.agents.wiring import Wiring
from cosim.components.component import Component, Floats
from cosim.errors import ComponentError, DiscardedStepError
from cosim.plan import ControlPlan, CouplingPlan, Method
from network.units import format_duration, to_seconds

Step = Callable[[float, float], None]

SAFETY = 0.9
_LEAST_FACTOR, _AFTER_REJECTION = 0.1, 0.5
_GROWTH, _CAREFUL_GROWTH = 5.0, 2.0
_FIRST_NS = 1_000_000


@dataclass(frozen=True)
class StepAccount:
    """What became of an agent's steps.

    Attributes:
        agent: its name.
        method: `step doubling`, or `change of the inputs`, which is weaker.
        steps: that were made; one of step doubling counts once.
        rejected: steps that were taken back.
        shortest, longest: of the steps made, in seconds; those that an event cut short count too.
        ratio: the largest estimated error of a step made, in parts of what the tolerances allow.
        error: that error, in the unit of `variable`.
        variable: `component.variable`, whose error it is; empty where nothing is watched.
        time: of the end of that step, in seconds.
    """

    agent: str
    method: str
    steps: int
    rejected: int
    shortest: float
    longest: float
    ratio: float
    error: float
    variable: str
    time: float

    @staticmethod
    def of(tree: Mapping[str, Any]) -> StepAccount:
        """An account that was JSON on its way.

        Raises:
            ValueError: it is none.
        """
        kinds: dict[str, tuple[type, ...]] = {"str": (str,), "int": (int,), "float": (int, float)}
        wanted = {field.name: kinds[str(field.type)] for field in fields(StepAccount)}
        if tree.keys() != wanted.keys() or not all(isinstance(tree[name], kind) for name, kind in wanted.items()):
            raise ValueError("it is no account of steps")
        return StepAccount(**tree)

    def __str__(self) -> str:
        worst = f"; largest error of a step {self.error:.2g} in {self.variable}" if self.variable else ""
        beyond = f", {self.ratio:.2g} times the tolerance" if self.ratio > 1.0 else ""
        return f"{self.steps} steps, {self.rejected} rejected{worst}{beyond}"


class StepControl:
    """Makes the steps of one agent.

    Args:
        control: tolerances and bounds.
        coupling: whose steps they are.
        wiring: of the agent.
        components: of the agent.
        state: what the loop remembers; the length proposed for the next step is in it.
        read: reads what is watched and not connected.
    """

    def __init__(
        self,
        control: ControlPlan,
        coupling: CouplingPlan,
        wiring: Wiring,
        components: Sequence[Component],
        state: LoopState,
        *,
        read: Callable[[], None],
    ) -> None:
        self._control = control
        self._components = components
        self._state = state
        self._largest_ns = coupling.step_ns
        self._least_ns = min(control.least_ns, coupling.step_ns)
        self._midpoint = coupling.method is Method.MIDPOINT
        self._order = 2 if self._midpoint else 1
        self._growth = LONGER if self._midpoint else _GROWTH
        self._read = read
        self._names, watched = watched_outputs(wiring, components, coupling)
        self._watched = np.array(watched, dtype=np.intp)
        self._owner, self._continuous = wiring.owner, wiring.continuous
        self._coarse = np.empty(0), 0.0  # signals at the start of the last whole step, and its length
        self._let_pass = 0
        self._steps = self._rejected = 0
        self._shortest_ns, self._longest_ns = coupling.step_ns, 0
        self._worst = -1.0, 0.0, -1, 0.0  # ratio, error, signal, time

    def advance(self, step: Step, start_ns: int, end_ns: int) -> None:
        """From one event to the next.

        Args:
            step: makes one of the coupling, from a time and of a length in seconds.
            start_ns: the one.
            end_ns: the other.

        Raises:
            ComponentError: a component failed, or no step that is long enough keeps to the tolerances.
        """
        if not self._state.steps[1]:
            self._state.steps[1] = min(self._largest_ns, _FIRST_NS)
            self.jump()
        one = self._doubled if self._control.rollback else self._compared
        while start_ns < end_ns:
            self._state.time[0] = to_seconds(start_ns)
            start_ns += one(step, start_ns, end_ns)

    def jump(self) -> None:
        """Inputs may jump here. What cannot be taken back begins carefully."""
        if not self._control.rollback:
            self._state.steps[1] = self._least_ns

    def account(self, agent: str) -> StepAccount:
        """So far, of the agent with this name."""
        ratio, error, signal, time = self._worst
        return StepAccount(
            agent=agent,
            method="step doubling" if self._control.rollback else "change of the inputs",
            steps=self._steps,
            rejected=self._rejected,
            shortest=to_seconds(min(self._shortest_ns, self._longest_ns)),
            longest=to_seconds(self._longest_ns),
            ratio=max(0.0, ratio),
            error=error,
            variable=self._names.get(signal, ""),
            time=time,
        )

    # --- with saved states ------------------------------------------------------------------------------------------
    def _doubled(self, step: Step, start_ns: int, end_ns: int) -> int:
        """A step that is made twice, and again until it is good; its length."""
        with Saved(self._components, self._state) as saved:
            rejected = False
            while True:
                length_ns = self._length(end_ns - start_ns)
                try:
                    errors = self._twice(step, start_ns, length_ns, saved)
                    ratio, worst = self._compare(errors, saved.signals)
                except DiscardedStepError:
                    if length_ns <= self._least_ns:
                        raise
                    ratio, worst = math.inf, -1
                if ratio <= 1.0 or (length_ns <= self._least_ns and self._passes(ratio, worst)):
                    break
                rejected = True
                self._rejected += 1
                saved.restore()
                self._propose(length_ns * min(_AFTER_REJECTION, self._factor(ratio)))
        self._coarse = saved.signals, to_seconds(length_ns)
        growth = 1.0 if rejected else self._growth
        self._accept(start_ns + length_ns, length_ns, ratio, worst, errors, growth)
        return length_ns

    def _twice(self, step: Step, start_ns: int, length_ns: int, saved: Saved) -> Floats:
        """Whole, taken back, and in halves: the error of the latter in every output watched."""
        start, half_ns = to_seconds(start_ns), length_ns // 2
        if not half_ns:  # 1 ns, between two events
            step(start, to_seconds(length_ns))
            return np.zeros(len(self._watched))
        before, length = self._coarse
        if length:  # extrapolate as a coupling that makes whole steps would
            self._state.previous[:] = before
            self._state.steps[0] = length
        step(start, to_seconds(length_ns))
        self._read()
        whole = self._state.signals[self._watched]
        saved.restore()
        step(start, to_seconds(half_ns))
        step(to_seconds(start_ns + half_ns), to_seconds(length_ns - half_ns))
        self._read()
        errors: Floats = np.abs(self._state.signals[self._watched] - whole) / (2.0**self._order - 1.0)
        return errors

    # --- without ----------------------------------------------------------------------------------------------------
    def _compared(self, step: Step, start_ns: int, end_ns: int) -> int:
        """A step after which the inputs are compared with what they should have been; its length."""
        length_ns, state = self._length(end_ns - start_ns), self._state
        length, before = to_seconds(length_ns), state.signals.copy()
        given = before
        if self._midpoint:
            weight = 2.0 * middle_weight(length, state.steps[0].item())
            given = np.where(self._continuous, before + weight * (before - state.previous), before)
        step(to_seconds(start_ns), length)
        change = np.abs(state.signals[self._watched] - given[self._watched])
        errors = 0.5 * change * (length_ns / self._control.period_ns)
        ratio, worst = self._compare(errors, before)
        if ratio > 1.0 and length_ns <= self._least_ns:
            self._passes(ratio, worst)
        self._accept(start_ns + length_ns, length_ns, ratio, worst, errors, _CAREFUL_GROWTH)
        return length_ns

    # --- lengths ----------------------------------------------------------------------------------------------------
    def _length(self, rest_ns: int) -> int:
        """Of the next step: as proposed, or what leaves no scrap before the next event."""
        proposed_ns = int(self._state.steps[1])
        if rest_ns <= proposed_ns:
            return rest_ns
        return (rest_ns + 1) // 2 if rest_ns < 2 * proposed_ns else proposed_ns

    def _propose(self, length_ns: float) -> None:
        self._state.steps[1] = min(self._largest_ns, max(self._least_ns, math.floor(length_ns)))

    def _factor(self, ratio: float) -> float:
        """How much longer a step would just keep to the tolerances; the error of a step is of order p + 1."""
        if ratio == 0.0:
            return _GROWTH
        return max(_LEAST_FACTOR, SAFETY * math.pow(ratio, -1.0 / (self._order + 1)))

    def _compare(self, errors: Floats, before: Floats) -> tuple[float, int]:
        """The largest error in parts of what the tolerances allow, and among which output watched it is."""
        if not errors.size:
            return 0.0, -1
        size = np.maximum(np.abs(before[self._watched]), np.abs(self._state.signals[self._watched]))
        ratios = errors / (self._control.absolute_tolerance + self._control.relative_tolerance * size)
        worst = int(np.argmax(ratios))
        return float(ratios[worst]), worst

    def _passes(self, ratio: float, worst: int) -> bool:
        """Whether a step of the least length may pass in spite of its error, as a jump needs some to go through."""
        self._let_pass += 1
        if self._let_pass <= len(self._components) + 1:
            return True
        signal = int(self._watched[worst])
        raise ComponentError(
            self._components[self._owner[signal]].name,
            f"the coupling's step is at the least, {format_duration(self._least_ns)}, and the estimated error of "
            f"{self._names[signal]} is still {ratio:.3g} times what the tolerances allow; write a larger `tolerance` "
            "or `absolute_tolerance` under `coupling`, a smaller `least_step`, or look for an output that jumps again "
            "and again between events",
        )

    def _accept(  # noqa: PLR0917
        self, end_ns: int, length_ns: int, ratio: float, worst: int, errors: Floats, growth: float
    ) -> None:
        """Count a step, and propose the next one; one cut short by an event says only that it should not be longer."""
        self._steps += 1
        self._shortest_ns, self._longest_ns = min(self._shortest_ns, length_ns), max(self._longest_ns, length_ns)
        if ratio <= 1.0:
            self._let_pass = 0
        if worst >= 0 and ratio > self._worst[0]:
            self._worst = ratio, float(errors[worst]), int(self._watched[worst]), to_seconds(end_ns)
        factor, proposed_ns = min(growth, self._factor(ratio)), int(self._state.steps[1])
        wanted = length_ns * factor
        self._propose(max(wanted, proposed_ns) if factor >= 1.0 and length_ns < proposed_ns else wanted)


class Saved:
    """All components and signals as they are, to go back to; a context that frees what was saved.

    Attributes:
        signals: as they were.
    """

    def __init__(self, components: Sequence[Component], state: LoopState) -> None:
        self._components = components
        self._state = state
        self.signals = state.signals.copy()
        self._previous, self._step = state.previous.copy(), state.steps[0].item()
        self._saved: list[object] = []

    def __enter__(self) -> Saved:
        try:
            for component in self._components:
                self._saved.append(component.save())
                component.goes_back = True
        except BaseException:
            self._forget()
            raise
        return self

    def restore(self) -> None:
        """Go back, as often as wanted."""
        for component, saved in zip(self._components, self._saved, strict=True):
            component.restore(saved)
        self._state.signals[:] = self.signals
        self._state.previous[:] = self._previous
        self._state.steps[0] = self._step

    def __exit__(self, *exception: object) -> None:
        self._forget()

    def _forget(self) -> None:
        for component, saved in zip(self._components, self._saved, strict=False):
            component.goes_back = False
            component.forget(saved)


def manifest(accounts: Iterable[StepAccount]) -> list[dict[str, Any]]:
    """For the manifest of a run."""
    return [vars(account) for account in accounts]
