"""What FMPy's validation says of a file."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

from cosim.components.fmu import model_xml
from cosim.components.fmu.library.files import by_itself, read
from cosim.components.fmu.library.imported import (
    ValidationError,
    read_model_description,
)


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
        read_model_description(by_itself(model_xml.serialised(root)), validate=True, validate_model_structure=True)
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
