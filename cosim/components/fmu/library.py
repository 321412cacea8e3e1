"""FMPy: reading model descriptions, loading libraries, the log. The only file that imports FMPy.

A file is read and unpacked once per process, its library loaded once; every instance then costs little more than its
own instantiation.
"""

from __future__ import annotations

import atexit
import contextlib
import copy
import ctypes
import functools
import io
import itertools
import math
import os
import re
import threading
import weakref
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.components.component import Interface
from cosim.components.fmu import model_xml
from cosim.components.fmu.archive import Archive, inspect, refuse, unpack
from cosim.components.fmu.binary import HEAD_BYTES, complete, unfit
from cosim.errors import ComponentError
from cosim.logs import Sink, discard
from cosim.native_loading import load

with contextlib.redirect_stdout(io.StringIO()):  # where FMPy has no logger for the platform, it prints so
    import fmpy
    from fmpy.fmi1 import FMICallException
    from fmpy.fmi2 import (
        FMU2Model,
        FMU2Slave,
        defaultCallbacks,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
        fmi2DoStepStatus,
        fmi2LastSuccessfulTime,
        fmi2Terminated,
    )
    from fmpy.fmi3 import FMU3Model, FMU3Slave
    from fmpy.model_description import ValidationError, read_model_description

__all__ = [
    "DO_STEP_STATUS",
    "FOLDERS",
    "LAST_SUCCESSFUL_TIME",
    "LIBRARY_SUFFIX",
    "LOG_LINES",
    "PLATFORM",
    "TERMINATED",
    "FMICallException",
    "File",
    "Log",
    "cvode_solver",
    "findings",
    "fmi2_callbacks",
    "open_library",
    "read",
    "runs_in_python",
    "status_name",
]

PLATFORM: str = fmpy.platform_tuple
FOLDERS: Mapping[int, tuple[str, ...]] = {
    2: (fmpy.platform, fmpy.platform_tuple),
    3: (fmpy.platform_tuple,),
}
"""What this platform is called under `binaries/`: `linux64` in FMI 2.0, `x86_64-linux` in 3.0 and by some in 2.0."""
LIBRARY_SUFFIX: str = fmpy.sharedLibraryExtension
LAST_SUCCESSFUL_TIME: int = fmi2LastSuccessfulTime
DO_STEP_STATUS: int = fmi2DoStepStatus
TERMINATED: int = fmi2Terminated

LOG_LINES = 100
"""How many of the latest lines that an instance logged are kept."""

_LINE_BYTES = 10_000
"""How much of each."""

_MOST_MISTAKES = 3
"""How much is said of a description that cannot be read."""

STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")

_lock = threading.RLock()


# --- files ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class File:
    """An FMU file that has been read; compared by identity.

    Attributes:
        model: FMPy's `ModelDescription`.
        implementations: what the file says of each interface that can be used here.
        library_folder: name of the folder under `binaries/` for this platform, or None.
        libraries: name of the library in it, by the model identifier of an interface.
        buffers: memory for the values of its variables, shared by its instances: one is called at a time.
    """

    archive: Archive
    model: Any
    implementations: Mapping[Interface, Any]
    library_folder: str | None
    libraries: Mapping[str, str]
    buffers: dict[tuple[Any, ...], Any] = field(default_factory=dict)

    @property
    def fmi(self) -> int:
        """Major version of the standard."""
        return int(self.model.fmiMajorVersion)


def read(path: Path) -> File:
    """The file, read again only if it changed."""
    try:
        status = path.stat()
    except OSError:
        inspect(path)  # says what is wrong
        raise
    with _lock:
        return _read_version(os.path.abspath(path), status.st_mtime_ns, status.st_size)  # noqa: PTH100 - it is faster


@functools.lru_cache(maxsize=256)
def _read_version(name: str, _mtime_ns: int, _size: int) -> File:
    path = Path(name)
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
        if implementation.needsExecutionTool and not runs_in_python(model):
            needing_tool.append(interface)
        else:
            implementations[interface] = implementation
    if needing_tool and not implementations:
        tool = model.generationTool or "the tool that made it"
        raise refuse(path, f"only works together with {tool} (needsExecutionTool); export it without that need")
    if not implementations:
        raise refuse(path, "offers neither Model Exchange nor Co-Simulation")
    folder, libraries = _libraries(archive, model, implementations)
    if folder is not None and archive.whole:
        for library in set(libraries.values()):
            _check_library(path, f"binaries/{folder}/{library}")
    return File(archive, model, implementations, folder, libraries)


