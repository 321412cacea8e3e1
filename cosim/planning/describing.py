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
            self.problems.error(f"no shipped FMU is called {spec.fmu!r}{hint}; a file ends in .fmu", fmu_at)
            return None
        return Origin(fmus.path(spec.fmu), None)

    def _file(self, written: str, where: Location) -> Origin | None:
        path = (self._scenario.folder(where) / written).resolve()
        if path.is_file():
            return Origin(path, None)
        beside = sorted(other.name for other in path.parent.glob("*.fmu")) if path.parent.is_dir() else []
        self.problems.error(f"no FMU file {written!r}{suggest(path.name, beside)}; looked for {path}", where)
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


def is_file(fmu: str) -> bool:
    """Whether `fmu:` names a file, not a shipped FMU."""
    return fmu.endswith(".fmu") or "/" in fmu or "\\" in fmu
