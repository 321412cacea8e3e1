import itertools
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def folders(tmp_path: Path) -> Callable[[], Path]:
    """A fresh path for a run folder at every call."""
    numbers = itertools.count()
    return lambda: tmp_path / f"run{next(numbers)}"
