"""FMUs of FMI 2.0 and 3.0, Co-Simulation and Model Exchange: the only file that imports FMPy.

Importing it takes a while (FMPy brings lxml and more), so others import it inside functions. A file is read and
unpacked once per process, its library loaded once; every instance then costs little more than its own instantiation.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import functools
import io
import itertools
import os
import threading
import weakref
import zipfile
import zlib
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from cosim.archive import Archive, inspect, refuse, unpack
from cosim.component import Component, Description, Floats, Interface, Value, Variable
from cosim.errors import ComponentError
from cosim.fmu_values import FMI2_TYPES, FMI3_TYPES, Buffer, start_values
from cosim.fmu_variables import fmi2_variables, fmi3_shape, fmi3_variables

with contextlib.redirect_stdout(io.StringIO()):  # where FMPy has no logger for the platform, it prints so
    import fmpy
    from fmpy.fmi1 import FMICallException
    from fmpy.fmi2 import (
        FMU2Model,
        FMU2Slave,
        defaultCallbacks,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
        fmi2LastSuccessfulTime,
    )
    from fmpy.fmi3 import FMU3Model, FMU3Slave
    from fmpy.model_description import ValidationError, read_model_description

LOG_LINES = 100
"""How many of the latest lines that an instance logged are kept."""

DISCRETE_STATE_ITERATIONS = 100
"""How often an FMU may ask for another update of its discrete states at one instant."""

DISCARD, FATAL = 2, 4
STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")

_lock = threading.RLock()


# --- files ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _File:
    """An FMU file that has been read; compared by identity.

    Attributes:
        model: FMPy's `ModelDescription`.
        implementations: what the file says of each interface that can be used here.
        library_folder: name of the folder under `binaries/` for this platform, or None.
    """

    archive: Archive
    model: Any
    implementations: Mapping[Interface, Any]
    library_folder: str | None

    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    @property
    def fmi(self) -> int:
        """Major version of the standard."""
        return int(self.model.fmiMajorVersion)


def describe(path: Path, structural: Mapping[str, int] | None = None) -> Description:
    """What an FMU says of itself.

    Args:
        path: of the file.
        structural: values of FMI 3.0 structural parameters, which size its arrays; others keep their start values.
            Names that are no structural parameters are ignored.

    Raises:
        ConfigError: missing, truncated or malicious file, no or a broken model description, FMI 1.0, no binary for this
            platform, or one that only works inside its own tool.
    """
    file = _read(Path(path))
    if file.library_folder is None:
        offered = ", ".join(file.archive.platforms) or "none"
        raise refuse(
            file.archive.path,
            f"has no binary for this platform ({fmpy.platform_tuple}); it has: {offered}. "
            "Ask its supplier for one, or run on another platform",
        )
    implementations = file.implementations
    co_simulation = implementations.get(Interface.CO_SIMULATION)
    variables = fmi2_variables(file.model) if file.fmi == 2 else fmi3_variables(file.model, structural or {})
    return Description(
        model=file.model.modelName,
        fmi=f"{file.fmi}.0",
        interfaces=tuple(implementations),
        variables=variables,
        platforms=file.archive.platforms,
        sha256=file.archive.sha256,
        n_event_indicators=file.model.numberOfEventIndicators,
        variable_step=co_simulation is None or co_simulation.canHandleVariableCommunicationStepSize,
        can_get_and_set_state=all(x.canGetAndSetFMUstate for x in implementations.values()),
    )


def _read(path: Path) -> _File:
    """The file, read again only if it changed."""
    try:
        status = path.stat()
    except OSError:
        inspect(path)  # says what is wrong
        raise
    with _lock:
        return _read_version(path.absolute(), status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=256)
def _read_version(path: Path, _mtime_ns: int, _size: int) -> _File:
    archive = inspect(path)
    if "modelDescription.xml" not in archive.names:
        raise refuse(path, "is not an FMU: it holds no modelDescription.xml")
    model = _read_model(path)
    needing_tool = []
    implementations = {}
    for interface, implementation in (
        (Interface.MODEL_EXCHANGE, model.modelExchange),
        (Interface.CO_SIMULATION, model.coSimulation),
    ):
        if implementation is None:
            continue
        if implementation.needsExecutionTool:
            needing_tool.append(interface)
        else:
            implementations[interface] = implementation
    if needing_tool and not implementations:
        tool = model.generationTool or "the tool that made it"
        raise refuse(path, f"only works together with {tool} (needsExecutionTool); export it without that need")
    if not implementations:
        raise refuse(path, "offers neither Model Exchange nor Co-Simulation")
    return _File(archive, model, implementations, _library_folder(archive, model, implementations))


def _read_model(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as archive:
            xml = archive.read("modelDescription.xml")
        _, root = next(ElementTree.iterparse(io.BytesIO(xml), ("start",)))  # noqa: S314 - expat limits entities itself
    except (ElementTree.ParseError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, StopIteration) as error:
        raise refuse(path, f"has a broken modelDescription.xml: {error}") from error
    version = root.get("fmiVersion")
    if root.tag != "fmiModelDescription" or version is None:
        raise refuse(path, "has a broken modelDescription.xml: it does not say which version of FMI it follows")
    if version != "2.0" and not version.startswith("3."):
        raise refuse(path, f"is an FMU of FMI {version}; export it for FMI 2.0 or 3.0")
    alone = io.BytesIO()  # FMPy reads archives only, and would leave the file open when it fails
    with zipfile.ZipFile(alone, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
    try:
        return read_model_description(alone, validate=False)
    except Exception as error:  # FMPy raises whatever the first missing attribute leads to
        raise refuse(path, f"has a broken modelDescription.xml: {_first_problem(alone) or error}") from error


def _first_problem(file: io.BytesIO) -> str:
    """What the schema has to say about a description that FMPy cannot read; empty if that is nothing."""
    try:
        read_model_description(file, validate=True)
    except ValidationError as invalid:
        return str(invalid.problems[0])
    except Exception:  # the same as before
        return ""
    return ""


def _library_folder(archive: Archive, model: Any, implementations: Mapping[Interface, Any]) -> str | None:
    """FMI 2.0 names the platform `linux64`, FMI 3.0 `x86_64-linux`, which some use in FMI 2.0 too."""
    folders = (fmpy.platform_tuple,) if int(model.fmiMajorVersion) == 3 else (fmpy.platform, fmpy.platform_tuple)
    libraries = {x.modelIdentifier + fmpy.sharedLibraryExtension for x in implementations.values()}
    names = set(archive.names)
    return next((f for f in folders if all(f"binaries/{f}/{library}" in names for library in libraries)), None)


# --- libraries ------------------------------------------------------------------------------------------------------
@functools.cache
def _unpacked(file: _File) -> Path:
    """The binaries for this platform and the resources; documentation and sources stay packed."""

    def wanted(name: str) -> bool:
        parts = PurePosixPath(name).parts
        return parts[:1] == ("resources",) or parts[:2] == ("binaries", file.library_folder)

    return unpack(file.archive, wanted)


def _load(file: _File, interface: Interface) -> Any:
    """FMPy's object around a freshly loaded library."""
    once = file.implementations[interface].canBeInstantiatedOnlyOncePerProcess
    folder = _unpacked.__wrapped__(file) if once else _unpacked(file)  # a copy of its own for every such instance
    identifier = file.implementations[interface].modelIdentifier
    library = folder / "binaries" / str(file.library_folder) / (identifier + fmpy.sharedLibraryExtension)
    arguments = {"guid": file.model.guid, "modelIdentifier": identifier, "unzipDirectory": str(folder)}
    if file.fmi == 2:
        arguments["libraryPath"] = str(library)
    working_directory = Path.cwd()
    try:
        fmu = _CLASSES[file.fmi, interface](**arguments)
    finally:
        os.chdir(working_directory)  # FMPy changes it, and does not come back if loading fails
    if os.name == "nt":  # a loaded library could not be removed
        import atexit

        atexit.register(fmu.freeLibrary)
    return fmu


