"""How a report writes numbers."""

from __future__ import annotations

import math

NOTHING = "–"

Rows = list[tuple[str, str]]


def number(value: float | None, unit: str = "", digits: int = 4) -> str:
    """A number as people read it, or a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:.{digits}g}{f' {unit}' if unit else ''}"
