"""Algebraic loops: outputs that depend directly on each other. `cosim.agents.wiring` finds them, Newton solves them.

With the inputs set from y, the components say G(y); wanted is y = G(y). Derivatives are forward differences, so that
nothing optional is asked of a component: in Continuous-Time Mode and in Event Mode inputs can be set and outputs read
as often as one likes (FMI 3.0, sections 3.2.2 and 3.2.3). Elimination is plain arithmetic in a fixed order, not
LAPACK's: the same bits everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from cosim.components.component import Floats

TOLERANCE = 1e-10
"""Largest |G(y) - y|, relative to |y|, or absolute where that is below 1."""

ITERATIONS = 20

_DIFFERENCE = 2.0**-26  # about the root of the precision of a float


class UnsolvedError(ValueError):
    """Newton's method did not arrive; the message says why, for the end of a sentence."""


def solve(outputs: Callable[[Floats], Floats], start: Floats) -> Floats:
    """The y with y = G(y), as G(y); the last evaluation is at that y.

    Args:
        outputs: G.
        start: where to begin, shape (n,).

    Raises:
        UnsolvedError: there is none near, more than one, or it takes too many iterations.
    """
    y, g = start, outputs(start)
    for _ in range(ITERATIONS):
        if _small(g - y, y):
            return g
        step = _eliminate(_jacobian(outputs, y, g), y - g)
        y = y + step
        g = outputs(y)
    if _small(g - y, y):
        return g
    raise UnsolvedError(f"is not solved after {ITERATIONS} iterations: {np.max(np.abs(g - y)):.3g} is left")


def _small(residual: Floats, y: Floats) -> bool:
    return bool(np.all(np.abs(residual) <= TOLERANCE * np.maximum(1.0, np.abs(y))))


def _jacobian(outputs: Callable[[Floats], Floats], y: Floats, g: Floats) -> list[list[float]]:
    """Of G(y) - y, row by row."""
    n = len(y)
    rows = [[0.0] * n for _ in range(n)]
    for j in range(n):
        moved = y.copy()
        moved[j] += _DIFFERENCE * max(1.0, abs(float(y[j])))
        slopes = ((outputs(moved) - g) / (moved[j] - y[j])).tolist()
        for i in range(n):
            rows[i][j] = slopes[i] - (i == j)
    return rows


def _eliminate(rows: list[list[float]], right: Floats) -> Floats:
    """The solution of a linear system, by elimination with partial pivoting; `rows` is used up."""
    x = [float(value) for value in right]
    n = len(x)
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(rows[i][k]))
        if not math.isfinite(rows[pivot][k]) or abs(rows[pivot][k]) <= _DIFFERENCE:
            raise UnsolvedError("has no solution, or more than one")
        rows[k], rows[pivot] = rows[pivot], rows[k]
        x[k], x[pivot] = x[pivot], x[k]
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            for j in range(k, n):
                rows[i][j] -= factor * rows[k][j]
            x[i] -= factor * x[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            x[k] -= rows[k][j] * x[j]
        x[k] /= rows[k][k]
    return np.array(x)
