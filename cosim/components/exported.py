"""A component class inside an FMU: what PythonFMU3 calls there. `cosim fmu export` makes such FMUs.

This file, and the few that it imports, travel in the FMU, so that it needs nothing but Python and NumPy where it runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar
from xml.etree.ElementTree import Element

import numpy as np

from cosim.components.component import Description, Floats, Interface, Variable
from cosim.components.python import PythonInstance, describe_python
from cosim.components.units import BASE
from cosim.errors import ComponentError, DiscardedStepError, EndRequestedError

SOLVER_STEP = 1e-3
"""Co-Simulation of a component with derivatives: the longest step of the Runge-Kutta method, in seconds."""


class Exported:
    """Beside PythonFMU3's `Fmi3SlaveBase`: every variable of the component, and what is asked of it.

    Attributes:
        TARGET: `package.module:Class`.
        SIZES: of its structural parameters, which an exported FMU cannot change.
    """

    TARGET: ClassVar[str]
    SIZES: ClassVar[Mapping[str, int]] = {}

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.time = 0.0
        self._start_time = 0.0
        self._described = describe_python(self.TARGET, self.SIZES)
        self._own = PythonInstance(self.TARGET, self.TARGET, Interface.CO_SIMULATION, self._described)
        _Registration(self, self._described, self._own).register()

    # --- life cycle ---------------------------------------------------------------------------------------------------
    def setup_experiment(self, start_time: float) -> None:
        """The time at which it starts."""
        self.time = self._start_time = start_time

    def enter_initialization_mode(self) -> None:
        """Values may follow from each other now."""
        self._own.enter_initialization(self._start_time, math.inf)

    def exit_initialization_mode(self) -> None:
        """What follows from start values is final."""
        self._own.exit_initialization()

    def do_step(self, current_time: float, step_size: float) -> Any:
        """Co-Simulation."""
        try:
            if self._own.n_states and Interface.CO_SIMULATION not in self._described.interfaces:
                self._integrate(current_time, step_size)
            else:
                self._own.step(current_time, step_size)
        except DiscardedStepError as error:
            self._say(error.message)
            return False
        except EndRequestedError:
            from pythonfmu3.fmi3slave import Fmi3StepResult

            return Fmi3StepResult(terminateSimulation=True)
        self.time = current_time + step_size
        return True

    def _say(self, message: str) -> None:
        from pythonfmu3 import Fmi3Status

        self.log(message, Fmi3Status.discard)  # type: ignore[attr-defined] # of PythonFMU3's

    def _integrate(self, start: float, length: float) -> None:
        own, n = self._own, max(1, math.ceil(length / SOLVER_STEP - 1e-9))
        h = length / n

        def slope(time: float, states: Floats) -> Floats:
            own.set_time(time)
            own.set_states(states)
            return own.derivatives()

        x = own.get_states()
        for i in range(n):
            t = start + i * h
            k1 = slope(t, x)
            k2 = slope(t + 0.5 * h, x + 0.5 * h * k1)
            k3 = slope(t + 0.5 * h, x + 0.5 * h * k2)
            k4 = slope(t + h, x + h * k3)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        own.set_time(start + length)
        own.set_states(x)

    # --- Model Exchange -----------------------------------------------------------------------------------------------
    def set_time(self, time: float) -> None:
        """The independent variable."""
        self.time = time
        self._own.set_time(time)

    def set_continuous_states(self, values: Sequence[float]) -> None:
        """In the order of the declarations."""
        self._own.set_states(np.array(values, dtype=float))

    def get_continuous_states(self) -> list[float]:
        """In the order of the declarations."""
        states: list[float] = self._own.get_states().tolist()
        return states

    def get_continuous_state_derivatives(self) -> list[float]:
        """Of the states."""
        slopes: list[float] = self._own.derivatives().tolist()
        return slopes

    def get_number_of_continuous_states(self) -> int:
        """Their number, elements of arrays counted one by one."""
        return self._own.n_states

    def update_discrete_states(self) -> Any:
        """An event of the component."""
        from pythonfmu3.modelexchange import Fmi3UpdateDiscreteStatesResult

        try:
            event = self._own.update_discrete_states()
        except EndRequestedError:
            return Fmi3UpdateDiscreteStatesResult(terminateSimulation=True)
        return Fmi3UpdateDiscreteStatesResult(
            valuesOfContinuousStatesChanged=True,
            nextEventTimeDefined=event is not None,
            nextEventTime=0.0 if event is None else event,
        )

    # --- saved states -------------------------------------------------------------------------------------------------
    def _get_fmu_state(self) -> _Kept:
        return _Kept(self._own, (self.time, self._start_time, self._own.save()))

    def _set_fmu_state(self, state: _Kept | bytes) -> None:
        if isinstance(state, _Kept) and state.own is not self._own:  # of before a reset
            state = state.as_bytes()
        times_and_state: Any = self._own.from_bytes(state) if isinstance(state, bytes) else state.content
        self.time, self._start_time, saved = times_and_state
        self._own.restore(saved)

    @staticmethod
    def _fmu_state_to_bytes(state: _Kept | bytes) -> bytes:
        return state if isinstance(state, bytes) else state.as_bytes()

    @staticmethod
    def _fmu_state_from_bytes(state: bytes) -> bytes:
        return state

    def _abilities(self) -> tuple[bool, bool]:
        """Whether the state can be saved, and whether that can be written as bytes; as far as start values can tell."""
        can = self._described.can_get_and_set_state
        own = PythonInstance(self.TARGET, self.TARGET, Interface.CO_SIMULATION, self._described)
        try:
            own.enter_initialization(0.0, math.inf)
            own.exit_initialization()
        except ComponentError:
            return can, can
        try:
            saved = own.save()
        except ComponentError:
            return False, False
        try:
            own.to_bytes(saved)
        except Exception:
            return can, False
        return can, can

    # --- the model description ----------------------------------------------------------------------------------------
    def to_xml(self, model_options: Mapping[str, str] | None = None) -> Element:
        """PythonFMU3's, with what it has no words for: direct dependencies, and what it can and needs."""
        root: Element = super().to_xml(dict(model_options or {}))  # type: ignore[misc]
        variables = self._described.variables
        names = {v.get("valueReference"): v.get("name") for v in root.iterfind("ModelVariables/*")}
        references = {name: reference for reference, name in names.items()}
        for output in root.iterfind("ModelStructure/Output"):
            variable = variables[names[output.get("valueReference")] or ""]
            if variable.dependencies is not None:
                output.set("dependencies", " ".join(references[name] or "" for name in variable.dependencies))
        can_save, can_serialize = self._abilities()
        for kind in ("ModelExchange", "CoSimulation"):
            for node in root.iterfind(kind):
                node.set("needsExecutionTool", "false")
                node.set("canGetAndSetFMUState", str(can_save).lower())
                node.set("canSerializeFMUState", str(can_serialize).lower())
                if kind == "CoSimulation":
                    node.set("canHandleVariableCommunicationStepSize", "true")
        return root