_CLASSES = {
    (2, Interface.MODEL_EXCHANGE): FMU2Model,
    (2, Interface.CO_SIMULATION): FMU2Slave,
    (3, Interface.MODEL_EXCHANGE): FMU3Model,
    (3, Interface.CO_SIMULATION): FMU3Slave,
}

_cached_load = functools.cache(_load)


def _open_library(file: _File, interface: Interface) -> Any:
    """FMPy's object, ready to be instantiated. Its constructor costs a millisecond, a copy of it next to nothing."""
    with _lock:
        if file.implementations[interface].canBeInstantiatedOnlyOncePerProcess:
            return _load(file, interface)
        return copy.copy(_cached_load(file, interface))


# --- logging --------------------------------------------------------------------------------------------------------
class Log:
    """The latest lines that one instance logged."""

    def __init__(self) -> None:
        self.lines: deque[str] = deque(maxlen=LOG_LINES)

    @property
    def last(self) -> str | None:
        return self.lines[-1] if self.lines else None

    def add(self, status: int, message: bytes | None) -> None:
        """Called by the FMU, from native code: must not raise."""
        text = (message or b"").decode(errors="replace").strip()
        label = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
        self.lines.append(f"[{label}] {text}")


_logs: weakref.WeakValueDictionary[int, Log] = weakref.WeakValueDictionary()
_log_numbers = itertools.count(1)


