"""The shipped FMUs, plants and controllers, each for FMI 2.0 and 3.0.

`python -m fmus.build` builds them from the sources beside this file; see `fmus/README.md` for adding a model.
"""

from __future__ import annotations

from pathlib import Path

_BUILT = Path(__file__).resolve().parent / "built"


def names() -> list[str]:
    """Names that `path` knows, sorted: `Model` (its FMI 3.0 file), `Model.fmi2` and `Model.fmi3`."""
    files = [file.stem for file in _BUILT.glob("*.fmi[23].fmu")]
    return sorted({*files, *(name.removesuffix(".fmi3") for name in files if name.endswith(".fmi3"))})


def path(name: str) -> Path:
    """The FMU file of a shipped model: `TwoLinkArm` means `TwoLinkArm.fmi3`.

    Raises:
        KeyError: no shipped FMU has that name; the message lists those that there are.
    """
    if name not in names():
        known = ", ".join(names()) or "none: run `python -m fmus.build`"
        raise KeyError(f"no shipped FMU is called {name!r} (known: {known})")
    return _BUILT / f"{name if name.endswith(('.fmi2', '.fmi3')) else f'{name}.fmi3'}.fmu"
