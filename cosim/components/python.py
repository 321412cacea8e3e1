"""Components written in Python: declare variables, implement a few methods. `docs/components.md` shows how.

`PythonComponent` is what a user derives from; `PythonInstance` drives one through the framework's life cycle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.components.component import Component, Description, Floats, Interface, Value, Variable, check_size
from cosim.components.saving import attributes_of, copied, from_bytes, put_back, to_bytes
from cosim.components.start_values import start_values
from cosim.components.units import measure
from cosim.errors import ComponentError, ConfigError, DiscardedStepError, EndRequestedError, Problem, suggest
from network import loading
from network.loading import Loaded, told

_ARRAY_TYPES: dict[str, Any] = {
    "Float64": np.float64,
    "Int64": np.int64,
    "UInt64": np.int64,
    "Enumeration": np.int64,
    "Boolean": np.bool_,
    "String": np.object_,
}


# --- declarations ---------------------------------------------------------------------------------------------------
class Declaration:
    """A variable of a component, declared as a class attribute; on an instance it is the variable's value.

    A scalar reads as a number (or bool, or str), an array as a NumPy array. Assigning copies into place and must fit
    the shape.

    Args:
        start: start value, one for all elements or one each.
        shape: sizes; the name of a `Structural` stands for its value.
        unit: such as "rad/s".
        dtype: `Float64`, `Int64`, `Boolean`, `String` or (with `items`) `Enumeration`.
        items: names of an enumeration's items to their values.
        description: for people.
    """

    causality: ClassVar[str]
    initial: ClassVar[str] = "exact"

    def __init__(
        self,
        start: ArrayLike = 0.0,
        *,
        shape: Sequence[int | str] = (),
        unit: str | None = None,
        dtype: str = "Float64",
        items: Mapping[str, int] | None = None,
        description: str = "",
    ) -> None:
        self.start = start
        self.shape = tuple(shape)
        self.unit = unit
        self.dtype = "Enumeration" if items else dtype
        self.items = dict(items or {})
        self.description = description
        self.name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: PythonComponent | None, owner: type) -> Any:
        if instance is None:
            return self
        value = instance.values_of(self.name)
        return value if value.shape else value.item()

    def __set__(self, instance: PythonComponent, value: ArrayLike) -> None:
        instance.values_of(self.name)[...] = value

    @property
    def variability(self) -> str:
        return "continuous" if self.dtype == "Float64" else "discrete"

    @property
    def dependencies(self) -> tuple[str, ...] | None:
        return None

    def variable(self, structural: Mapping[str, int]) -> Variable:
        """As the framework sees it, with the structural parameters given."""
        shape = tuple(structural[n] if isinstance(n, str) else n for n in self.shape)
        check_size(self.name, shape)
        numbers = self._in_numbers(self.start) if self.items else self.start
        try:
            start = np.broadcast_to(np.array(numbers, _ARRAY_TYPES[self.dtype]), shape)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{self.name!r}: {error}") from error
        return Variable(
            name=self.name,
            causality=self.causality,
            variability=self.variability,
            dtype=self.dtype,
            shape=shape,
            unit=self.unit,
            start=tuple(start.reshape(-1).tolist()),
            description=self.description,
            items=self.items,
            dependencies=self.dependencies,
            initial=self.initial,
            measure=measure(self.unit),
        )

    def _in_numbers(self, start: Any) -> Any:
        """The start value of an enumeration, whose items may be given by name."""
        if isinstance(start, list | tuple):
            return [self._in_numbers(item) for item in start]
        if isinstance(start, str) and start not in self.items:
            raise ValueError(f"{self.name!r} has no item {start!r}{suggest(start, self.items)}")
        return self.items[start] if isinstance(start, str) else start


class Input(Declaration):
    """Set from outside: by a connection, the mailbox or a start value."""

    causality = "input"


class Output(Declaration):
    """Computed by `outputs` or `step`.

    Args:
        depends_on: names of the inputs that `outputs` uses to compute it; () for none. By default all are assumed,
            which forbids `joint` coupling in a loop of such components.
        **declaration: see `Declaration`.
    """

    causality = "output"
    initial = "calculated"

    def __init__(self, *, depends_on: Sequence[str] | None = None, **declaration: Any) -> None:
        super().__init__(**declaration)
        self._depends_on = None if depends_on is None else tuple(depends_on)

    @property
    def dependencies(self) -> tuple[str, ...] | None:
        return self._depends_on


class State(Declaration):
    """A continuous state, whose derivative `derivatives` returns. It is an output too."""

    causality = "output"

    @property
    def dependencies(self) -> tuple[str, ...] | None:
        return ()


class Parameter(Declaration):
    """Fixed when the run starts."""

    causality = "parameter"

    @property
    def variability(self) -> str:
        return "fixed"


class Structural(Parameter):
    """A whole number that sizes arrays, such as the number of in-neighbours."""

    causality = "structuralParameter"

    def __init__(self, start: int = 0, *, description: str = "") -> None:
        super().__init__(start, dtype="UInt64", description=description)


class Discard(Exception):  # noqa: N818 - FMI's name
    """Raise it in `step`: this step cannot be made, but shorter ones may (FMI: Discard)."""


class EndSimulation(Exception):  # noqa: N818 - it is a request, not an error
    """Raise it in `step` or `event`: the run shall end here, in good order (FMI: `terminateSimulation`)."""


class PythonComponent:
    """Derive from this, declare variables as class attributes and implement what the component needs.

    - A function of time and inputs: `outputs`. It can be coupled in every way.
    - A component that steps itself (Co-Simulation): `step`, and `outputs` if outputs follow from the rest.
    - A component with continuous states (Model Exchange): `derivatives`, and `outputs` likewise.

    Methods read and assign variables as attributes (`self.u = …`) and must not look at any clock or global random
    state: equal runs must give equal bits.
    """

    _values: dict[str, NDArray[Any]]

    def initialise(self, time: float) -> None:
        """Compute states and other values at the start from parameters, start values and inputs.

        Called again whenever an input of the start changed, so it must not depend on its own results.
        """

    def outputs(self, time: float) -> None:
        """Set the outputs from time, states and inputs."""

    def step(self, time: float, step: float) -> None:
        """Co-Simulation: advance from `time` by `step` seconds; the inputs are held meanwhile."""

    def derivatives(self, time: float) -> Mapping[str, ArrayLike]:  # noqa: ARG002 - for those who override it
        """Model Exchange: the derivative of every `State`, by name."""
        return {}

    def event(self, time: float) -> None:
        """Model Exchange: update discrete values at ticks, arrivals and time events, where states may jump.

        It may be called several times at one instant, whenever an input changed, so it must be idempotent.
        """

    def next_event(self, time: float) -> float | None:  # noqa: ARG002 - for those who override it
        """Model Exchange: the time of the next time event after `time`, in seconds, if there is one."""
        return None

    def save(self) -> Any:
        """What it holds beside its variables, so that steps can be taken back: here, a deep copy of its attributes.

        Whoever overrides it returns something that does not change any more, and implements `restore` too. A class with
        `save = None` says that nothing can be taken back, as where it drives a device.
        """
        return copied(self, attributes_of(self))

    def restore(self, saved: Any) -> None:
        """Go back to what `save` returned, perhaps more than once."""
        put_back(self, copied(self, saved))

    def values_of(self, name: str) -> NDArray[Any]:
        """The memory of a variable."""
        try:
            return self._values[name]
        except AttributeError:
            raise AttributeError(f"{name} has no value in __init__ yet; use initialise") from None


# --- descriptions ---------------------------------------------------------------------------------------------------
def describe_python(dotted: str, structural: Mapping[str, int] | None = None) -> Description:
    """What a component class says of itself.

    Args:
        dotted: `package.module:Class`.
        structural: values of its `Structural` parameters; others keep their start values.

    Raises:
        ConfigError: there is no such class, or it is no usable component.
    """
    loaded = load(dotted)
    cls = loaded.cls
    declared = _declarations(cls)
    for name in declared:
        if hasattr(PythonComponent, name):
            raise _refuse(f"{dotted} declares a variable {name!r}, which is the name of a method; choose another")
    if cls.save is not None and (cls.save is PythonComponent.save) != (cls.restore is PythonComponent.restore):
        raise _refuse(f"{dotted} implements one of save and restore; implement both, or write save = None")
    sizes = {name: int(np.asarray(d.start)) for name, d in declared.items() if isinstance(d, Structural)}
    sizes |= {name: value for name, value in (structural or {}).items() if name in sizes}
    try:
        variables = {
            name: replace(d.variable({}), start=(sizes[name],)) if isinstance(d, Structural) else d.variable(sizes)
            for name, d in declared.items()
        }
    except KeyError as error:
        raise _refuse(f"{dotted} declares a variable with an unknown dtype or size {error}") from error
    except (ValueError, TypeError) as error:
        raise _refuse(f"{dotted} declares a variable that cannot be: {error}") from None
    inputs = [name for name, variable in variables.items() if variable.causality == "input"]
    for name, variable in variables.items():
        for other in variable.dependencies or ():
            if other not in inputs:
                raise _refuse(f"{dotted}: {name} depends on {other!r}, which is no input{suggest(other, inputs)}")
    return Description(
        model=cls.__name__,
        fmi="python",
        interfaces=_interfaces(cls, dotted),
        variables=variables,
        can_get_and_set_state=cls.save is not None,
        sha256=loaded.sha256,
    )


def _declarations(cls: type[PythonComponent]) -> dict[str, Declaration]:
    """By name, those of base classes first."""
    return {
        name: value
        for base in reversed(cls.__mro__)
        for name, value in vars(base).items()
        if isinstance(value, Declaration)
    }


def _interfaces(cls: type[PythonComponent], dotted: str) -> tuple[Interface, ...]:
    has_states = any(isinstance(d, State) for d in _declarations(cls).values())
    has_derivatives = cls.derivatives is not PythonComponent.derivatives
    has_step = cls.step is not PythonComponent.step
    if has_states and not (has_derivatives or has_step):
        raise _refuse(f"{dotted} declares a State but implements neither derivatives nor step")
    if has_derivatives and not has_states:
        raise _refuse(f"{dotted} implements derivatives but declares no State")
    offers = {
        Interface.MODEL_EXCHANGE: has_derivatives or not (has_states or has_step),
        Interface.CO_SIMULATION: has_step or not has_states,
    }
    return tuple(interface for interface, offered in offers.items() if offered)


# --- loading --------------------------------------------------------------------------------------------------------
def load(dotted: str) -> Loaded[PythonComponent]:
    """The class at `package.module:Class`; see `network.loading`.

    Raises:
        ConfigError: there is none, its module cannot be imported, or it is no component.
    """
    try:
        return loading.load(dotted, PythonComponent)
    except ValueError as error:
        raise _refuse(str(error)) from error


def _refuse(message: str) -> ConfigError:
    return ConfigError([Problem(message)])


# --- instances ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Saved:
    """A live instance as it was; `held` is what its class says that it holds beside its variables."""

    values: Mapping[str, NDArray[Any]]
    held: Any
    time: float
    stale: bool
    initialising: bool


class PythonInstance(Component):
    """A live instance of a `PythonComponent`."""

    def __init__(self, name: str, dotted: str, interface: Interface, description: Description) -> None:
        self.name = name
        self.interface = interface
        self.description = description
        self._class = self._checked(dotted)
        self._begin()

    def _checked(self, dotted: str) -> type[PythonComponent]:
        """The class, which must be the one that was described."""
        loaded = load(dotted)
        if loaded.sha256 != self.description.sha256:
            raise ComponentError(self.name, f"{loaded.file} has changed since {dotted} was described")
        return loaded.cls

    def _begin(self) -> None:
        """A new instance of the class, with all values at the start values that are declared."""
        description = self.description
        self._model: PythonComponent = self._run(self._class)
        variables = description.variables
        values = {v.name: np.array(v.start, _ARRAY_TYPES[v.dtype]).reshape(v.shape) for v in variables.values()}
        declared = _declarations(type(self._model))
        states = {name: values[name] for name, d in declared.items() if isinstance(d, State)}
        # States lie in one array, and their derivatives in another: they are asked for many times a step.
        self._state, own = _joined(states)
        self._slope, self._slopes = _joined(states)
        self._model._values = values | own
        self._flat = {name: array.reshape(-1) for name, array in self._model._values.items()}
        self.n_states = len(self._state)
        self._time = 0.0
        self._initialising = True
        self._stale = True

    def _run(self, method: Callable[..., Any], *arguments: Any) -> Any:
        """Call the user's code; whatever it raises becomes a `ComponentError` that says where."""
        self._called()
        try:
            return method(*arguments)
        except Discard as error:
            raise DiscardedStepError(self.name, f"discarded the step{f': {error}' if str(error) else ''}") from error
        except EndSimulation as error:
            why = f": {error}" if str(error) else ""
            raise EndRequestedError(self.name, f"asks to end the simulation{why}") from error
        except (Exception, SystemExit) as error:
            raise ComponentError(self.name, told(error, __file__)) from error

    # --- values -----------------------------------------------------------------------------------------------------
    def get(self, variable: Variable) -> Floats:
        self._evaluate()
        values: Floats = self._flat[variable.name].astype(np.float64)
        return values

    def peek(self, variable: Variable) -> NDArray[Any]:
        """Flat values of a variable of any type, in its own type."""
        self._evaluate()
        values: NDArray[Any] = self._flat[variable.name]
        return values

    def set(self, variable: Variable, values: Floats) -> None:
        target = self._flat[variable.name]
        target[:] = np.rint(values) if target.dtype.kind == "i" else values
        self._stale = True

    def start(self, variable: Variable, values: Sequence[Value]) -> None:
        try:
            converted = start_values(variable, values)
        except ValueError as error:
            raise ComponentError(self.name, f"{variable.name} {error}") from None
        if variable.causality == "structuralParameter" and variable.start != tuple(converted):
            raise ComponentError(self.name, f"{variable.name} must be known when the component is described")
        target = self._model.values_of(variable.name)
        target[...] = np.array(converted, target.dtype).reshape(target.shape)
        self._stale = True

    def _evaluate(self) -> None:
        if self._stale:
            if self._initialising:
                self._run(self._model.initialise, self._time)
            self._run(self._model.outputs, self._time)
            self._stale = False

    # --- life cycle -------------------------------------------------------------------------------------------------
    def enter_initialization(self, start_time: float, stop_time: float) -> None:  # noqa: ARG002 - the interface's
        self._time = start_time
        self._stale = True

    def exit_initialization(self) -> None:
        self._evaluate()
        self._initialising = False

    def terminate(self) -> None:
        """There is nothing to free."""

    def reset(self) -> None:
        self._begin()

    # --- saved states -----------------------------------------------------------------------------------------------
    def save(self) -> object:
        values = {name: array.copy() for name, array in self._model._values.items()}
        try:
            held = self._run(self._model.save)
        except ComponentError as error:
            raise ComponentError(self.name, f"its state cannot be saved: {error.message}") from error
        return _Saved(values, held, self._time, self._stale, self._initialising)

    def restore(self, saved: object) -> None:
        assert isinstance(saved, _Saved)
        for name, array in saved.values.items():
            self._model._values[name][...] = array
        self._run(self._model.restore, saved.held)
        self._time, self._stale, self._initialising = saved.time, saved.stale, saved.initialising

    def forget(self, saved: object) -> None:
        """There is nothing to free."""

    def to_bytes(self, saved: object) -> bytes:
        """What `save` returned, for `from_bytes`, here or in another process.

        Raises:
            Exception: the component holds something that cannot be pickled.
        """
        return to_bytes(self._model, saved)

    def from_bytes(self, data: bytes) -> object:
        """For `restore`."""
        saved: object = from_bytes(self._model, data)
        return saved

    # --- Co-Simulation ----------------------------------------------------------------------------------------------
    def step(self, time: float, step: float) -> None:
        self._run(self._model.step, time, step)
        self._time = time + step
        self._stale = True

    # --- Model Exchange ---------------------------------------------------------------------------------------------
    def set_time(self, time: float) -> None:
        self._time = time
        self._stale = True

    def get_states(self) -> Floats:
        return self._state.copy()

    def set_states(self, states: Floats) -> None:
        self._state[:] = states
        self._stale = True

    def derivatives(self) -> Floats:
        self._evaluate()
        by_name = self._run(self._model.derivatives, self._time)
        if not isinstance(by_name, Mapping):
            wanted = ", ".join(f"{name!r}: …" for name in self._slopes)
            raise ComponentError(self.name, f"derivatives returned {by_name!r}; return {{{wanted}}}")
        if by_name.keys() != self._slopes.keys():
            found, wanted = ", ".join(by_name) or "nothing", ", ".join(self._slopes)
            raise ComponentError(self.name, f"derivatives returned {found}, not {wanted}")
        for name, slope in self._slopes.items():
            self._run(_assign, slope, by_name[name])
        return self._slope.copy()

    def completed_step(self) -> bool:
        return False

    def enter_event_mode(self) -> None:
        """Nothing to prepare: `update_discrete_states` calls `event`."""

    def update_discrete_states(self) -> float | None:
        self._evaluate()
        self._run(self._model.event, self._time)
        self._stale = True
        next_event = self._run(self._model.next_event, self._time)
        if next_event is None:
            return None
        if not isinstance(next_event, (int, float)) or math.isnan(next_event):
            raise ComponentError(self.name, f"next_event returned {next_event!r}; return seconds, or None")
        return float(next_event)

    def enter_continuous_time_mode(self) -> None:
        """Nothing to prepare."""


def _joined(arrays: Mapping[str, NDArray[Any]]) -> tuple[Floats, dict[str, Floats]]:
    """Copies of arrays one after the other in one, and each of them as a part of it."""
    joined = np.concatenate([np.empty(0), *(array.reshape(-1) for array in arrays.values())])
    ends = list(itertools.accumulate((array.size for array in arrays.values()), initial=0))
    pieces = zip(arrays.items(), itertools.pairwise(ends), strict=True)
    return joined, {name: joined[i:j].reshape(array.shape) for (name, array), (i, j) in pieces}


def _assign(target: NDArray[Any], value: ArrayLike) -> None:
    target[...] = value
