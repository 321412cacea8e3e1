"""Algebraic loops: outputs that depend directly on each other. `cosim.agents.wiring` finds them, Newton solves them.

With the inputs set from y, the components say G(y); wanted is y = G(y). Derivatives are forward differences, so that
nothing optional is asked of a component: in Continuous-Time Mode and in Event Mode inputs can be set and outputs read
as often as one likes (FMI 3.0, sections 3.2.2 and 3.2.3). Elimination is plain arithmetic in a fixed order, not
LAPACK's: the same bits everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Floats

TOLERANCE = 1e-10
"""How far from the solution y may be, as Newton's method estimates it, relative to |y|."""

SETTLED = 1e-9
"""Relative: two values that differ by no more may be solutions of the same loop."""

ITERATIONS = 20

_ROUNDING = 2.0**-44  # of the largest value so far: where one passes zero, nothing better can be had
_SOLVED = 2.0**-50  # likewise, of G(y) - y: what is left is rounding
_NEGLIGIBLE = 1e-12  # of G(y) - y, where the method gets no further: of the largest value so far, and of 1
_DIFFERENCE = 2.0**-26  # about the root of the precision of a float
_SINGULAR = 2.0**-24  # such a pivot the errors of the differences may leave of zero
_SINGULAR_TEXT = "has no solution, or more than one"

Outputs = Callable[[Floats], Floats]


def close(one: Floats, other: Floats) -> NDArray[np.bool_]:
    """Which values are the same, as far as a loop that is solved again can tell."""
    same: NDArray[np.bool_] = np.abs(one - other) <= SETTLED * np.maximum(np.abs(one), np.abs(other))
    return same


class UnsolvedError(ValueError):
    """Newton's method did not arrive; the message says why, for the end of a sentence."""


class Solver:
    """Solves one loop again and again. It remembers how large the values have been: that is their scale.

    Args:
        n: how many values there are.
    """

    def __init__(self, n: int) -> None:
        self._largest = np.zeros(n)

    def solve(self, outputs: Outputs, start: Floats) -> Floats:
        """The y with y = G(y); the last evaluation is at that y, and where `start` solves it, it is that.

        Args:
            outputs: G.
            start: where to begin, shape (n,).

        Raises:
            UnsolvedError: there is none near, more than one, or it takes too many iterations.
        """
        y = self._newton(outputs, start)
        self._largest = np.maximum(self._largest, np.abs(y))
        return y

    def _newton(self, outputs: Outputs, start: Floats) -> Floats:
        y, linear, reason = start, None, ""
        best, least = start, math.inf
        for _ in range(ITERATIONS + 1):
            g = outputs(y)
            size = np.maximum(self._largest, np.maximum(np.abs(y), np.abs(g)))
            left = np.abs(g - y)
            if np.all(left <= _SOLVED * size):
                return y
            remainder = float(np.max(left / np.maximum(1.0, size)))
            if remainder < least:
                best, least = y, remainder
            try:
                if linear is not None and _is_small(linear.step(y - g), y, size):
                    return y  # by the derivatives at the value before: those are good enough for an estimate
                linear = _Linear.at(outputs, y, g, np.where(size > 0.0, size, 1.0))
                step = linear.step(y - g)
            except UnsolvedError as error:
                reason = str(error)
                break
            if _is_small(step, y, size):
                best = y
                break
            y = y + step
        else:
            reason = f"is not solved after {ITERATIONS} iterations: {float(np.max(left)):.3g} is left"
        if reason and least > _NEGLIGIBLE:
            raise UnsolvedError(reason)
        outputs(best)
        return best


def _is_small(step: Floats, y: Floats, size: Floats) -> bool:
    return bool(np.all(np.abs(step) <= np.maximum(TOLERANCE * np.abs(y), _ROUNDING * size)))


@dataclass(frozen=True)
class _Linear:
    """The derivatives of G(y) - y: `rows`, of which column j is multiplied by the size of y_j."""

    rows: list[list[float]]
    size: Floats

    @staticmethod
    def at(outputs: Outputs, y: Floats, g: Floats, size: Floats) -> _Linear:
        """Those at y, where G is g; `size` is never zero."""
        n = len(y)
        rows = [[0.0] * n for _ in range(n)]
        for j in range(n):
            moved = y.copy()
            moved[j] += _DIFFERENCE * size[j]
            slopes = ((outputs(moved) - g) / (moved[j] - y[j])).tolist()
            for i in range(n):
                rows[i][j] = (slopes[i] - (i == j)) * size[j].item()
        return _Linear(rows, size)

    def step(self, residual: Floats) -> Floats:
        """The step at whose end G(y) - y would be larger by `residual`, if it was linear."""
        return _eliminate(self.rows, residual.tolist()) * self.size


def _eliminate(matrix: list[list[float]], right: list[float]) -> Floats:
    """The solution of a linear system, by elimination with partial pivoting, after each row got 1 as its largest entry.

    Raises:
        UnsolvedError: as far as can be told, there is none, or more than one.
    """
    scales = [max(map(abs, row)) for row in matrix]
    if not all(0.0 < scale < math.inf for scale in scales):
        raise UnsolvedError(_SINGULAR_TEXT)
    rows = [[entry / scale for entry in row] for row, scale in zip(matrix, scales, strict=True)]
    x = [value / scale for value, scale in zip(right, scales, strict=True)]
    n = len(x)
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(rows[i][k]))
        if not abs(rows[pivot][k]) > _SINGULAR:
            raise UnsolvedError(_SINGULAR_TEXT)
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
