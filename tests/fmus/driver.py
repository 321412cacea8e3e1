"""Drives one FMU instance through FMPy's low-level classes, by variable name, alike for FMI 2.0 and 3.0."""

from __future__ import annotations

import ctypes
import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import (
    FMU2Model,
    FMU2Slave,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.fmi3 import FMU3Model, FMU3Slave
from numpy.typing import NDArray

from fmus import build
from fmus.description import load

Floats = NDArray[np.float64]

ME = "ModelExchange"
CS = "CoSimulation"


class Driver:
    """One instance. Every error line that it logs is kept in `log`."""

    def __init__(self, path: Path, interface: str, unpacked: Path | None = None, guid: str | None = None) -> None:
        self.log: list[str] = []
        self.directory = Path(unpacked or extract(str(path)))
        self.owned = unpacked is None
        description = read_model_description(str(self.directory))
        self.version = int(description.fmiVersion[0])
        self.interface = interface
        self.variables = {variable.name: variable for variable in description.modelVariables}
        self.model = load(build.ROOT / description.modelName / "model.toml")
        self.sizes = {variable.name: int(variable.start[0]) for variable in self.model.structural}
        self.time = 0.0
        kinds = {(2, ME): FMU2Model, (2, CS): FMU2Slave, (3, ME): FMU3Model, (3, CS): FMU3Slave}
        self.fmu = kinds[self.version, interface](
            guid=guid or description.guid,
            unzipDirectory=str(self.directory),
            modelIdentifier=description.modelName,
            instanceName="instance",
        )
        self.n_states = int(description.numberOfContinuousStates)

    def instantiate(self) -> Driver:
        if self.version == 2:
            callbacks = fmi2CallbackFunctions()
            callbacks.logger = fmi2CallbackLoggerTYPE(self._log2)
            self.fmu.instantiate(callbacks=callbacks)
        else:
            self.fmu.instantiate(logMessage=self._log3)
        return self

    def _log2(self, _environment: Any, _name: bytes, _status: int, _category: bytes, message: bytes) -> None:
        self.log.append(message.decode())

    def _log3(self, _environment: Any, _status: int, _category: bytes, message: bytes) -> None:
        self.log.append(message.decode())

    def close(self) -> None:
        if self.fmu.component:
            self.fmu.freeInstance()
        if self.owned:
            shutil.rmtree(self.directory)

    # --- values -----------------------------------------------------------------------------------------------------
    def references(self, name: str) -> tuple[list[int], str, int]:
        """Value references, FMI type and number of elements of a variable or array (by its name without subscripts)."""
        extents = self.shape(name)
        if self.version == 3:
            variable = self.variables[name]
            return [variable.valueReference], variable.type, int(np.prod(extents, dtype=int))
        stem, end = (name[:-1], ")") if name.startswith("der(") else (name, "")
        subscripts = [f"[{','.join(map(str, index))}]" for index in product(*(range(1, n + 1) for n in extents))]
        names = [f"{stem}{subscript}{end}" for subscript in subscripts] if extents else [name]
        kind = self.variables[names[0]].type if names else self.model.named(name).kind
        return [self.variables[n].valueReference for n in names], kind, len(names)

    def shape(self, name: str) -> tuple[int, ...]:
        """The dimensions in use."""
        shape = self.model.named(name).shape
        return tuple(extent if isinstance(extent, int) else self.sizes[extent] for extent in shape)

    def get(self, name: str) -> Floats:
        """Flat values, as float64."""
        references, kind, size = self.references(name)
        if size == 0:
            return np.empty(0)
        if self.version == 3:
            kind = "Int64" if kind == "Enumeration" else kind
            return np.asarray(getattr(self.fmu, f"get{kind}")(references, nValues=size), dtype=np.float64)
        kind = "Integer" if kind == "Enumeration" else kind
        return np.asarray(getattr(self.fmu, f"get{kind}")(references), dtype=np.float64)

    def set(self, **values: Any) -> None:
        for name, value in values.items():
            references, kind, size = self.references(name)
            array = np.asarray(value, dtype=np.float64)
            flat = (array if array.size == size else np.broadcast_to(array, self.shape(name))).ravel().tolist()
            if kind in ("Enumeration", "Integer", "Int64", "UInt64"):
                flat = [int(x) for x in flat]
            if kind == "Boolean":
                flat = [bool(x) for x in flat]
            if kind == "Enumeration":
                kind = "Integer" if self.version == 2 else "Int64"
            getattr(self.fmu, f"set{kind}")(references, flat)

    # --- life cycle -------------------------------------------------------------------------------------------------
    def resize(self, name: str, size: int) -> None:
        """Set a structural parameter."""
        self.sizes[name] = size
        if self.version == 3:
            self.fmu.enterConfigurationMode()
            self.fmu.setUInt64([self.variables[name].valueReference], [size])
            self.fmu.exitConfigurationMode()
            if self.model.states and self.model.states[0].dynamic:
                self.n_states = sum(int(np.prod(self.shape(state.name))) for state in self.model.states)
        else:
            self.fmu.setInteger([self.variables[name].valueReference], [size])

    def initialize(self, *, start_time: float = 0.0, stop_time: float | None = None, **start: Any) -> Driver:
        """Set start values and initialise, with two axes by default; leaves Model Exchange in Continuous-Time Mode."""
        if "n_axes" in self.sizes:
            start = {"n_axes": 2, **start}
        for name in self.sizes:
            if name in start:
                self.resize(name, start.pop(name))
        self.set(**start)
        if self.version == 2:
            self.fmu.setupExperiment(startTime=start_time, stopTime=stop_time)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=start_time, stopTime=stop_time)
        self.fmu.exitInitializationMode()
        self.time = start_time
        if self.interface == ME:
            self.next_event = self.update()
            self.fmu.enterContinuousTimeMode()
        return self

    # --- Co-Simulation ----------------------------------------------------------------------------------------------
    def step(self, size: float) -> None:
        self.fmu.doStep(self.time, size)
        self.time += size

    def step_to(self, time: float) -> None:
        self.fmu.doStep(self.time, time - self.time)
        self.time = time

    # --- Model Exchange ---------------------------------------------------------------------------------------------
    def update(self) -> float:
        """One event iteration; time of the next time event, or infinity."""
        info = self.fmu.newDiscreteStates() if self.version == 2 else self.fmu.updateDiscreteStates()
        assert not info[0]
        return float(info[5]) if info[4] else np.inf

    def event(self, **values: Any) -> None:
        """Event Mode at the current time, with new inputs."""
        self.fmu.enterEventMode()
        self.set(**values)
        self.next_event = self.update()
        self.fmu.enterContinuousTimeMode()

    @property
    def states(self) -> Floats:
        x = np.zeros(self.n_states)
        self.fmu.getContinuousStates(x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), x.size)
        return x

    @states.setter
    def states(self, x: Floats) -> None:
        x = np.ascontiguousarray(x, dtype=np.float64)
        self.fmu.setContinuousStates(x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), x.size)

    def derivatives(self, time: float, x: Floats) -> Floats:
        self.fmu.setTime(time)
        self.states = x
        dx = np.zeros(self.n_states)
        get = self.fmu.getDerivatives if self.version == 2 else self.fmu.getContinuousStateDerivatives
        get(dx.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), dx.size)
        return dx

    def integrate(
        self, end: float, solve: Callable[[Callable[[float, Floats], Floats], float, float, Floats], Floats]
    ) -> None:
        """Integrate to `end` with `solve(f, begin, end, x)`, stopping at the time events of the FMU."""
        while self.time < end:
            stop = min(end, self.next_event)
            x = solve(self.derivatives, self.time, stop, self.states)
            self.fmu.setTime(stop)
            self.states = x
            self.time = stop
            if stop == self.next_event:
                self.event()

    def save(self) -> bytes:
        """The serialized state."""
        if self.version == 2:
            state = self.fmu.getFMUstate()
            data = bytes(self.fmu.serializeFMUstate(state))
            self.fmu.freeFMUstate(state)
        else:
            state = self.fmu.getFMUState()
            data = bytes(self.fmu.serializeFMUState(state))
            self.fmu.freeFMUState(state)
        return data

    def restore(self, data: bytes) -> None:
        if self.version == 2:
            state = self.fmu.deSerializeFMUstate(data)
            self.fmu.setFMUstate(state)
            self.fmu.freeFMUstate(state)
        else:
            state = self.fmu.deserializeFMUState(data)
            self.fmu.setFMUState(state)
            self.fmu.freeFMUState(state)
