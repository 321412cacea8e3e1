"""Where the temporary folders of a run go, so that what it leaves behind is seen."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.components.probe import probe_library, probes

__all__ = ["probe_library", "probes", "scratch"]


@pytest.fixture(autouse=True, scope="session")
def patience() -> Iterator[None]:
    """Survivors of a fault get the time to say how far they are, however busy the machine is."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("cosim.distributed.supervision._SETTLE_SECONDS", 30.0)
        yield


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path
