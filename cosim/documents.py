"""Pages of the docs that are in the package: commands and reports show parts of them."""

from __future__ import annotations

import re
from pathlib import Path

ANCHOR = re.compile(r'<a id="([^"]+)"></a>')


def page(name: str) -> Path:
    """A page: in the package once installed, in the source tree before."""
    here = Path(__file__).parent / "docs" / name
    return here if here.is_file() else here.parents[2] / "docs" / name


def cells(line: str) -> list[str]:
    """What is in a row of a table."""
    return [plain(cell.strip()) for cell in line.strip().strip("|").split("|")]


def plain(text: str) -> str:
    """Without anchors, links and marks that only a browser needs."""
    return re.sub(r"\[([^\]]+)\]\(#?[^)]*\)", r"\1", ANCHOR.sub("", text)).replace("\\*", "*")


def measures() -> list[list[str]]:
    """What a report says of a network: each measure, what it is, and its source."""
    lines = page("freshness.md").read_text(encoding="utf-8").splitlines()
    _, _, *rows = [cells(line) for line in lines if line.startswith("|")]
    return [[cell.replace("`", "") for cell in row] for row in rows]
