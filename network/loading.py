"""Classes of the user's own, by their dotted path: channel models and components alike.

Modules are imported as Python does it, once, and from the current folder as well. But a process may live longer than
the text of a module, as a notebook's does:

- What is told of a class is the hash of the text that it was compiled from, not of the file as it is later.
- Once a file has changed, or the current folder has, all that was imported through here is imported anew: all of it, so
  that no module sees what another one was before. A module that the process has imported by itself cannot be replaced
  behind its back; where its file says something else by now, it is refused.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import inspect
import os
import pkgutil
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Generic, TypeVar

_Base = TypeVar("_Base")
_AGE_NS = 100_000_000
"""A file that is not older may change once more without a later time."""


@dataclass(frozen=True)
class Loaded(Generic[_Base]):
    """A class.

    Attributes:
        cls: it.
        file: where it is defined; empty if in no file.
        sha256: of the text that it was compiled from; empty if there is none.
    """

    cls: type[_Base]
    file: str
    sha256: str


def load(dotted: str, base: type[_Base]) -> Loaded[_Base]:
    """The class at `package.module:Class`, looked for on Python's path, then in the current folder.

    Args:
        dotted: where it is.
        base: what it must be derived from.

    Raises:
        ValueError: there is none, its module cannot be imported, is not what its file says, or it is derived from
            something else.
    """
    module_name, colon, name = dotted.partition(":")
    if not (module_name and colon and name):
        raise ValueError(f"{dotted!r} names no Python class; write package.module:Class")
    with _lock:
        _look_here()
        module = _imported(module_name, base)
        found = getattr(module, name, None)
        if isinstance(found, type) and issubclass(found, base):
            source = _source_of(found)
            return Loaded(found, source.file, source.sha256)
    if found is not None:
        raise ValueError(f"{dotted} is no {base.__name__}: derive it from {base.__module__}.{base.__qualname__}")
    known = [key for key, value in vars(module).items() if isinstance(value, type) and issubclass(value, base)]
    raise ValueError(
        f"module {module_name} has no class {name!r}{_near(name, [k for k in known if k != base.__name__])}"
    )


def told(error: BaseException, *framework: str) -> str:
    """One line: what the user's code raised, and its place there.

    Args:
        error: that was raised.
        framework: files whose lines are not the user's.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "importlib" not in f.filename and f.filename not in {__file__, *framework}]
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    return f"{type(error).__name__}: {error}{place}"


# --- what was imported ------------------------------------------------------------------------------------------------


@dataclass
class _Source:
    """A module's text, when it was compiled."""

    file: str
    sha256: str
    stamp: tuple[int, int] | None

    @classmethod
    def of(cls, file: str, text: bytes | None = None) -> _Source:
        """The text that is in a file, or that was read from it just now."""
        stamp = _stamp(file)
        return cls(file, hashlib.sha256(Path(file).read_bytes() if text is None else text).hexdigest(), stamp)

    def has_changed(self) -> bool:
        """Whether the file is another one. One that is gone is none."""
        try:
            if self.stamp is not None and self.stamp == _stamp(self.file):
                return False
            now = _Source.of(self.file)
        except OSError:
            return False
        self.stamp = now.stamp
        return now.sha256 != self.sha256


def _stamp(file: str) -> tuple[int, int] | None:
    """What tells that a file has not changed, without reading it; None where it may change and keep that."""
    found = Path(file).stat()
    return (found.st_mtime_ns, found.st_size) if time.time_ns() - found.st_mtime_ns > _AGE_NS else None


_lock = threading.RLock()
_sources: dict[str, _Source] = {}
"""By module, what was imported through here."""
_others: dict[str, tuple[Any, _Source]] = {}
"""By module, what the process has imported by itself: its `__spec__`, new if it is reloaded, and its file when seen."""
_here: str | None = None
"""The current folder, if its entry in Python's path is from here: it stays, as modules may import others later."""


