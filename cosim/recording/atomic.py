"""Files that are replaced as a whole."""

from __future__ import annotations

import contextlib
import os
import uuid
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace a file: a reader sees the old content or the new one, whoever else writes it.

    Raises:
        OSError: it cannot be written; the old file is untouched.
    """
    new = path.with_name(f".{path.name}.{uuid.uuid4().hex}.new")
    try:
        new.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(new, path)  # noqa: PTH105 - Path.replace gives no better error
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        with contextlib.suppress(OSError):
            new.unlink()
        raise


def remove_left(path: Path) -> None:
    """Remove what a process left that was killed as it wrote a file."""
    for left in path.parent.glob(f".{path.name}.*.new"):
        left.unlink(missing_ok=True)
