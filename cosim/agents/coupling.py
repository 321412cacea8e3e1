"""The micro-step loop of one agent, in Python: how its components advance together from one tick to the next.

It serves agents with a component in Python and is the reference for the native loop (`cosim.kernel`), which carries out
the same floating-point operations in the same order and so gives the same bits.

Between two events (ticks, arrivals, events of a component) the interval is cut into equal micro steps no longer than
the coupling's step. On a grid, for components that accept steps of one length only, arrivals wait for the end of a
step. Over a micro step from t to t + h:

- `joint`: all states are integrated together: Runge-Kutta 4, Dormand-Prince 5(4) or Euler. A step in which an event
  indicator changes its sign is made again up to there (`cosim.agents.crossings`).
- `jacobi`: every component steps with the others' outputs at t held.
- `gauss-seidel`: in the file's order; a component sees the newest outputs, held.
- `midpoint`: in the file's order. Outputs of components that step later are extrapolated to the middle of the step from
  their last two values (`cosim.agents.extrapolation`); those that are not continuous are held. A component that reads
  components that have stepped already makes two half steps, the first with their outputs at t, the second with those at
  t + h: their mean is right to second order, and its own outputs at t + h see the inputs at t + h, so that direct
  feedthrough costs no order. It needs no optional FMI capability.

With a tolerance, `cosim.agents.step_control` chooses how long the steps of the last three are.

A component with a micro step of its own makes several in each of these steps, its inputs held.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cosim.agents import algebraic
from cosim.agents.crossings import (
    STATE_EVENTS_PER_STEP,
    bracket,
    cautious_step,
    chattering,
    crossed,
    first_crossing,
    less_cautious,
)
from cosim.agents.extrapolation import middle_weight
from cosim.agents.mailbox import Updates
from cosim.agents.memory import LoopState
from cosim.agents.starting import settle
from cosim.agents.step_control import StepControl
from cosim.agents.transfers import Direction, Transfer
from cosim.agents.wiring import AlgebraicLoop, Wiring, takes_in_event_mode
from cosim.components.component import Component, Floats
from cosim.errors import ComponentError
from cosim.plan import CouplingPlan, Integrator, Method
from network.units import first_nanosecond, to_seconds

_SET = Direction.SET
EVENT_ITERATIONS = 100
"""How often the components of an agent may change each other's inputs at one instant."""


