"""The tree in docs/design.md, by which newcomers find their way."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_tree_names_every_room_and_every_file_that_is_in_none() -> None:
    tree = re.findall(r"\w+(?:/|\.py\b)", (ROOT / "docs/design.md").read_text().split("```")[3])
    names = [
        path.name if path.is_file() else f"{path.name}/"
        for package in ("network", "cosim")
        for path in (ROOT / package).iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    ]
    assert len(names) > 50
    assert [name for name in names if name not in tree and not name.startswith("__")] == []
