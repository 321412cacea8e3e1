"""FMI 3.0: live instances. Structural parameters are set in Configuration Mode."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from cosim.components.component import Description, Floats, Interface, Variable
from cosim.components.fmu.component import EVENTS_PER_STEP, SHORTEST, FmuComponent
from cosim.components.fmu.library import (
    File,
    FMICallException,
)
from cosim.components.fmu.variables import fmi3_shape
from cosim.logs import Sink, discard


class Fmi3Component(FmuComponent):
    """FMI 3.0; structural parameters are set in Configuration Mode."""

    def __init__(
        self, name: str, file: File, interface: Interface, description: Description, log: Sink = discard
    ) -> None:
        self.uses_events = interface is Interface.CO_SIMULATION and bool(file.implementations[interface].hasEventMode)
        super().__init__(name, file, interface, description, log)
        self._file = file
        self._structural: dict[str, int] = {}
        self._count_states()

    def _count_states(self) -> None:
        if self.interface is Interface.MODEL_EXCHANGE:
            model = self._file.model
            self._resize(self._size(model.derivatives), self._size(model.eventIndicators))

    def _size(self, unknowns: Sequence[Any]) -> int:
        shapes = (fmi3_shape(unknown.variable, self._structural) for unknown in unknowns)
        return sum(int(np.prod(shape, dtype=np.int64)) for shape in shapes)

    def _instantiate(self) -> None:
        log = self.log
        events = {"eventModeUsed": True, "earlyReturnAllowed": True} if self.uses_events else {}
        self._fmu.instantiate(logMessage=lambda _environment, status, _category, text: log.add(status, text), **events)

    def _start(self, variable: Variable, values: list[Any]) -> None:
        if variable.causality != "structuralParameter":
            super()._start(variable, values)
            return
        self._call("fmi3EnterConfigurationMode")
        super()._start(variable, values)
        self._call("fmi3ExitConfigurationMode")
        self._structural[variable.name] = values[0]
        self._count_states()

    def _set_strings(self, variable: Variable, values: ctypes.Array[ctypes.c_char_p]) -> None:
        references = (ctypes.c_uint * len(variable.references))(*variable.references)
        self._call("fmi3SetString", references, len(references), values, len(values))

    def _set_binaries(self, variable: Variable, values: Sequence[bytes]) -> None:
        references = (ctypes.c_uint * len(variable.references))(*variable.references)
        sizes = (ctypes.c_size_t * len(values))(*map(len, values))
        memory = [ctypes.create_string_buffer(value, max(len(value), 1)) for value in values]
        byte_pointer = ctypes.POINTER(ctypes.c_uint8)
        pointers = (byte_pointer * len(values))(*(ctypes.cast(piece, byte_pointer) for piece in memory))
        self._call("fmi3SetBinary", references, len(references), sizes, pointers, len(values))

    def enter_initialization(self, start_time: float, stop_time: float) -> None:
        self._call("fmi3EnterInitializationMode", *self._tolerance(), start_time, True, stop_time)

    def step(self, time: float, step: float) -> None:
        start, end, length = time, time + step, step
        for _ in range(EVENTS_PER_STEP):
            needed, early, reached = self._step_once(start, length)
            if needed and self.uses_events:
                self.enter_event_mode()
                self.update_discrete_states()
                self.enter_step_mode()
            if not early or (self.uses_events and end - reached <= SHORTEST * step):
                return
            if not self.uses_events:
                raise self.early_return(reached)
            start, length = reached, end - reached
        raise self.too_many_events()

    def _step_once(self, time: float, step: float) -> tuple[bool, bool, float]:
        """Whether events are to be handled, whether it returned early, and the time reached."""
        self.require_usable()
        try:
            needed, stop, early, reached = self._fmu.doStep(time, step, not self.goes_back)
        except FMICallException as error:
            raise self.failure("fmi3DoStep", error.status) from None
        if stop:
            raise self.stop_requested()
        return needed, early, reached

    def enter_step_mode(self) -> None:
        self._call("fmi3EnterStepMode")

    def derivatives(self) -> Floats:
        return self._get_vector("fmi3GetContinuousStateDerivatives")

    def _update_discrete_states(self) -> tuple[bool, bool, bool, bool, bool, float]:
        result: tuple[bool, bool, bool, bool, bool, float] = self._fmu.updateDiscreteStates()
        return result
