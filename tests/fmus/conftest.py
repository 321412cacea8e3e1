"""FMUs built from the sources as they are, and instances that are freed when a test ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fmus import build
from tests.fmus.driver import Driver


class Built(dict[str, Path]):
    """FMU files by name, such as `TwoLinkArm.fmi2`: those of a model are built when the first is asked for."""

    def __init__(self, destination: Path) -> None:
        super().__init__()
        self._destination = destination

    def __missing__(self, name: str) -> Path:
        folder = build.ROOT / name.rpartition(".")[0]
        self.update({path.stem: path for path in build.build_model(folder, self._destination)})
        return self[name]


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """All FMU files, built from the sources as they are."""
    return Built(tmp_path_factory.mktemp("built"))


@pytest.fixture
def open_fmu(built: dict[str, Path]) -> Iterator[Callable[[str, str], Driver]]:
    """`open_fmu("TwoLinkArm.fmi3", CS)` instantiates."""
    drivers: list[Driver] = []

    def open_one(name: str, interface: str) -> Driver:
        drivers.append(Driver(built[name], interface))
        return drivers[-1].instantiate()

    yield open_one
    for driver in drivers:
        driver.close()
