"""Files that a profile names: relative to the file in which they are named, read once to find mistakes early."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, ValidationInfo


def _find(text: str, info: ValidationInfo) -> str:
    """The absolute path; the context of the validation may say in which `folder` to look."""
    folder = Path((info.context or {}).get("folder", ""))
    path = folder / text
    if path.is_file():
        return str(path.resolve())
    near = difflib.get_close_matches(path.name, _names(path.parent), n=1)
    raise ValueError(f"no such file: {path}" + (f" (did you mean {near[0]!r}?)" if near else ""))


def _names(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()] if folder.is_dir() else []


def file_read_by(read: Callable[[Path], object]) -> Any:
    """The type of a field that names a file which `read` must be able to read, or raise ValueError."""

    def check(path: str) -> str:
        read(Path(path))
        return path

    return Annotated[str, AfterValidator(_find), AfterValidator(check)]