class PythonLoop:
    """The loop over any components."""

    def __init__(
        self, wiring: Wiring, components: Sequence[Component], coupling: CouplingPlan, state: LoopState
    ) -> None:
        self._wiring = wiring
        self._components = components
        self._coupling = coupling
        self._state = state
        self._signals = state.signals
        self._joint = coupling.method is Method.JOINT
        self._step = {
            Method.JACOBI: self._jacobi,
            Method.GAUSS_SEIDEL: self._gauss_seidel,
            Method.MIDPOINT: self._midpoint,
        }.get(coupling.method)
        control = coupling.control
        self.control = None
        if control is not None:
            read = partial(self._carry_out, [transfer for gets in wiring.watch for transfer in gets])
            self.control = StepControl(control, coupling, wiring, components, state, read=read)
        ends = np.cumsum([0, *(component.n_states for component in components)])
        self._states = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        self._discrete = [takes_in_event_mode(component, wiring.inputs[c]) for c, component in enumerate(components)]
        self._at_events, self._between_events = list(self._parts(wiring.propagate)), list(self._parts(wiring.follow))
        self._n_indicators = sum(component.n_indicators for component in components)
        self._indicators = np.empty(0)
        self._beyond = np.empty(0)
        self._chattering = 0

    # --- life cycle -------------------------------------------------------------------------------------------------
    def initialise(self, start_ns: int, stop_ns: int) -> None:
        """Initialise all components together, handle the events of the start and read the first sample."""
        wiring, signals = self._wiring, self._state.signals
        self._state.time[0] = to_seconds(start_ns)
        for component in self._components:
            component.enter_initialization(to_seconds(start_ns), to_seconds(stop_ns))
        self._carry_out(wiring.held)
        self._carry_out(wiring.listen)
        settle(wiring, self._components, signals, self._carry_out)
        for component in self._components:
            component.exit_initialization()
        if self._joint:
            self._iterate_events()
        else:
            self._leave_events()
            for gets in wiring.outputs:
                self._carry_out(gets)
        self._carry_out(wiring.sample)
        self._state.previous[:] = signals

    def advance(self, start_ns: int, end_ns: int, updates: Updates, agent: int = 0) -> None:
        """From one tick to the next, breaking at each arrival; afterwards the signals hold the sample of `end_ns`.

        Args:
            start_ns: the tick.
            end_ns: the next one.
            updates: what changes in mailboxes, in [start_ns, end_ns).
            agent: whose mailbox counts.

        Raises:
            ComponentError: a component failed, or a state or output is not finite.
        """
        time_ns = start_ns
        i, last = updates.ends[agent], updates.ends[agent + 1]
        rows = self._wiring.mailbox.rows
        while i < last:
            arrival_ns = self._effect_ns(start_ns, updates.arrival_ns[i])
            if arrival_ns >= end_ns:
                break
            self._integrate(time_ns, arrival_ns)
            while i < last and self._effect_ns(start_ns, updates.arrival_ns[i]) == arrival_ns:
                self._signals[rows[updates.slot[i]]] = updates.content[i]
                i += 1
            self._event(arrival_ns, listen=True)
            time_ns = arrival_ns
        self._integrate(time_ns, end_ns)
        self._event(end_ns, listen=False)
        self._carry_out(self._wiring.sample)
        if i < last:  # what waits for the end of the last micro step comes after the sample of the tick
            while i < last:
                self._signals[rows[updates.slot[i]]] = updates.content[i]
                i += 1
            self._event(end_ns, listen=True)

    def _effect_ns(self, start_ns: int, arrival_ns: int) -> int:
        """When an arrival takes effect: at once, or at the end of a micro step that must not be cut."""
        if not self._coupling.grid:
            return arrival_ns
        step_ns = self._coupling.step_ns
        return start_ns - (start_ns - arrival_ns) // step_ns * step_ns

    def listen(self, time_ns: int) -> None:
        """An event at which the inputs take what the mailbox and the outside have for them.

        Raises:
            ComponentError: a component failed, or an output is not finite.
        """
        self._event(time_ns, listen=True)

    # --- events -----------------------------------------------------------------------------------------------------
    def _event(self, time_ns: int, *, listen: bool) -> None:
        """A tick, an arrival or an event of a component. Co-Simulation components only get their new inputs."""
        self._state.time[0] = to_seconds(time_ns)
        for component in self._components:
            if self._joint or (listen and component.uses_events):
                component.enter_event_mode()
        if listen:
            self._carry_out(self._wiring.listen)
        if self._joint:
            self._iterate_events()
        elif listen:
            self._leave_events()
            if self.control is not None:
                self.control.jump()

    def _leave_events(self) -> None:
        """Co-Simulation: from Event Mode, where there is one, to Step Mode."""
        for component in self._components:
            if component.uses_events:
                component.update_discrete_states()
                component.enter_step_mode()

    def _iterate_events(self) -> None:
        """From Event Mode to Continuous-Time Mode: update discrete states until no connected value changes any more."""
        signals, components = self._state.signals, self._components
        _do(self._at_events)
        for _ in range(EVENT_ITERATIONS):
            for c, component in enumerate(components):
                event = component.update_discrete_states()
                self._state.next_event[c] = math.inf if event is None else event
            before = signals.copy()
            _do(self._at_events)
            if self._settled(before):
                break
        else:
            raise ComponentError(
                components[0].name, f"the event iteration did not settle within {EVENT_ITERATIONS} rounds"
            )
        for component in components:
            component.enter_continuous_time_mode()

    def _settled(self, before: Floats) -> bool:
        """Whether the signals are as they were; continuous ones, as far as a loop that was solved again can tell."""
        now = self._signals
        return bool(np.all((now == before) | (algebraic.close(now, before) & self._wiring.continuous)))

    # --- between events ---------------------------------------------------------------------------------------------
    def _integrate(self, start_ns: int, end_ns: int) -> None:
        """From one event to the next, breaking at time events of the components."""
        if self._step is not None:
            if start_ns < end_ns:
                if self.control is not None:
                    self.control.advance(self._step, start_ns, end_ns)
                else:
                    self._step_components(self._step, start_ns, end_ns)
            return
        events, since_ns = 0, start_ns
        while start_ns < end_ns:
            known_ns = self._next_stop(to_seconds(start_ns), end_ns)
            cautious_ns = int(self._state.steps[0].item())
            stop_ns = min(known_ns, start_ns + cautious_ns) if cautious_ns else known_ns
            self._located = self._scheduled = False
            reached_ns = self._integrate_states(start_ns, stop_ns)
            if self._located:
                if reached_ns - since_ns > self._coupling.step_ns:
                    events, since_ns = 0, reached_ns
                events += 1
                if events > STATE_EVENTS_PER_STEP:
                    raise self._chatters()
                self._state.steps[0] = cautious_step(self._coupling.step_ns)
            elif cautious_ns:
                self._state.steps[0] = less_cautious(cautious_ns, self._coupling.step_ns)
            if reached_ns < end_ns and (self._located or self._scheduled or reached_ns == known_ns):
                self._event(reached_ns, listen=False)
            start_ns = reached_ns

    def _next_stop(self, start: float, end_ns: int) -> int:
        """The first time event of a component after a time in seconds, when it is due, or the end."""
        stop_ns = end_ns
        for event in self._state.next_event.tolist():
            if start < event < to_seconds(stop_ns):
                stop_ns = first_nanosecond(event)
        return stop_ns

    def _integrate_states(self, start_ns: int, stop_ns: int) -> int:
        """From one event to the next one known; the time reached, which is earlier if there is a state event, or a time
        event that a step event on the way has scheduled.
        """
        n_states = sum(component.n_states for component in self._components)
        if not (n_states or self._n_indicators):
            self._accept(to_seconds(stop_ns), np.empty(0))
            return stop_ns
        if self._n_indicators:
            self._indicators = self._get_indicators()
        if self._coupling.integrator is Integrator.DORMAND_PRINCE and n_states:
            return self._dormand_prince(start_ns, stop_ns)
        euler = self._coupling.integrator is Integrator.EULER
        return self._equal_steps(self._euler_step if euler else self._runge_kutta_step, start_ns, stop_ns)

    def _micro_steps(self, start_ns: int, end_ns: int) -> tuple[int, float]:
        """How many equal micro steps, and their length in seconds."""
        n = -((start_ns - end_ns) // self._coupling.step_ns) * self._coupling.refinement
        return n, to_seconds(self._coupling.step_ns) if self._coupling.grid else to_seconds(end_ns - start_ns) / n

    # --- joint ------------------------------------------------------------------------------------------------------
    def _equal_steps(self, step: Callable[[float, Floats, float], Floats], start_ns: int, end_ns: int) -> int:
        """Steps from states at a time to those a length later; the time reached."""
        n, h = self._micro_steps(start_ns, end_ns)
        start, end = to_seconds(start_ns), to_seconds(end_ns)
        x, i = self._get_states(), 0
        while i < n:
            t, final = start + i * h, i + 1 == n
            new, reached = step(t, x, h), end if final else start + (i + 1) * h
            if self._crosses(reached, new):
                ends = bracket(t, reached, start_ns, end_ns, final=final)
                return self._locate(ends, partial(step, t, x), t)
            x, i = self._accept(reached, new), i + 1
            if x is not new and (earlier_ns := self._next_stop(reached, end_ns)) < end_ns:
                self._scheduled, end_ns = True, earlier_ns
                start, end, i = reached, to_seconds(end_ns), 0
                n = max(1, math.ceil((end - start) / to_seconds(self._coupling.step_ns))) * self._coupling.refinement
                h = (end - start) / n
        return end_ns

    def _euler_step(self, t: float, x: Floats, h: float) -> Floats:
        return x + h * self._derivatives(t, x)

    def _runge_kutta_step(self, t: float, x: Floats, h: float) -> Floats:
        """The classical Runge-Kutta method of order 4."""
        half, sixth = 0.5 * h, h / 6.0
        k1 = self._derivatives(t, x)
        k2 = self._derivatives(t + half, x + half * k1)
        k3 = self._derivatives(t + half, x + half * k2)
        k4 = self._derivatives(t + h, x + h * k3)
        return x + sixth * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    def _dormand_prince(self, start_ns: int, end_ns: int) -> int:
        """The embedded pair of Dormand and Prince (1980), local extrapolation, elementary step size control."""
        coupling = self._coupling
        start, end = to_seconds(start_ns), to_seconds(end_ns)
        largest = to_seconds(coupling.step_ns)
        t = start
        x = self._get_states()
        h = self._state.steps[1].item() or largest
        k = [self._derivatives(t, x)]
        while t < end:
            h = min(h, largest)
            final = t + h >= end - 1e-12 * largest
            length = end - t if final else h
            new = self._dormand_prince_step(t, x, length, k)
            k.append(self._derivatives(t + length, new))
            error = length * _combine(_DP_E, k)
            scale = coupling.absolute_tolerance + coupling.relative_tolerance * np.maximum(np.abs(x), np.abs(new))
            ratios = np.abs(error) / scale
            ratio = float(np.max(ratios))
            factor = 5.0 if ratio == 0.0 else min(5.0, max(0.2, 0.9 * math.pow(ratio, -0.2)))
            if not math.isfinite(ratio):
                self._check_states(new)
                factor = 0.2
            if ratio <= 1.0:
                reached = end if final else t + length
                if self._crosses(reached, new):
                    self._state.steps[1] = h
                    ends = bracket(t, reached, start_ns, end_ns, final=final)
                    return self._locate(ends, partial(self._dormand_prince_from, t, x, k[0]), t)
                t = reached
                x = self._accept(t, new)
                k = [k[-1] if x is new else self._derivatives(t, x)]  # an event may have changed the states
                if x is not new and (earlier_ns := self._next_stop(t, end_ns)) < end_ns:
                    self._scheduled, end_ns, end = True, earlier_ns, to_seconds(earlier_ns)
            else:
                k = [k[0]]
            if not (ratio <= 1.0 and final):  # a step cut short by an event says nothing about the next one's length
                h = length * factor
            if h < 1e-12 * largest:
                worst = int(np.argmax(ratios))
                raise ComponentError(
                    next(c.name for c, part in zip(self._components, self._states, strict=True) if worst < part.stop),
                    f"the step size fell below {h:.3g} s without meeting the tolerances; "
                    "loosen relative_tolerance or absolute_tolerance, or look for a discontinuity",
                )
        self._state.steps[1] = h
        return end_ns

    def _dormand_prince_from(self, t: float, x: Floats, slope: Floats, length: float) -> Floats:
        return self._dormand_prince_step(t, x, length, [slope])

    def _dormand_prince_step(self, t: float, x: Floats, length: float, k: list[Floats]) -> Floats:
        """The result of order 5; `k` has the first stage and takes the others but the last."""
        for row, c in zip(_DP_A, _DP_C, strict=True):
            k.append(self._derivatives(t + c * length, x + length * _combine(row, k)))
        return x + length * _combine(_DP_B, k)

    def _derivatives(self, time: float, x: Floats) -> Floats:
        """Derivatives of all states, with outputs carried to inputs in between."""
        self._place(time, x)
        _do(self._between_events)
        return np.concatenate([component.derivatives() for component in self._components])

    def _place(self, time: float, x: Floats) -> None:
        self._state.time[0] = time
        for component, part in zip(self._components, self._states, strict=True):
            component.set_time(time)
            if component.n_states:
                component.set_states(x[part])

    def _get_states(self) -> Floats:
        return np.concatenate([component.get_states() for component in self._components])

    def _accept(self, time: float, x: Floats) -> Floats:
        """Make a step final. The states afterwards: an event may change them."""
        self._state.time[0] = time
        self._check_states(x)
        self._place(time, x)
        if not self._complete():
            return x
        for component in self._components:
            component.enter_event_mode()
        self._iterate_events()
        if self._n_indicators:
            self._indicators = self._get_indicators()
        return self._get_states()

    def _complete(self) -> bool:
        """Tell all components that a step is final; whether one of them wants an event."""
        wants_event = False
        for component in self._components:
            wants_event |= component.completed_step()
        return wants_event

    def _check_states(self, x: Floats) -> None:
        for component, part in zip(self._components, self._states, strict=True):
            bad = np.flatnonzero(~np.isfinite(x[part]))
            if bad.size:
                raise ComponentError(component.name, f"continuous state {bad[0] + 1} is not finite")

    # --- state events -----------------------------------------------------------------------------------------------
    def _crosses(self, time: float, x: Floats) -> bool:
        """Whether an event indicator crosses zero in a step to these states; if not, they are the next step's first."""
        if not self._n_indicators:
            return False
        self._check_states(x)
        found = self._indicators_at(time, x)
        if crossed(self._indicators, found).any():
            self._beyond = found
            return True
        self._indicators = found
        return False

    def _indicators_at(self, time: float, x: Floats) -> Floats:
        self._place(time, x)
        _do(self._between_events)
        return self._get_indicators()

    def _get_indicators(self) -> Floats:
        found = []
        for component in self._components:
            own = component.event_indicators() if component.n_indicators else np.empty(0)
            bad = np.flatnonzero(np.isnan(own))
            if bad.size:
                raise ComponentError(component.name, f"event indicator {bad[0] + 1} is not a number")
            found.append(own)
        return np.concatenate(found)

    def _locate(self, ends: tuple[int, int], step: Callable[[float], Floats], start: float) -> int:
        """Bring all components to the state event of a step and make the step up to there final; when it is.

        Args:
            ends: whole nanoseconds around the step.
            step: the states after a length of it.
            start: of it, in seconds.
        """

        def indicators(time_ns: int) -> Floats:
            time = to_seconds(time_ns)
            return self._indicators_at(time, step(time - start))

        before, self._located = self._indicators, True
        event_ns = first_crossing(*ends, before, self._beyond, indicators)
        changed = crossed(before, indicators(event_ns))
        owners = np.repeat(np.arange(len(self._components)), [c.n_indicators for c in self._components])
        self._chattering = owners[np.argmax(changed)]
        self._complete()  # there will be an event in any case
        return event_ns

    def _chatters(self) -> ComponentError:
        return ComponentError(self._components[self._chattering].name, chattering(self._coupling.step_ns))

    # --- Co-Simulation ----------------------------------------------------------------------------------------------
    def _step_components(self, step: Callable[[float, float], None], start_ns: int, end_ns: int) -> None:
        n, h = self._micro_steps(start_ns, end_ns)
        start = to_seconds(start_ns)
        for i in range(n):
            self._state.time[0] = start + i * h
            step(start + i * h, h)

    def _jacobi(self, t: float, h: float) -> None:
        for c in range(len(self._components)):
            self._set_inputs(c)
            self._step_one(c, t, h)
        for gets in self._wiring.outputs:
            self._carry_out(gets)

    def _gauss_seidel(self, t: float, h: float) -> None:
        for c in range(len(self._components)):
            self._set_inputs(c)
            self._step_one(c, t, h)
            self._carry_out(self._wiring.outputs[c])

    def _midpoint(self, t: float, h: float) -> None:
        state, owner = self._state, self._wiring.owner
        signals = state.signals
        before = signals.copy()
        weight = middle_weight(h, state.steps[0].item())
        middle = np.where(self._wiring.continuous, before + weight * (before - state.previous), before)
        half = 0.5 * h
        for c in range(len(self._components)):
            earlier = (owner >= 0) & (owner < c)
            if any(np.any(earlier[transfer.positions]) for transfer in self._wiring.inputs[c]):
                self._set_inputs(c, np.where(earlier, before, middle))
                self._step_one(c, t, half, halved=True)
                self._set_inputs(c, np.where(earlier, signals, middle))
                self._step_one(c, t + half, half, halved=True)
            else:
                self._set_inputs(c, middle)
                self._step_one(c, t, h)
            self._carry_out(self._wiring.outputs[c])
        state.previous[:] = before
        state.steps[0] = h

    def _step_one(self, c: int, t: float, h: float, *, halved: bool = False) -> None:
        """A step of a component, in as many of its own as it makes, its inputs held."""
        component, retries = self._components[c], self._coupling.retries
        parts = self._coupling.parts_of(c, halved=halved)
        length = h / parts
        for i in range(parts):
            if retries:
                component.step_in_halves(t + i * length, length, retries)
            else:
                component.step(t + i * length, length)

    def _set_inputs(self, c: int, source: Floats | None = None) -> None:
        """Set the connected inputs of a component from `source`, by default the signals."""
        component, discrete = self._components[c], self._discrete[c]
        if discrete:
            component.enter_event_mode()
        self._carry_out(self._wiring.inputs[c], source)
        if discrete:
            component.update_discrete_states()
            component.enter_step_mode()

    # --- transfers --------------------------------------------------------------------------------------------------
    def _parts(self, propagated: Iterable[Transfer | AlgebraicLoop]) -> Iterator[Callable[[], None]]:
        """What is done to carry outputs to inputs, in this order."""
        for is_transfer, group in itertools.groupby(propagated, lambda part: isinstance(part, Transfer)):
            if is_transfer:
                yield partial(self._carry_out, [part for part in group if isinstance(part, Transfer)])
                continue
            for part in group:
                if isinstance(part, AlgebraicLoop):
                    yield partial(self._solve, part, algebraic.Solver(len(part.positions)))

    def _solve(self, loop: AlgebraicLoop, solver: algebraic.Solver) -> None:
        """Solve a loop; the signals, and so the inputs, are the solution, and not what the components make of it."""

        def outputs(y: Floats) -> Floats:
            self._signals[loop.positions] = y
            self._carry_out(loop.sets)
            self._carry_out(loop.gets)
            return self._signals[loop.positions]

        try:
            self._signals[loop.positions] = solver.solve(outputs, self._signals[loop.positions])
        except algebraic.UnsolvedError as error:
            raise ComponentError(
                self._components[loop.component].name, f"the algebraic loop {loop.names} {error}"
            ) from None

    def _carry_out(self, transfers: Iterable[Transfer], source: Floats | None = None) -> None:
        """Move values; SET reads from `source`, by default the signals."""
        read = self._signals if source is None else source
        for transfer in transfers:
            component = self._components[transfer.component]
            if transfer.direction is _SET:
                for variable, positions, scales in transfer.parts:
                    component.set(variable, read[positions] if scales is None else scales(read[positions]))
                continue
            for variable, positions, scales in transfer.parts:
                values = component.get(variable)
                if scales is not None:
                    values = scales(values)
                if not np.isfinite(values).all():
                    raise ComponentError(component.name, f"output {variable.name} is not finite")
                self._signals[positions] = values


def _do(parts: Iterable[Callable[[], None]]) -> None:
    for part in parts:
        part()


def _combine(weights: Sequence[float], stages: Sequence[NDArray[np.float64]]) -> Floats:
    """Weighted sum of the first stages, from the first to the last, stages of weight zero included."""
    total = weights[0] * stages[0]
    for weight, stage in zip(weights[1:], stages[1 : len(weights)], strict=True):
        total = total + weight * stage
    return total


_DP_C = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)
_DP_A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
)
_DP_B = (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84)
_DP_E = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
"""Weights of order 5 less those of the embedded order 4."""
