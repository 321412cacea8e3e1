"""Where the temporary folders of a run go, so that what it leaves behind is seen."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from tests.components.probe import probe_library, probes

__all__ = ["probe_library", "probes", "scratch"]


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path