def runs_in_python(model: Any) -> bool:
    """Whether the tool that the FMU needs is Python, which is here: PythonFMU declares it so."""
    return str(model.generationTool or "").startswith("PythonFMU")


def _check_library(path: Path, name: str) -> None:
    try:
        with zipfile.ZipFile(path) as archive, archive.open(name) as member:
            reason = unfit(member.read(HEAD_BYTES), archive.getinfo(name).file_size)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise refuse(path, f"cannot be unpacked: {error}") from error
    if reason:
        raise refuse(path, f"cannot be loaded: {name} {reason}")


def _read_model(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as archive:
            xml = archive.read("modelDescription.xml")
        root = model_xml.parse(xml)
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise refuse(path, f"has a broken modelDescription.xml: {error}") from error
    version = root.get("fmiVersion")
    if root.tag != "fmiModelDescription" or version is None:
        raise refuse(path, "has a broken modelDescription.xml: it does not say which version of FMI it follows")
    if version != "2.0" and not version.startswith("3."):
        raise refuse(path, f"is an FMU of FMI {version}; export it for FMI 2.0 or 3.0")
    changed = copy.deepcopy(root)
    alone = _alone(model_xml.serialised(changed) if model_xml.make_readable(changed) else xml)
    try:
        model = read_model_description(alone, validate=False)
    except Exception as error:  # FMPy raises whatever the first missing attribute leads to
        said = "; ".join(itertools.islice(model_xml.mistakes(root), _MOST_MISTAKES))
        reason = said or _first_problem(alone) or f"{type(error).__name__}: {error}"
        raise refuse(path, f"has a broken modelDescription.xml: {reason}") from error
    model_xml.complete(model, root)
    return model


def _alone(xml: bytes) -> io.BytesIO:
    """An archive of the description only: FMPy reads nothing else, and would leave a file open when it fails."""
    alone = io.BytesIO()
    with zipfile.ZipFile(alone, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
    return alone


def _first_problem(file: io.BytesIO) -> str:
    """What the schema has to say about a description that FMPy cannot read; empty if that is nothing."""
    try:
        read_model_description(file, validate=True)
    except ValidationError as invalid:
        return str(invalid.problems[0])
    except Exception:  # the same as before
        return ""
    return ""


def _libraries(
    archive: Archive, model: Any, implementations: Mapping[Interface, Any]
) -> tuple[str | None, Mapping[str, str]]:
    """The folder for this platform, and the library in it by model identifier; None where there is none.

    FMUs that somebody renamed may hold a library of another name than their model identifier; if it is the only one,
    it is meant.
    """
    folders = FOLDERS[int(model.fmiMajorVersion)]
    proper = {x.modelIdentifier: x.modelIdentifier + LIBRARY_SUFFIX for x in implementations.values()}
    names = set(archive.names)
    for folder in folders:
        if all(f"binaries/{folder}/{library}" in names for library in proper.values()):
            return folder, proper
    for folder in folders:
        paths = [PurePosixPath(name) for name in archive.names if name.startswith(f"binaries/{folder}/")]
        found = [path.name for path in paths if path.suffix == LIBRARY_SUFFIX and len(path.parts) == 3]
        if len(found) == 1 and len(proper) == 1:
            return folder, dict.fromkeys(proper, found[0])
    return None, proper


def findings(path: Path) -> list[str]:
    """What FMPy's validation says of a file: schema, model structure, start values, units; what is alike, once."""
    alike: dict[str, list[str]] = {}
    for problem in _validated(path):
        text = _LISTED.sub(_shortened, " ".join(str(problem).split()))
        place = _PLACE.match(text)
        alike.setdefault(text[place.end() :] if place else text, []).append(place["line"] if place else "")
    return [f"{_places(lines)}{text}" for text, lines in alike.items()]


def _validated(path: Path) -> list[str]:
    """FMPy's validation, but for the names of variables, which takes it milliseconds each."""
    found: list[str] = []
    try:
        read_model_description(str(path), validate=True, validate_model_structure=True)
    except ValidationError as invalid:
        found += map(str, invalid.problems)
    except Exception:  # FMPy raises whatever the first thing that it does not know leads to
        found += _validated_again(path)
    model = read(path).model
    convention = model.variableNamingConvention or "flat"
    allowed = _STRUCTURED if convention == "structured" else _FLAT
    odd = [v for v in model.modelVariables if not allowed.fullmatch(v.name)]
    return found + [f'"{v.name}" (line {v.sourceline}) is not named by the convention "{convention}"' for v in odd]


def _validated_again(path: Path) -> list[str]:
    """The same for a description that FMPy can only read when it is changed."""
    with zipfile.ZipFile(path) as archive:
        root = model_xml.parse(archive.read("modelDescription.xml"))
    found = model_xml.without_odd_display_units(root)
    model_xml.make_readable(root)
    try:
        read_model_description(_alone(model_xml.serialised(root)), validate=True, validate_model_structure=True)
    except ValidationError as invalid:
        found += map(str, invalid.problems)
    except Exception as error:
        found.append(f"FMPy's validation does not get through it ({type(error).__name__}: {error})")
    return found


_WORD = r"(?:[A-Za-z_]\w*|'(?:[ -&(-\[\]-~]|\\.)+')(?:\[\d+(?:,\d+)*\])?"
_STRUCTURED = re.compile(rf"(?a:{_WORD}(?:\.{_WORD})*|der\({_WORD}(?:\.{_WORD})*(?:,\d+)?\))")
"""FMI 2.0.5, section 2.2.9; FMI 3.0, section 2.4.7.5.1."""

_FLAT = re.compile(r"[^\r\n\t]+")

_PLACE = re.compile(r"ERROR \(line (?P<line>\d+), column \d+\): ")
_LISTED = re.compile(r"\{[^{}]*\}")


def _shortened(listed: re.Match[str]) -> str:
    """A set of names, of which there may be thousands."""
    names = listed[0][1:-1].split(", ")
    return listed[0] if len(names) <= 6 else f"{{{', '.join(names[:5])} and {len(names) - 5} more}}"


def _places(lines: list[str]) -> str:
    """Where the same is said, as far as it has a place."""
    if not lines[0]:
        return ""
    if len(lines) == 1:
        return f"line {lines[0]}: "
    shown = ", ".join(lines[:3])
    return f"lines {shown}{f' and {len(lines) - 3} more' if lines[3:] else ''}: "


# --- libraries ------------------------------------------------------------------------------------------------------
@functools.cache
def _unpacked(file: File) -> Path:
    """The binaries for this platform and the resources; documentation and sources stay packed."""

    def wanted(name: str) -> bool:
        parts = PurePosixPath(name).parts
        return parts[:1] == ("resources",) or parts[:2] == ("binaries", file.library_folder)

    return unpack(file.archive, wanted)


def _load(file: File, interface: Interface) -> Any:
    """FMPy's object around a freshly loaded library."""
    once = file.implementations[interface].canBeInstantiatedOnlyOncePerProcess
    folder = _unpacked.__wrapped__(file) if once else _unpacked(file)  # a copy of its own for every such instance
    identifier = file.implementations[interface].modelIdentifier
    library = folder / "binaries" / str(file.library_folder) / file.libraries[identifier]
    arguments = {"guid": file.model.guid, "modelIdentifier": identifier, "unzipDirectory": str(folder)}
    if file.fmi == 2:
        arguments["libraryPath"] = str(library)
    else:  # FMPy goes by the identifier, and asks the library for no other name
        arguments["modelIdentifier"] = library.stem
    used = {v.type for v in file.model.modelVariables}
    types = frozenset(_STORED_AS[t][file.fmi - 2] if t in _STORED_AS else t for t in used)
    working_directory = Path.cwd()
    try:
        os.chdir(library.parent)  # as FMPy does
        load(library)
        fmu = _forgiving(_CLASSES[file.fmi, interface], types)(**arguments)
    except Exception as error:  # FMPy raises bare exceptions
        reason = str(error.__context__ or error).replace(f"{folder}{os.sep}", "")
        missing = "; it needs that library, which is not installed here" if _NOT_INSTALLED in reason else ""
        raise refuse(file.archive.path, f"cannot be loaded: {reason}{missing}") from error
    finally:
        os.chdir(working_directory)  # FMPy changes it, and does not come back if loading fails
    if os.name == "nt":  # a loaded library could not be removed
        atexit.register(fmu.freeLibrary)
    _release_early(fmu.dll)
    return fmu


def _release_early(library: ctypes.CDLL) -> None:
    """PythonFMU's libraries release what they share twice when a process ends, unless it is gone by then."""
    with contextlib.suppress(AttributeError):
        atexit.register(library.finalizePythonInterpreter)


def _forgiving(base: Any, types: frozenset[str]) -> Any:
    """FMPy's class, for libraries that lack functions which they can do without."""

    def load_functions(self: Any) -> None:
        prefix = "fmi2" if base.__name__.startswith("FMU2") else "fmi3"
        lacking = complete(self.dll, [name for name in dir(base) if name.startswith(prefix)], types)
        if lacking:
            others = f" and {len(lacking) - 1} more functions" if lacking[1:] else ""
            raise AttributeError(
                f"its library lacks {lacking[0]}{others}, which {prefix[:3].upper()} {prefix[3]}.0 asks for"
            )
        base._loadFunctions(self)

    return type(base.__name__, (base,), {"_loadFunctions": load_functions})


_CLASSES = {
    (2, Interface.MODEL_EXCHANGE): FMU2Model,
    (2, Interface.CO_SIMULATION): FMU2Slave,
    (3, Interface.MODEL_EXCHANGE): FMU3Model,
    (3, Interface.CO_SIMULATION): FMU3Slave,
}
_STORED_AS = {"Enumeration": ("Integer", "Int64")}
"""Types that have no functions of their own, in FMI 2.0 and 3.0."""

_NOT_INSTALLED = "cannot open shared object file: No such file"

_cached_load = functools.cache(_load)


def open_library(file: File, interface: Interface) -> Any:
    """FMPy's object, ready to be instantiated. Its constructor costs a millisecond, a copy of it next to nothing.

    Raises:
        ConfigError: the file cannot be unpacked, or its library cannot be loaded.
    """
    with _lock:
        if file.implementations[interface].canBeInstantiatedOnlyOncePerProcess:
            return _load(file, interface)
        return copy.copy(_cached_load(file, interface))


_SILENCE = {f"SUNLOGGER_{level}_FILENAME": os.devnull for level in ("ERROR", "WARNING")}


def cvode_solver(component: str, failed: Callable[[], bool], shortest: float, **arguments: Any) -> Any:
    """FMPy's `CVodeSolver`, whose library comes with it for the usual platforms; it prints nothing.

    Args:
        component: for messages.
        failed: whether a callback has failed, so that CVODE must end.
        shortest: step in seconds.
        arguments: of FMPy's class.

    Raises:
        ComponentError: there is none for this platform.
    """
    try:
        from fmpy import sundials
        from fmpy.sundials.libraries import sundials_core, sundials_cvode
    except Exception as error:  # a library that is missing shows in many ways
        raise ComponentError(component, f"FMPy has no CVODE for this platform: {error}") from error

    class Solver(sundials.CVodeSolver):  # type: ignore[misc]
        """The callbacks say what went wrong: negative for good, positive if a shorter step may do."""

        def f(self, t: float, y: Any, ydot: Any, user_data: Any) -> int:
            super().f(t, y, ydot, user_data)
            slopes = sundials.NV_DATA_S(ydot)
            return -1 if failed() else int(not all(math.isfinite(slopes[i]) for i in range(self.nx)))

        def g(self, t: float, y: Any, gout: Any, user_data: Any) -> int:
            super().g(t, y, gout, user_data)
            return -1 if failed() else 0

    before = {name: os.environ.get(name) for name in _SILENCE}
    os.environ.update(_SILENCE)  # SUNDIALS looks there when it is created
    try:
        solver = Solver(**arguments)
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    clear, set_min_step = sundials_core.SUNContext_ClearErrHandlers, sundials_cvode.CVodeSetMinStep
    clear.argtypes = [sundials.SUNContext]
    clear(solver.sunctx)  # among them one that prints
    sundials.SUNContext_PushErrHandler(solver.sunctx, solver.ehfun_, None)
    set_min_step.argtypes = [ctypes.c_void_p, ctypes.c_double]
    set_min_step(solver.cvode_mem, shortest)
    return solver


# --- logging --------------------------------------------------------------------------------------------------------
def status_name(status: int) -> str:
    """What the standard calls a status."""
    return STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)


class Log:
    """What one instance logs: the latest lines, and all of it for `sink`."""

    def __init__(self, sink: Sink = discard) -> None:
        self.lines: deque[str] = deque(maxlen=LOG_LINES)
        self._sink = sink

    @property
    def last(self) -> str | None:
        return self.lines[-1] if self.lines else None

    def add(self, status: int, message: bytes | None) -> None:
        """Called by the FMU, from native code: must not raise."""
        text = message or b""
        self._sink(b"[%b] %b\n" % (status_name(status).encode(), text.strip()))
        self.lines.append(f"[{status_name(status)}] {text[:_LINE_BYTES].decode(errors='replace').strip()}")


_logs: weakref.WeakValueDictionary[int, Log] = weakref.WeakValueDictionary()
_log_numbers = itertools.count(1)


def _receive_fmi2(environment: int | None, _name: bytes, status: int, _category: bytes, message: bytes) -> None:
    log = _logs.get(environment or 0)
    if log is not None:
        log.add(status, message)


_fmi2_logger = fmi2CallbackLoggerTYPE(_receive_fmi2)


def fmi2_callbacks(log: Log) -> Any:
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
