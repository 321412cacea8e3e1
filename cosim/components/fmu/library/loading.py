"""Libraries: unpacked and loaded once, whatever the number of instances."""

from __future__ import annotations

import atexit
import contextlib
import copy
import ctypes
import functools
import os
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.components.component import Interface
from cosim.components.fmu.archive import refuse, unpack
from cosim.components.fmu.binary import complete
from cosim.components.fmu.library.files import File, lock
from cosim.components.fmu.library.imported import (
    FMU2Model,
    FMU2Slave,
    FMU3Model,
    FMU3Slave,
)
from cosim.native_loading import load


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
    with lock:
        if file.implementations[interface].canBeInstantiatedOnlyOncePerProcess:
            return _load(file, interface)
        return copy.copy(_cached_load(file, interface))
