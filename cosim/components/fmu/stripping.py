"""An FMU without what is its owner's secret: what it says of itself, and the SHA-256 of the whole file."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

from cosim.components.fmu.archive import ORIGINAL, refuse
from cosim.components.fmu.library import read

_DATE = (1980, 1, 1, 0, 0, 0)  # the same file always gives the same bytes


def strip(path: Path) -> bytes:
    """An FMU file that holds only the model description; planning with it is planning with the original.

    Args:
        path: of the FMU; one that is stripped already comes out the same.

    Raises:
        ConfigError: it cannot be read, or is no FMU.
    """
    archive = read(path).archive
    origin = {"sha256": archive.sha256, "name": archive.original_name, "platforms": list(archive.platforms)}
    stripped = io.BytesIO()
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(stripped, "w", zipfile.ZIP_DEFLATED) as target:
        for name, content in (
            ("modelDescription.xml", source.read("modelDescription.xml")),
            (ORIGINAL, json.dumps(origin, indent=2).encode()),
        ):
            target.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
    return stripped.getvalue()


def write_stripped(path: Path, out: Path | None) -> Path:
    """Strip an FMU into a new file, by default `<name>.description.fmu` in the current folder.

    Raises:
        ConfigError: the file is no FMU, is stripped already, or the new one cannot be written.
    """
    archive = read(path).archive
    if not archive.whole:
        raise refuse(path, "holds only the description already")
    out = out or Path(f"{path.stem}.description.fmu")
    content = strip(path)
    try:
        with out.open("xb") as file:
            file.write(content)
    except FileExistsError:
        raise refuse(out, "exists already; choose another name with -o or remove it") from None
    except OSError as error:
        raise refuse(out, f"cannot be written: {error.strerror}") from error
    return out
