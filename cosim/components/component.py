"""One step component: what the framework asks of an FMU or of a Python class, and nothing more.

The life cycle is the FMI standard's (FMI 3.0, sections 2.3 and 4.2): instantiate, set start values, initialise, then
either Co-Simulation (`step`) or Model Exchange (states, derivatives, events), then terminate. Values cross this
boundary as flat float64 arrays, row-major; an adapter converts to the variable's own type.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from cosim.attention import COMPONENT, idle
from cosim.components.units import IDENTITY, Measure, Scale
from cosim.errors import DiscardedStepError

Floats = NDArray[np.float64]
Value = float | int | bool | str
Limits = tuple[float, float]
NO_LIMITS: Limits = (-math.inf, math.inf)

MOST_NUMBERS = 1_000_000
"""How many a variable may hold."""


class Interface(StrEnum):
    """How a component is stepped."""

    MODEL_EXCHANGE = "model-exchange"
    CO_SIMULATION = "co-simulation"


@dataclass(frozen=True)
class Variable:
    """One variable, as FMI describes it.

    Attributes:
        name: as the FMU writes it, without an index.
        causality: `input`, `output`, `parameter`, `structuralParameter`, `local`, `independent`, `calculatedParameter`.
        variability: `continuous`, `discrete`, `fixed`, `tunable`, `constant`.
        dtype: FMI 3.0's type name: `Float64`, `Int64`, `Int32`, `Boolean`, `Enumeration`, `String`, …
        shape: () for a scalar; dimensions that depend on structural parameters are resolved.
        references: value references. FMI 3.0: one, whatever the shape. FMI 2.0: one per element, row-major, where the
            elements `name[1]`, `name[2]` (or `name[1,1]`, …) of a flattened array are gathered under the array's name.
        unit: as declared, or None.
        start: start value as declared (flat), or None; that of a `Binary` in hexadecimal digits.
        items: names of an enumeration's items to their values.
        dependencies: for outputs, the names of the inputs that feed through directly; None where the FMU does not say
            (then every input must be assumed). For state derivatives it is unused.
        initial: `exact`, `approx` or `calculated` (FMI 3.0, section 2.4.7.5); empty where that says nothing. The start
            value of a `calculated` variable cannot be set. Of an array `calculated` if it is for any element.
        initials: of every element of a flattened FMI 2.0 array, where they are not the same.
        limits: least and largest value that the component is made for: one pair for all numbers, or one for each; empty
            where none is declared.
        measure: what the unit means, or None where that is not known.
        derivative_of: the variable whose derivative it is, if the model description says so.
        elements: where a scenario maps names: the numbers of the component's own variables that it stands for. The
            component itself does not know it.
    """

    name: str
    causality: str
    variability: str
    dtype: str
    shape: tuple[int, ...] = ()
    references: tuple[int, ...] = ()
    unit: str | None = None
    start: tuple[Value, ...] | None = None
    description: str = ""
    items: Mapping[str, int] = field(default_factory=dict)
    dependencies: tuple[str, ...] | None = None
    initial: str = ""
    initials: tuple[str, ...] = ()
    limits: tuple[Limits, ...] = ()
    measure: Measure | None = None
    derivative_of: str | None = None
    elements: tuple[Element, ...] | None = None

    @property
    def size(self) -> int:
        """How many numbers it holds."""
        return math.prod(self.shape)

    @property
    def is_continuous(self) -> bool:
        """Whether it changes between events too: only real numbers can (FMI 2.0 lets integers leave that open)."""
        return self.variability == "continuous" and self.dtype.startswith("Float")


@dataclass(frozen=True)
class Element:
    """One number of one of a component's own variables.

    Attributes:
        index: flat, row-major.
        scale: on the way out of the component or into it, whichever way the values of the variable go.
    """

    variable: Variable
    index: int = 0
    scale: Scale = IDENTITY


class SizeError(ValueError):
    """A variable is larger than anything that is supported."""


def check_size(name: str, shape: tuple[int, ...]) -> None:
    """Refuse what would not fit into memory, before it is there.

    Raises:
        SizeError: names the variable.
    """
    if (size := math.prod(shape)) > MOST_NUMBERS:
        raise SizeError(f"{name!r} would hold {size:,} numbers, and {MOST_NUMBERS:,} are the most that a variable may")


def head(variable: Variable, shape: tuple[int, ...]) -> Variable:
    """The leading block of a flattened FMI 2.0 array, or of a mapped one, where more rows are declared than are used.

    Args:
        variable: an array with one reference per element.
        shape: of the block, as many dimensions as the array.

    Raises:
        ValueError: the array has another number of dimensions, is smaller, or is one FMI 3.0 variable, whose size only
            a structural parameter can change.
    """
    if shape == variable.shape:
        return variable
    if variable.elements is None and len(variable.references) != variable.size:
        raise ValueError(f"{variable.name} has the shape {variable.shape}; only a structural parameter can change it")
    if len(shape) != len(variable.shape) or any(n > m for n, m in zip(shape, variable.shape, strict=True)):
        raise ValueError(f"{variable.name} has the shape {variable.shape}, too small for {shape}")
    kept = np.arange(variable.size).reshape(variable.shape)[tuple(slice(n) for n in shape)].reshape(-1).tolist()
    return replace(
        variable,
        shape=shape,
        references=tuple(variable.references[i] for i in kept) if variable.elements is None else (),
        elements=None if variable.elements is None else tuple(variable.elements[i] for i in kept),
        start=None if variable.start is None else tuple(variable.start[i] for i in kept),
        initials=tuple(variable.initials[i] for i in kept) if variable.initials else (),
        limits=tuple(variable.limits[i] for i in kept) if len(variable.limits) > 1 else variable.limits,
    )


@dataclass(frozen=True)
class Description:
    """What a component says of itself before it is instantiated.

    Attributes:
        model: model name.
        fmi: "2.0", "3.0" or "python".
        interfaces: those that it offers.
        variables: by name, in the file's order; arrays of FMI 2.0 gathered, dimensions for the given structural
            parameters.
        platforms: those it has a binary for (FMUs only).
        sha256: of the FMU file, or of the source file of a Python class.
        whole: whether it can be run; False where only the description of an FMU is here.
        n_event_indicators: Model Exchange: number of event indicators.
        variable_step: Co-Simulation: whether it accepts communication steps of different lengths.
        internal_step: Co-Simulation: length in seconds of the steps that it makes inside, None where it does not say.
        usual_step: the step in seconds of its default experiment, None where it has none.
        tolerance: Co-Simulation: what its own solver is told, relative; that of its default experiment unless the
            scenario says another, None where neither does.
        can_get_and_set_state: whether it can be saved and restored.
        asynchronous: Co-Simulation: a step may go on after the call that begins it (FMI 2.0, canRunAsynchronuously).
        own: where a scenario maps names: the description as the component gives it.
    """

    model: str
    fmi: str
    interfaces: tuple[Interface, ...]
    variables: Mapping[str, Variable]
    platforms: tuple[str, ...] = ()
    sha256: str = ""
    n_event_indicators: int = 0
    variable_step: bool = True
    internal_step: float | None = None
    usual_step: float | None = None
    tolerance: float | None = None
    can_get_and_set_state: bool = False
    asynchronous: bool = False
    whole: bool = True
    own: Description | None = None

    @property
    def states(self) -> frozenset[str]:
        """The continuous states that it tells of, under its own names: what it has the derivatives of."""
        variables = (self.own or self).variables
        found = {variable.derivative_of for variable in variables.values() if variable.derivative_of is not None}
        return frozenset(name if name in variables else name.rpartition("[")[0] for name in found)  # FMI 2.0: `x[1]`


class Component(ABC):
    """A live instance. Every method raises `ComponentError` with the component's last log line when it fails."""

    name: str
    interface: Interface
    description: Description

    # --- values -----------------------------------------------------------------------------------------------------
    _attended = idle()
    _place = -1

    def attend(self, attended: NDArray[np.int64], place: int) -> None:
        """From now on, whenever code of it is called in this process, `attended[COMPONENT]` is set to `place`."""
        self._attended, self._place = attended, place

    @property
    def last_log(self) -> str | None:
        """The last line that it logged."""
        return None

    def _called(self) -> None:
        self._attended[COMPONENT] = self._place

    @abstractmethod
    def get(self, variable: Variable) -> Floats:
        """Flat values of one numeric variable, shape (variable.size,)."""

    @abstractmethod
    def set(self, variable: Variable, values: Floats) -> None:
        """Set one numeric variable from flat values, shape (variable.size,)."""

    @abstractmethod
    def start(self, variable: Variable, values: Sequence[Value]) -> None:
        """Set a start value or parameter of any type before initialisation; enumeration items by name or number."""

    # --- life cycle -------------------------------------------------------------------------------------------------
    def await_open(self) -> None:  # noqa: B027 - most are open at once
        """Return when the component is open and has its start values; those in other processes open side by side."""

    @abstractmethod
    def enter_initialization(self, start_time: float, stop_time: float) -> None: ...

    @abstractmethod
    def exit_initialization(self) -> None:
        """Leaves a component that has an Event Mode in it, another one ready for `step`."""

    @abstractmethod
    def terminate(self) -> None:
        """Terminate and free. Calling it twice, or after a failure, does no harm."""

    def reset(self) -> None:
        """Back to how it was when it was instantiated, without any start values."""
        raise NotImplementedError

    # --- saved states -----------------------------------------------------------------------------------------------
    def save(self) -> object:
        """Its whole state, for `restore`; `forget` it in the end."""
        raise NotImplementedError

    def restore(self, saved: object) -> None:
        raise NotImplementedError

    def forget(self, saved: object) -> None:
        raise NotImplementedError

    # --- Co-Simulation ----------------------------------------------------------------------------------------------
    goes_back: bool = False
    """Whether the state before the next step may be restored afterwards."""

    uses_events: bool = False
    """Whether it has an Event Mode (FMI 3.0, 4.2): initialisation ends there, and discrete inputs are set there."""

    def step(self, time: float, step: float) -> None:
        """Advance from `time` by `step` seconds with the inputs held, handling events on the way."""
        raise NotImplementedError

    def step_in_halves(self, time: float, step: float, halvings: int) -> None:
        """The same; a step that is discarded is made again in halves, so often one into another."""
        before, self.goes_back = self.goes_back, True
        try:
            self._step_in_halves(time, step, halvings)
        finally:
            self.goes_back = before

    def _step_in_halves(self, time: float, step: float, halvings: int) -> None:
        if self._try_step(time, step, last=halvings == 0):
            return
        self._step_in_halves(time, 0.5 * step, halvings - 1)
        self._step_in_halves(time + 0.5 * step, 0.5 * step, halvings - 1)

    def _try_step(self, time: float, step: float, *, last: bool) -> bool:
        """Make a step; False, and back where it began, if it is discarded and this is not the last attempt."""
        state = self.save()
        try:
            self.step(time, step)
        except DiscardedStepError as error:
            if last:
                shorter = f"; it is the shortest step that `retries` allows ({step:.3g} s)"
                raise DiscardedStepError(self.name, error.message + shorter, error.log) from None
            self.restore(state)
            return False
        finally:
            self.forget(state)
        return True

    def enter_step_mode(self) -> None:
        """Back from Event Mode."""
        raise NotImplementedError

    # --- Model Exchange ---------------------------------------------------------------------------------------------
    n_states: int = 0
    n_indicators: int = 0

    def set_time(self, time: float) -> None:
        raise NotImplementedError

    def get_states(self) -> Floats:
        raise NotImplementedError

    def set_states(self, states: Floats) -> None:
        raise NotImplementedError

    def derivatives(self) -> Floats:
        raise NotImplementedError

    def nominals(self) -> Floats:
        """Shape (n_states,): the usual size of each state."""
        return np.ones(self.n_states)

    def event_indicators(self) -> Floats:
        """Shape (n_indicators,): a change of sign is a state event."""
        raise NotImplementedError

    def completed_step(self) -> bool:
        """Tell the component that an integration step is final; True if it wants Event Mode."""
        raise NotImplementedError

    def enter_event_mode(self) -> None:
        raise NotImplementedError

    def update_discrete_states(self) -> float | None:
        """Iterate discrete states to their fixed point (with a limit); the next time event in seconds, or None."""
        raise NotImplementedError

    def enter_continuous_time_mode(self) -> None:
        raise NotImplementedError