def _look_here() -> None:
    """Have the current folder on Python's path, and forget what is not any more what would be imported."""
    global _here  # noqa: PLW0603 - as `sys.path` is
    folder = str(Path.cwd())
    left = _here if _here != folder else None
    if left is not None:
        if left in sys.path:
            sys.path.remove(left)
        _here = None
    if folder not in sys.path:
        sys.path.append(folder)
        _here = folder
    gone = left is not None and any(source.file.startswith(left + os.sep) for source in _sources.values())
    if gone or any(source.has_changed() for source in _sources.values()):
        for name in _sources:
            sys.modules.pop(name, None)
        _sources.clear()


def _imported(name: str, base: type) -> ModuleType:
    """A module.

    Raises:
        ValueError: it cannot be imported, or is another one than would be.
    """
    framework = {__name__.partition(".")[0], base.__module__.partition(".")[0]}
    top = name.partition(".")[0]
    if name in sys.modules:
        if name not in _sources and top not in framework:
            _check_place(top)
        return sys.modules[name]
    try:
        with _recording(framework):
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if missing != name and not name.startswith(f"{missing}."):
            raise ValueError(f"{name} cannot be imported: {told(error)}") from error
        raise ValueError(f"there is no Python module {missing!r}{_near(missing, _siblings(missing))}") from None
    except (Exception, SystemExit) as error:
        raise ValueError(f"{name} cannot be imported: {told(error)}") from error


def _check_place(name: str) -> None:
    """Whether a module that is there would be imported from where it is from."""
    there, here = getattr(sys.modules.get(name), "__file__", None), PathFinder.find_spec(name)
    if there and here and here.origin and os.path.realpath(there) != os.path.realpath(here.origin):
        raise ValueError(
            f"the Python module {name!r} is here {here.origin}, but this process has {there}; start it anew"
        )


def _source_of(cls: type) -> _Source:
    """The text of a class.

    Raises:
        ValueError: its file has changed, and it is not for this module to import it anew.
    """
    name = cls.__module__
    if name in _sources:
        return _sources[name]
    try:
        file = inspect.getsourcefile(cls)
    except TypeError:  # one that was typed in
        file = None
    if not file:
        return _Source("", "", None)
    spec = getattr(sys.modules.get(name), "__spec__", None)
    if name not in _others or _others[name][0] is not spec:
        _others[name] = spec, _Source.of(file)
    _, source = _others[name]
    if source.has_changed():
        raise ValueError(f"{file} has changed since this process imported it; start the process anew")
    return source


# --- importing --------------------------------------------------------------------------------------------------------


@contextmanager
def _recording(framework: set[str]) -> Iterator[None]:
    importlib.invalidate_caches()
    finder = _Finder(framework)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Finder:
    """Finds modules as Python does, has those that are not installed read here, and leaves all others to it."""

    _INSTALLED = tuple(f"{sysconfig.get_path(name)}{os.sep}" for name in ("stdlib", "platstdlib", "purelib", "platlib"))

    def __init__(self, framework: set[str]) -> None:
        self._framework = framework
        self._thread = threading.get_ident()

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> Any:
        """`importlib.abc.MetaPathFinder.find_spec`."""
        if threading.get_ident() != self._thread or name.partition(".")[0] in self._framework:
            return None
        spec: ModuleSpec | None = PathFinder.find_spec(name, path, target)
        if spec is None or type(spec.loader) is not SourceFileLoader or not spec.origin:
            return None
        if spec.origin.startswith(self._INSTALLED):
            return None
        spec.loader = _Reader(name, spec.origin)
        return spec


class _Reader(SourceFileLoader):
    """Remembers what it compiles, and compiles always: Python does not tell texts of one second and length apart."""

    def get_code(self, fullname: str) -> CodeType | None:
        text = self.get_data(self.path)
        _sources[fullname] = _Source.of(self.path, text)
        code: CodeType = self.source_to_code(text, self.path)
        return code


# --- suggestions ------------------------------------------------------------------------------------------------------


def _near(wrong: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(wrong, known, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _siblings(name: str) -> list[str]:
    """The modules that lie where one was looked for."""
    package = name.rpartition(".")[0]
    path = getattr(sys.modules[package], "__path__", []) if package else sys.path
    prefix = f"{package}." if package else ""
    return [prefix + module.name for module in pkgutil.iter_modules(path)]