def _receive_fmi2(environment: int | None, _name: bytes, status: int, _category: bytes, message: bytes) -> None:
    log = _logs.get(environment or 0)
    if log is not None:
        log.add(status, message)


_fmi2_logger = fmi2CallbackLoggerTYPE(_receive_fmi2)


def _fmi2_callbacks(log: Log) -> Any:
    """Callbacks that lead to `log`. FMPy's proxy formats the variadic message; it knows one receiver per process."""
    number = next(_log_numbers)
    _logs[number] = log
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = _fmi2_logger
    callbacks.allocateMemory = defaultCallbacks.allocateMemory
    callbacks.freeMemory = defaultCallbacks.freeMemory
    callbacks.componentEnvironment = number
    with contextlib.suppress(ImportError, OSError):  # no proxy for this platform: messages keep their placeholders
        from fmpy.logging import addLoggerProxy

        addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


# --- components -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Native:
    """What the native loop needs of an instance.

    Attributes:
        fmi: 2 or 3.
        instance: the FMU's instance pointer.
        address: of an FMI function of its library, by the function's name in the standard.
    """

    fmi: int
    instance: int
    address: Callable[[str], int]


class FmuComponent(Component):
    """An FMU instance. After status Error it is only freed, after Fatal it is never touched again."""

    def __init__(self, name: str, file: _File, interface: Interface, description: Description) -> None:
        self.name = name
        self.interface = interface
        self.description = description
        self.log = Log()
        self._usable = True
        self._initialised = False
        self._failed = False
        self._fmi = file.fmi
        self._types = FMI2_TYPES if file.fmi == 2 else FMI3_TYPES
        self._buffers: dict[tuple[str, int], Buffer] = {}
        try:
            self._fmu = _open_library(file, interface)
            self._fmu.instanceName = name
            self._instantiate()
        except Exception as error:  # FMPy raises bare exceptions
            raise ComponentError(name, f"cannot be opened: {error}", self.log.last) from error
        self._instance = self._fmu.component

    @abstractmethod
    def _instantiate(self) -> None: ...

    def native(self) -> Native:
        """For `cosim.kernel`; valid until `terminate`."""
        dll = self._fmu.dll
        return Native(
            fmi=self._fmi,
            instance=self._instance,
            address=lambda name: ctypes.cast(getattr(dll, name), ctypes.c_void_p).value or 0,
        )

    def require_usable(self) -> None:
        """Raise `ComponentError` if the instance has failed or ended, so that it must not be called."""
        if not self._usable or self._failed:
            raise ComponentError(self.name, "has failed or ended and cannot be called any more", self.log.last)

    def failure(self, function: str, status: int) -> ComponentError:
        """The error for an FMI call that returned `status`; remembers what may still be called (FMI 3.0, 2.2.3)."""
        self._failed = self._failed or status > DISCARD
        if status == FATAL:
            self._usable = False
        label = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
        return ComponentError(self.name, f"{function} returned {label}", self.log.last)

    def stop_requested(self) -> ComponentError:
        """The error for an FMU that sets `terminateSimulation`."""
        return ComponentError(self.name, "asks to end the simulation (terminateSimulation)", self.log.last)

    def early_return(self, reached: float) -> ComponentError:
        """The error for an FMI 3.0 step cut short, which `earlyReturnAllowed = false` forbids."""
        return ComponentError(self.name, f"fmi3DoStep returned early, at t = {reached:.9g} s", self.log.last)

    def unsettled(self) -> ComponentError:
        """The error for an FMU whose discrete states never settle."""
        rounds = DISCRETE_STATE_ITERATIONS
        return ComponentError(
            self.name, f"its discrete states did not settle within {rounds} updates at one instant", self.log.last
        )

    def _call(self, function: str, *arguments: Any) -> None:
        self.require_usable()
        try:
            getattr(self._fmu, function)(self._instance, *arguments)
        except FMICallException as error:
            raise self.failure(function, error.status) from None

    # --- values -----------------------------------------------------------------------------------------------------
    def _buffer(self, variable: Variable) -> Buffer:
        key = (variable.name, variable.size)
        buffer = self._buffers.get(key)
        if buffer is None:
            if variable.dtype not in self._types:
                raise ComponentError(self.name, f"{variable.name} is of type {variable.dtype}: it holds no numbers")
            buffer = self._buffers[key] = Buffer(self._fmi, self._types[variable.dtype], variable)
        return buffer

    def get(self, variable: Variable) -> Floats:
        buffer = self._buffer(variable)
        if variable.size:
            self._call(buffer.getter, *buffer.arguments)
        return buffer.values.astype(np.float64)

    def set(self, variable: Variable, values: Floats) -> None:
        buffer = self._buffer(variable)
        buffer.store(values)
        if variable.size:
            self._call(buffer.setter, *buffer.arguments)

    def start(self, variable: Variable, values: Sequence[Value]) -> None:
        try:
            converted = start_values(variable, values)
        except ValueError as error:
            raise ComponentError(self.name, f"{variable.name} {error}", self.log.last) from None
        if not converted:
            return
        try:
            self._start(variable, converted)
        except ComponentError as error:
            raise ComponentError(
                self.name, f"the start value of {variable.name} is refused: {error.message}", error.log
            ) from None

    def _start(self, variable: Variable, values: list[Any]) -> None:
        if variable.dtype == "String":
            self._set_strings(variable, (ctypes.c_char_p * len(values))(*(value.encode() for value in values)))
            return
        buffer = self._buffer(variable)
        try:
            buffer.values[:] = values
        except OverflowError:
            raise ComponentError(self.name, f"it does not fit into {variable.dtype}") from None
        self._call(buffer.setter, *buffer.arguments)

    @abstractmethod
    def _set_strings(self, variable: Variable, values: ctypes.Array[ctypes.c_char_p]) -> None: ...

    # --- life cycle -------------------------------------------------------------------------------------------------
    @abstractmethod
    def _end(self, *, running: bool) -> None:
        """Terminate if running, then free the instance."""

    def terminate(self) -> None:
        if self._usable:
            self._usable = False
            with contextlib.suppress(FMICallException):  # it ends either way
                self._end(running=self._initialised and not self._failed)

    # --- Model Exchange ---------------------------------------------------------------------------------------------
    def _resize(self, n_states: int) -> None:
        self.n_states = n_states
        self._vector = np.zeros(n_states)
        self._vector_pointer = self._vector.ctypes.data_as(ctypes.POINTER(ctypes.c_double))

    def _get_vector(self, function: str) -> Floats:
        if self.n_states:
            self._call(function, self._vector_pointer, self.n_states)
        return self._vector.copy()

    def _set_vector(self, function: str, values: Floats) -> None:
        if self.n_states:
            self._vector[:] = values
            self._call(function, self._vector_pointer, self.n_states)

    def update_discrete_states(self) -> float | None:
        for _ in range(DISCRETE_STATE_ITERATIONS):
            again, stop, _, _, defined, time = self._update_once()
            if stop:
                raise self.stop_requested()
            if not again:
                return time if defined else None
        raise self.unsettled()

    def _update_once(self) -> tuple[bool, bool, bool, bool, bool, float]:
        """Need another update, terminate, nominals changed, states changed, next time event defined, its time."""
        self.require_usable()
        try:
            return self._update_discrete_states()
        except FMICallException as error:
            raise self.failure(error.function, error.status) from None

    @abstractmethod
    def _update_discrete_states(self) -> tuple[bool, bool, bool, bool, bool, float]: ...

    def completed_step(self) -> bool:
        self.require_usable()
        try:
            wants_event, stop = self._fmu.completedIntegratorStep()
        except FMICallException as error:
            raise self.failure(error.function, error.status) from None
        if stop:
            raise self.stop_requested()
        return bool(wants_event)


