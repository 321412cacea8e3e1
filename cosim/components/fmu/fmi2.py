"""FMI 2.0: live instances."""

from __future__ import annotations

import contextlib
import ctypes
import time as clock

from cosim.components.component import Description, Floats, Interface, Variable
from cosim.components.fmu.component import PENDING, WARNING, FmuComponent
from cosim.components.fmu.library import (
    DO_STEP_STATUS,
    LAST_SUCCESSFUL_TIME,
    TERMINATED,
    File,
    FMICallException,
    fmi2_callbacks,
)
from cosim.errors import ComponentError, DiscardedStepError
from cosim.logs import Sink, discard

PENDING_DEADLINE = 60.0
"""Seconds of wall time that an asynchronous step may take."""

PENDING_PAUSE = 0.001
"""Seconds between two questions whether it is done."""


class Fmi2Component(FmuComponent):
    """FMI 2.0."""

    def __init__(
        self, name: str, file: File, interface: Interface, description: Description, log: Sink = discard
    ) -> None:
        super().__init__(name, file, interface, description, log)
        model = file.model
        if interface is Interface.MODEL_EXCHANGE:
            self._resize(model.numberOfContinuousStates, model.numberOfEventIndicators)

    def _instantiate(self) -> None:
        self._fmu.instantiate(callbacks=fmi2_callbacks(self.log))

    def _set_strings(self, variable: Variable, values: ctypes.Array[ctypes.c_char_p]) -> None:
        references = (ctypes.c_uint * len(variable.references))(*variable.references)
        self._call("fmi2SetString", references, len(references), values)

    def enter_initialization(self, start_time: float, stop_time: float) -> None:
        self._call("fmi2SetupExperiment", *self._tolerance(), start_time, 1, stop_time)
        self._call("fmi2EnterInitializationMode")

    def step(self, time: float, step: float) -> None:
        self.require_usable()
        try:
            self._fmu.fmi2DoStep(self._instance, time, step, 0 if self.goes_back else 1)
        except FMICallException as error:
            if error.status != PENDING or not self.description.asynchronous:
                raise self.failure("fmi2DoStep", error.status) from None
            self._await_step()

    def _await_step(self) -> None:
        """Wait for an asynchronous step (FMI 2.0.5, section 4.2.2)."""
        deadline = clock.monotonic() + PENDING_DEADLINE
        while (status := self._fmu.getStatus(DO_STEP_STATUS)) == PENDING:
            if clock.monotonic() > deadline:
                self._usable = False  # it still works on its memory, which must not be freed
                text = f"fmi2DoStep returned Pending, and its step is not done after {PENDING_DEADLINE:.3g} s"
                raise ComponentError(self.name, text, self.log.last)
            clock.sleep(PENDING_PAUSE)
        if status > WARNING:
            raise self.failure("fmi2DoStep", status)

    def failure(self, function: str, status: int) -> ComponentError:
        error = super().failure(function, status)
        if isinstance(error, DiscardedStepError) and self._asks_for_the_end():
            return self.stop_requested()
        if status == PENDING:
            text = f"{error.message}, although it declares that it does not step asynchronously (canRunAsynchronuously)"
            return ComponentError(self.name, text, error.log)
        return error

    def _asks_for_the_end(self) -> bool:
        with contextlib.suppress(FMICallException):
            return bool(self._fmu.getBooleanStatus(TERMINATED))
        return False

    def _how_far(self) -> str:
        with contextlib.suppress(FMICallException):
            return f": it only got to t = {self._fmu.getRealStatus(LAST_SUCCESSFUL_TIME):.9g} s"
        return ""

    def derivatives(self) -> Floats:
        return self._get_vector("fmi2GetDerivatives")

    def _update_discrete_states(self) -> tuple[bool, bool, bool, bool, bool, float]:
        result: tuple[bool, bool, bool, bool, bool, float] = self._fmu.newDiscreteStates()
        return result
