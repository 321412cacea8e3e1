"""Files: what an FMU says of itself, read once."""

from __future__ import annotations

import copy
import functools
import io
import itertools
import os
import threading
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.components.component import Interface
from cosim.components.fmu import model_xml
from cosim.components.fmu.archive import Archive, inspect, refuse
from cosim.components.fmu.binary import HEAD_BYTES, unfit
from cosim.components.fmu.library.imported import (
    FOLDERS,
    LIBRARY_SUFFIX,
    ValidationError,
    read_model_description,
)

_MOST_MISTAKES = 3
"""How much is said of a description that cannot be read."""

lock = threading.RLock()


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
    with lock:
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
    file = by_itself(model_xml.serialised(changed) if model_xml.make_readable(changed) else xml)
    try:
        model = read_model_description(file, validate=False)
    except Exception as error:  # FMPy raises whatever the first missing attribute leads to
        said = "; ".join(itertools.islice(model_xml.mistakes(root), _MOST_MISTAKES))
        reason = said or _first_problem(file) or f"{type(error).__name__}: {error}"
        raise refuse(path, f"has a broken modelDescription.xml: {reason}") from error
    model_xml.complete(model, root)
    return model


def by_itself(xml: bytes) -> io.BytesIO:
    """An archive of the description only: FMPy reads nothing else, and would leave a file open when it fails."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
    return file


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