class Fmi2Component(FmuComponent):
    """FMI 2.0."""

    def __init__(self, name: str, file: _File, interface: Interface, description: Description) -> None:
        super().__init__(name, file, interface, description)
        self._resize(file.model.numberOfContinuousStates if interface is Interface.MODEL_EXCHANGE else 0)

    def _instantiate(self) -> None:
        self._fmu.instantiate(callbacks=_fmi2_callbacks(self.log))

    def _set_strings(self, variable: Variable, values: ctypes.Array[ctypes.c_char_p]) -> None:
        references = (ctypes.c_uint * len(variable.references))(*variable.references)
        self._call("fmi2SetString", references, len(references), values)

    def enter_initialization(self, start_time: float, stop_time: float) -> None:
        self._call("fmi2SetupExperiment", 0, 0.0, start_time, 1, stop_time)
        self._call("fmi2EnterInitializationMode")

    def exit_initialization(self) -> None:
        self._call("fmi2ExitInitializationMode")
        self._initialised = True

    def _end(self, *, running: bool) -> None:
        try:
            if running:
                self._fmu.fmi2Terminate(self._instance)
        finally:
            self._fmu.fmi2FreeInstance(self._instance)

    def step(self, time: float, step: float) -> None:
        self._call("fmi2DoStep", time, step, 1)

    def failure(self, function: str, status: int) -> ComponentError:
        error = super().failure(function, status)
        if function != "fmi2DoStep" or status != DISCARD:
            return error
        try:
            reached = self._fmu.getRealStatus(fmi2LastSuccessfulTime)
        except FMICallException:
            return error
        return ComponentError(self.name, f"{error.message}: it only got to t = {reached:.9g} s", error.log)

    def set_time(self, time: float) -> None:
        self._call("fmi2SetTime", time)

    def get_states(self) -> Floats:
        return self._get_vector("fmi2GetContinuousStates")

    def set_states(self, states: Floats) -> None:
        self._set_vector("fmi2SetContinuousStates", states)

    def derivatives(self) -> Floats:
        return self._get_vector("fmi2GetDerivatives")

    def enter_event_mode(self) -> None:
        self._call("fmi2EnterEventMode")

    def _update_discrete_states(self) -> tuple[bool, bool, bool, bool, bool, float]:
        result: tuple[bool, bool, bool, bool, bool, float] = self._fmu.newDiscreteStates()
        return result

    def enter_continuous_time_mode(self) -> None:
        self._call("fmi2EnterContinuousTimeMode")


