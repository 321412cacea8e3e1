"""What fits by maximum likelihood have in common: how they are compared, and how sure their parameters are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from network.messages import Floats

CONFIDENCE_SIGMAS = 1.959963984540054
"""Of a 95 % confidence interval."""
_STEP = 1e-4


def aic(log_likelihood: float, parameters: int) -> float:
    """Akaike's criterion; the less, the better."""
    return 2 * parameters - 2 * log_likelihood


def bic(log_likelihood: float, parameters: int, n: int) -> float:
    """Schwarz's criterion, which does not prefer the larger model however long the log is."""
    return parameters * math.log(max(n, 1)) - 2 * log_likelihood


def half_widths(cost: Callable[[Floats], float], at: Sequence[float] | Floats) -> Floats:
    """Half of the 95 % confidence interval of each parameter, from the curvature of minus the log-likelihood.

    Returns:
        (n,); NaN where the likelihood is flat, or has no maximum inside.
    """
    point = np.asarray(at, np.float64)
    steps = _STEP * np.maximum(1.0, np.abs(point))
    n = len(point)
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            shift = [np.zeros(n), np.zeros(n)]
            shift[0][i], shift[1][j] = steps[i], steps[j]
            corners = (a * shift[0] + b * shift[1] for a in (1, -1) for b in (1, -1))
            values = [cost(point + corner) for corner in corners]
            curvature[i, j] = (values[0] - values[1] - values[2] + values[3]) / (4 * steps[i] * steps[j])
    try:
        variance = np.diag(np.linalg.inv(curvature))
    except np.linalg.LinAlgError:
        return np.full(n, np.nan)
    return CONFIDENCE_SIGMAS * np.sqrt(np.where(variance > 0, variance, np.nan))
