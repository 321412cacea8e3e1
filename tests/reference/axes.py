"""Decoupled axes: `m v' + d v + k p + b + gravity sin p = u` on each, their parameters and the regressor.

A mass with spring and damper, a pendulum and a double integrator are all of this form. Like `arm`, readable NumPy for
single configurations, for any number of axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
PARAMETERS = 5
"""Of an axis: mass, damping, stiffness, bias, gravity."""


@dataclass(frozen=True)
class Axes:
    """One number per axis, in the units of its plant."""

    m: tuple[float, ...] = (1.0, 1.0)
    d: tuple[float, ...] = (0.0, 0.0)
    k: tuple[float, ...] = (0.0, 0.0)
    b: tuple[float, ...] = (0.0, 0.0)
    gravity: tuple[float, ...] = (0.0, 0.0)

    @property
    def theta(self) -> Floats:
        """The parameters axis by axis, shape (5 axes,)."""
        return np.array([self.m, self.d, self.k, self.b, self.gravity]).T.ravel()


def regressor(p: Floats, _v: Floats, x: Floats, x_dot: Floats) -> Floats:
    """`Y(p, v, x, x')` with `Y theta = m x' + d x + k p + b + gravity sin p`, shape (axes, 5 axes)."""
    Y = np.zeros((len(p), PARAMETERS * len(p)))
    for i in range(len(p)):
        Y[i, PARAMETERS * i : PARAMETERS * (i + 1)] = x_dot[i], x[i], p[i], 1.0, np.sin(p[i])
    return Y


def acceleration(axes: Axes, p: Floats, v: Floats, u: Floats) -> Floats:
    """`v'`, shape (axes,)."""
    m, d, k, b, gravity = axes.theta.reshape(-1, PARAMETERS).T
    return np.asarray((u - d * v - k * p - b - gravity * np.sin(p)) / m, dtype=np.float64)