class Fmi3Component(FmuComponent):
    """FMI 3.0; structural parameters are set in Configuration Mode."""

    def __init__(self, name: str, file: _File, interface: Interface, description: Description) -> None:
        super().__init__(name, file, interface, description)
        self._file = file
        self._structural: dict[str, int] = {}
        self._count_states()

    def _count_states(self) -> None:
        derivatives = self._file.model.derivatives if self.interface is Interface.MODEL_EXCHANGE else ()
        shapes = (fmi3_shape(derivative.variable, self._structural) for derivative in derivatives)
        self._resize(sum(int(np.prod(shape, dtype=np.int64)) for shape in shapes))

    def _instantiate(self) -> None:
        log = self.log
        self._fmu.instantiate(logMessage=lambda _environment, status, _category, text: log.add(status, text))

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

    def enter_initialization(self, start_time: float, stop_time: float) -> None:
        self._call("fmi3EnterInitializationMode", False, 0.0, start_time, True, stop_time)

    def exit_initialization(self) -> None:
        self._call("fmi3ExitInitializationMode")
        self._initialised = True

    def _end(self, *, running: bool) -> None:
        try:
            if running:
                self._fmu.fmi3Terminate(self._instance)
        finally:
            self._fmu.fmi3FreeInstance(self._instance)

    def step(self, time: float, step: float) -> None:
        self.require_usable()
        try:
            _, stop, early, reached = self._fmu.doStep(time, step)
        except FMICallException as error:
            raise self.failure("fmi3DoStep", error.status) from None
        if stop:
            raise self.stop_requested()
        if early:
            raise self.early_return(reached)

    def set_time(self, time: float) -> None:
        self._call("fmi3SetTime", time)

    def get_states(self) -> Floats:
        return self._get_vector("fmi3GetContinuousStates")

    def set_states(self, states: Floats) -> None:
        self._set_vector("fmi3SetContinuousStates", states)

    def derivatives(self) -> Floats:
        return self._get_vector("fmi3GetContinuousStateDerivatives")

    def enter_event_mode(self) -> None:
        self._call("fmi3EnterEventMode")

    def _update_discrete_states(self) -> tuple[bool, bool, bool, bool, bool, float]:
        result: tuple[bool, bool, bool, bool, bool, float] = self._fmu.updateDiscreteStates()
        return result

    def enter_continuous_time_mode(self) -> None:
        self._call("fmi3EnterContinuousTimeMode")


def open_fmu(name: str, path: Path, interface: Interface, description: Description) -> FmuComponent:
    """A new instance.

    Args:
        name: of the component, for messages.
        path: of the file.
        interface: Model Exchange or Co-Simulation.
        description: from `describe`, with the arrays sized as they will be used.

    Raises:
        ConfigError: the file cannot be used; see `describe`.
        ComponentError: the file is another one than was described, its library cannot be loaded, or it refuses.
    """
    file = _read(Path(path))
    if description.sha256 != file.archive.sha256:
        raise ComponentError(name, f"{path} is not the file that the scenario was checked with (its SHA-256 differs)")
    if interface not in file.implementations:
        raise ComponentError(name, f"{path} does not offer {interface}")
    return (Fmi2Component if file.fmi == 2 else Fmi3Component)(name, file, interface, description)
