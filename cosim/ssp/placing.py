"""The files that an import writes, all of them or none: the FMUs of the package, and the scenario."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from cosim.components.fmu.archive import refuse
from cosim.errors import ConfigError, Problem


class Placement:
    """Writes files; whatever ends it with an exception, what is new is removed.

    Args:
        folder: for the FMUs; it is made when there is one.

    Attributes:
        fmus: the file of each member of the package that was placed.
    """

    def __init__(self, folder: Path) -> None:
        self.fmus: dict[str, Path] = {}
        self._folder = folder
        self._new: list[Path] = []

    def place(self, member: str, content: bytes) -> None:
        """Have a member of the package in the folder, under its name or one beside it.

        Raises:
            ConfigError: another file has the name, or it cannot be written.
        """
        stem, taken = Path(member).stem, [file.name for file in self.fmus.values()]
        name = next(n for i in range(len(taken) + 1) if (n := f"{stem}{f'-{i + 1}' if i else ''}.fmu") not in taken)
        file = self._folder / name
        with _told(file):
            is_there = file.exists()
            if is_there and not (file.is_file() and file.read_bytes() == content):
                raise ConfigError([Problem(f"{file} exists already and is another file; choose another name with -o")])
        if not is_there:
            self._make_folder()
            self.write(file, content)
        self.fmus[member] = file

    def write(self, file: Path, content: bytes) -> None:
        """Write a new file.

        Raises:
            ConfigError: there is one, or it cannot be written.
        """
        with _told(file):
            try:
                with file.open("xb") as stream:
                    self._new.append(file)
                    stream.write(content)
            except FileExistsError:
                text = f"{file} exists already; choose another name with -o or remove it"
                raise ConfigError([Problem(text)]) from None

    def _make_folder(self) -> None:
        missing = [path for path in (self._folder, *self._folder.parents) if not path.exists()]
        with _told(self._folder):
            for path in reversed(missing):
                path.mkdir()
                self._new.append(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        for path in reversed(self._new) if kind is not None else ():
            with suppress(OSError):
                path.rmdir() if path.is_dir() else path.unlink()


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise refuse(path, f"cannot be written: {error.strerror}") from error