@dataclass
class _Kept:
    """A saved state, and the instance whose it is."""

    own: PythonInstance
    content: tuple[float, float, object]
    written: bytes | None = None

    def as_bytes(self) -> bytes:
        """Asked for twice: for their number, and for themselves."""
        if self.written is None:
            self.written = self.own.to_bytes(self.content)
        return self.written


class _Registration:
    """Tells PythonFMU3 what variables there are."""

    def __init__(self, slave: Any, description: Description, own: PythonInstance) -> None:
        self._slave = slave
        self._description = description
        self._own = own

    def register(self) -> None:
        """All of them; references count in this order."""
        import pythonfmu3 as fmu

        self._slave.register_units(list(self._units()))
        continuous = fmu.Fmi3Variability.continuous
        independent = fmu.Float64("time", causality=fmu.Fmi3Causality.independent, variability=continuous)
        self._slave.register_variable(independent)
        states: list[tuple[int, Variable]] = []
        for variable in self._description.variables.values():
            if variable.causality == "structuralParameter":
                continue
            if self._is_state(variable):
                states.append((len(self._slave.vars), variable))
            self._slave.register_variable(self._registered(variable), nested=False)
        offset = 0
        for reference, variable in states:
            begin, offset = offset, offset + variable.size
            self._slave.register_variable(self._derivative(variable, reference, begin), nested=False)

    def _is_state(self, variable: Variable) -> bool:
        from cosim.components.python import State, load

        return isinstance(getattr(load(self._slave.TARGET).cls, variable.name, None), State) and bool(
            self._own.n_states
        )

    def _units(self) -> Any:
        from pythonfmu3.unit import Unit

        known = {v.unit: v.measure for v in self._description.variables.values() if v.unit}
        for name, measure in known.items():
            exponents = dict(zip(BASE, measure.exponents, strict=True)) if measure else {}
            factor, offset = (measure.factor, measure.offset) if measure else (1.0, 0.0)
            yield Unit(name, factor=factor, offset=offset, **exponents)

    def _registered(self, variable: Variable) -> Any:
        import pythonfmu3 as fmu

        own, dtype = self._own, variable.dtype
        arguments: dict[str, Any] = {
            "causality": fmu.Fmi3Causality[variable.causality],
            "variability": fmu.Fmi3Variability[variable.variability],
            "description": variable.description or None,
            "getter": _getter(own, variable),
            "setter": _setter(own, variable),
        }
        if variable.causality == "output":
            exact = variable.initial == "exact"
            arguments["initial"] = fmu.Fmi3Initial.exact if exact else fmu.Fmi3Initial.calculated
        if dtype == "Float64":
            arguments["unit"] = variable.unit
        if dtype == "Enumeration":
            arguments["declared_type"] = f"{variable.name} items"
            items = fmu.EnumerationType(f"{variable.name} items", values=())
            for name, value in variable.items.items():
                items.add_value(name, value)
            self._slave.type_definitions[f"{variable.name} items"] = items
        elif dtype != "String":
            arguments["dimensions"] = [fmu.Dimension(start=str(n)) for n in variable.shape]
        registered = getattr(fmu, dtype)(variable.name, **arguments)
        if dtype == "Enumeration":  # PythonFMU3 asks every whole number for these, and its enumerations have none
            registered.dimensions, registered.size = [], lambda _variables: 1
        return registered

    def _derivative(self, variable: Variable, reference: int, begin: int) -> Any:
        import pythonfmu3 as fmu

        own, size, scalar = self._own, variable.size, not variable.shape

        def getter() -> Any:
            slopes = own.derivatives()[begin : begin + size].tolist()
            return slopes[0] if scalar else slopes

        return fmu.Float64(
            f"der({variable.name})",
            causality=fmu.Fmi3Causality.local,
            variability=fmu.Fmi3Variability.continuous,
            derivative=reference if scalar else [reference],  # PythonFMU3 writes it as it writes start values
            dimensions=[fmu.Dimension(start=str(n)) for n in variable.shape],
            getter=getter,
        )


def _getter(own: PythonInstance, variable: Variable) -> Callable[[], Any]:
    kind = {"Float64": float, "Boolean": bool, "String": str}.get(variable.dtype, int)

    def getter() -> Any:
        values = [kind(x) for x in own.peek(variable)]
        return values if variable.shape else values[0]

    return getter


def _setter(own: PythonInstance, variable: Variable) -> Callable[[Any], None]:
    def setter(value: Any) -> None:
        values = list(value) if isinstance(value, (list, tuple, np.ndarray)) else [value]
        if variable.dtype == "String":
            own.start(variable, values)
        else:
            own.set(variable, np.array(values, dtype=float))

    return setter
