"""FMUs of the probe, and a kernel built from the sources as they are."""

from pathlib import Path

import pytest

from cosim.kernel import layout
from fmus import build
from tests.components.probe import probe_library, probes

__all__ = ["probe_library", "probes"]


@pytest.fixture(scope="session", autouse=True)
def fresh_kernel(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The kernel of these sources, even if the one beside them is older."""
    folder = Path(layout.__file__).parent
    built = folder / f"_kernel{build.library_suffix()}"
    newest = max(source.stat().st_mtime for source in folder.glob("*.[ch]"))
    if not built.exists() or built.stat().st_mtime < newest:
        build.build_kernel()
