"""One instance of a component, driven by itself: with inputs that are a function of time, as an importer would."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from cosim.components.component import Component, Description, Floats, Interface, Variable
from cosim.components.opening import open_started
from cosim.plan import ComponentPlan
from cosim.planning.starts import FLOATS, NUMERIC

Values = Mapping[str, Floats]
STEPS = 20
_STOP = 1e4


@dataclass(frozen=True)
class Subject:
    """A component to be tried out, through one of its interfaces.

    Attributes:
        plan: what it is; its start values are those that the user gives.
    """

    plan: ComponentPlan
    interface: Interface

    @property
    def description(self) -> Description:
        """What it says of itself."""
        return self.plan.description

    @property
    def step(self) -> float:
        """A communication step that it should take."""
        own = self.description
        return own.internal_step or own.usual_step or 0.01

    def variables(self, *causalities: str) -> list[Variable]:
        """Those that hold numbers."""
        every = self.description.variables.values()
        return [v for v in every if v.causality in causalities and v.dtype in NUMERIC and v.size]

    @property
    def inputs(self) -> list[Variable]:
        """Continuous ones."""
        return [v for v in self.variables("input") if v.is_continuous]

    @property
    def discrete(self) -> list[Variable]:
        """Inputs that change at events only."""
        return [v for v in self.variables("input") if not v.is_continuous]

    @contextmanager
    def opened(self, *, started: bool = True) -> Iterator[Driver]:
        """An instance that is ended afterwards; initialised, unless that is up to the caller."""
        component = open_started(self.plan, self.interface)
        driver = Driver(self, component)
        try:
            if started:
                driver.initialise()
            yield driver
        finally:
            component.terminate()

    def signal(self, variable: Variable, time: float, phase: float = 0.0) -> Floats:
        """What an input gets at a time: around its start value; of truth values and enumerations, each."""
        angles = 6.0 * time + phase + np.arange(variable.size)
        if variable.dtype == "Boolean" or variable.items:
            choice = np.array(sorted(variable.items.values()) or [0, 1], dtype=float)
            chosen: Floats = choice[np.floor((0.5 + 0.499 * np.sin(angles)) * len(choice)).astype(int)]
            return chosen
        start = np.array(variable.start if variable.start is not None else [0.0] * variable.size, dtype=float)
        if variable.dtype not in FLOATS:  # nobody says which others are allowed
            return start
        values: Floats = start + 0.1 * (1.0 + np.abs(start)) * np.sin(angles)
        return values


class Driver:
    """An instance on its way through time."""

    def __init__(self, subject: Subject, component: Component) -> None:
        self.subject = subject
        self.component = component
        self.time = 0.0

    def initialise(self) -> None:
        """Up to the first step."""
        self.component.enter_initialization(0.0, _STOP)
        self.leave_initialisation()

    def leave_initialisation(self) -> None:
        """From Initialization Mode to the first step."""
        component = self.component
        component.exit_initialization()
        if self.subject.interface is Interface.MODEL_EXCHANGE:
            component.update_discrete_states()
            component.enter_continuous_time_mode()
        elif component.uses_events:
            component.update_discrete_states()
            component.enter_step_mode()

    def set_inputs(self, phase: float = 0.0) -> None:
        """What continuous ones get at this time."""
        for variable in self.subject.inputs:
            self.component.set(variable, self.subject.signal(variable, self.time, phase))

    def set_discrete_inputs(self, phase: float = 0.0) -> None:
        """What the others get at this time, at an event where the component has those."""
        component = self.component
        eventful = component.uses_events or self.subject.interface is Interface.MODEL_EXCHANGE
        if not self.subject.discrete:
            return
        if eventful:
            component.enter_event_mode()
        for variable in self.subject.discrete:
            component.set(variable, self.subject.signal(variable, self.time, phase))
        if eventful:
            component.update_discrete_states()
        if self.subject.interface is Interface.MODEL_EXCHANGE:
            component.enter_continuous_time_mode()
        elif eventful:
            component.enter_step_mode()

    def outputs(self) -> dict[str, Floats]:
        """By name."""
        return {v.name: self.component.get(v) for v in self.subject.variables("output")}

    def advance(self, step: float, phase: float = 0.0) -> None:
        """With the inputs held. Model Exchange: by the classical Runge-Kutta method."""
        self.set_discrete_inputs(phase)
        self.set_inputs(phase)
        if self.subject.interface is Interface.CO_SIMULATION:
            self.component.step(self.time, step)
            self.time += step
            return
        self._integrate(step)

    def run(self, steps: int, step: float, phase: float = 0.0) -> list[dict[str, Floats]]:
        """The outputs after each of some steps."""
        seen = []
        for _ in range(steps):
            self.advance(step, phase)
            seen.append(self.outputs())
        return seen

    def derivatives_at(self, time: float, states: Floats) -> Floats:
        """Model Exchange: f(t, x) with the inputs as they are."""
        self.component.set_time(time)
        if self.component.n_states:
            self.component.set_states(states)
        return self.component.derivatives()

    def _integrate(self, h: float) -> None:
        component, t = self.component, self.time
        x = component.get_states()
        k1 = self.derivatives_at(t, x)
        k2 = self.derivatives_at(t + h / 2, x + h / 2 * k1)
        k3 = self.derivatives_at(t + h / 2, x + h / 2 * k2)
        k4 = self.derivatives_at(t + h, x + h * k3)
        new = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        self.time = t + h
        component.set_time(self.time)
        if component.n_states:
            component.set_states(new)
        component.completed_step()
        component.enter_event_mode()
        component.update_discrete_states()
        component.enter_continuous_time_mode()


# --- comparing --------------------------------------------------------------------------------------------------------


def difference(one: Mapping[str, Floats], other: Mapping[str, Floats]) -> tuple[float, str]:
    """The largest difference of two sets of values, relative where they are larger than 1, and where it is."""
    worst, where = 0.0, ""
    for name, values in one.items():
        theirs = other[name]
        both_nan = np.isnan(values) & np.isnan(theirs)
        gap = np.where(both_nan, 0.0, np.abs(values - theirs) / (1.0 + np.maximum(np.abs(values), np.abs(theirs))))
        gap = np.where(np.isnan(gap), math.inf, gap)
        largest = float(gap.max()) if gap.size else 0.0
        if largest > worst:
            worst, where = largest, name
    return worst, where


def first_difference(one: list[dict[str, Floats]], other: list[dict[str, Floats]]) -> tuple[int, str, float] | None:
    """The first step at which two runs differ in a bit, the output, and by how much; None where they are the same."""
    for number, (here, there) in enumerate(zip(one, other, strict=True), 1):
        for name, values in here.items():
            if values.tobytes() != there[name].tobytes():
                gap, _ = difference({name: values}, {name: there[name]})
                return number, name, gap
    return None
