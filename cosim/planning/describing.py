"""What the components of an agent say of themselves, once the number of in-neighbours is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cosim.components.component import Description
from cosim.errors import ConfigError, Location, suggest
from cosim.planning.problems import Problems
from cosim.scenario.reading import Scenario
from cosim.scenario.spec import ComponentSpec


@dataclass(frozen=True)
class Origin:
    """Where a component comes from: an FMU file or a Python class (`package.module:Class`)."""

    path: Path | None
    python: str | None


class Describer:
    """Opens descriptions, each once.

    Args:
        scenario: whose components they are.
        problems: takes what is wrong.
        located: where FMUs are to be found, by what the scenario calls them; others are where it says.
    """

    def __init__(self, scenario: Scenario, problems: Problems, located: Mapping[str, Path] | None = None) -> None:
        self._scenario = scenario
        self._located = located or {}
        self.problems = problems
        self._known: dict[tuple[Origin, tuple[tuple[str, int], ...]], Description | str] = {}

    def origin(self, name: str, spec: ComponentSpec, where: Location, fmu_at: Location) -> Origin | None:
        """Where a component comes from; None, and a problem, if it does not say or there is no such FMU."""
        if spec.python is not None:
            return Origin(None, spec.python)
        if spec.fmu is None:
            self.problems.error(f"component {name!r} has neither 'fmu' nor 'python'", where)
            return None
        if spec.fmu in self._located:
            return Origin(self._located[spec.fmu], None)
        if is_file(spec.fmu):
            return self._file(spec.fmu, fmu_at)
        import fmus

        if spec.fmu not in fmus.names():
            hint = suggest(spec.fmu, fmus.names()) or "; run `python -m fmus.build` to build them"
            if (self._scenario.folder(fmu_at) / spec.fmu).exists():
                hint = f"; to mean what is beside the scenario, write './{spec.fmu}'"
            self.problems.error(f"no shipped FMU is called {spec.fmu!r}{hint}; a file ends in .fmu", fmu_at)
            return None
        return Origin(fmus.path(spec.fmu), None)

    def _file(self, written: str, where: Location) -> Origin | None:
        path = self._scenario.folder(where) / written
        if path.is_file():
            return Origin(path.resolve(), None)
        if reason := no_file(path):
            self.problems.error(f"{written!r} {reason}", where)
        else:
            beside = suggest(path.name, files_beside(path))
            self.problems.error(f"no FMU file {written!r}{beside}; looked for {path.resolve()}", where)
        return None

    def describe(self, origin: Origin, structural: Mapping[str, int], where: Location) -> Description | None:
        """The description for given structural parameters; None, and a problem at `where`, if it cannot be had."""
        key = (origin, tuple(sorted(structural.items())))
        if key not in self._known:
            self._known[key] = self._open(origin, structural)
        found = self._known[key]
        if isinstance(found, str):
            self.problems.error(found, where)
            return None
        return found

    def _open(self, origin: Origin, structural: Mapping[str, int]) -> Description | str:
        from cosim.components import opening

        try:
            return opening.describe(origin.path, origin.python, structural)
        except ConfigError as error:
            return "; ".join(problem.message for problem in error.problems)


def no_file(path: Path) -> str:
    """Why there is something of that name which is no file, as a predicate; empty if there is nothing."""
    if path.is_dir():
        unpacked = (path / "modelDescription.xml").is_file()
        zipped = f"; zip what is in it: cd '{path}' && zip -r ../{path.stem}-packed.fmu ."
        return f"is the folder of an unpacked FMU{zipped}" if unpacked else "is a folder, not an FMU file"
    if path.is_symlink():
        return f"is a link to {path.readlink()}, which does not exist"
    return "is neither a file nor a folder" if path.exists() else ""


def files_beside(path: Path) -> list[str]:
    """The FMU files in the folder of a file that is not there."""
    return sorted(other.name for other in path.parent.glob("*.fmu") if other.is_file())


def is_file(fmu: str) -> bool:
    """Whether `fmu:` names a file, not a shipped FMU."""
    return fmu.endswith(".fmu") or "/" in fmu or "\\" in fmu
