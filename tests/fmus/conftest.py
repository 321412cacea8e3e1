"""FMUs built from the sources as they are, and instances that are freed when a test ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fmus import build
from tests.fmus.driver import Driver


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """All FMU files by name, such as `TwoLinkArm.fmi2`."""
    destination = tmp_path_factory.mktemp("built")
    paths = [path for folder in build.model_folders() for path in build.build_model(folder, destination)]
    return {path.stem: path for path in paths}


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
