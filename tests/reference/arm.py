"""The two-link arm of Section 5 of the paper, written out as matrices: `M`, `C`, `G`, the parameters and the regressor.

Readable NumPy for single configurations; the errata tests check the paper's identities on it, and `network_ode` is
checked against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Arm:
    """Masses kg, lengths m, inertias kg·m², gravity m/s²; the defaults are those of Section 5."""

    m1: float = 1.0
    m2: float = 1.0
    l1: float = 0.5
    l2: float = 0.5
    lc1: float = 0.25
    lc2: float = 0.25
    I1: float = 0.1
    I2: float = 0.1
    g: float = 9.81

    @property
    def theta(self) -> Floats:
        """The five parameters in the paper's order, shape (5,)."""
        return np.array(
            [
                self.m1 * self.lc1**2 + self.m2 * (self.l1**2 + self.lc2**2) + self.I1 + self.I2,
                self.m2 * self.l1 * self.lc2,
                self.m2 * self.lc2**2 + self.I2,
                self.m2 * self.lc2,
                self.m1 * self.lc1 + self.m2 * self.l1,
            ]
        )


def inertia(theta: Floats, p: Floats) -> Floats:
    """`M(p)`, shape (2, 2)."""
    t1, t2, t3 = theta[:3]
    c = np.cos(p[1])
    return np.array([[t1 + 2 * t2 * c, t3 + t2 * c], [t3 + t2 * c, t3]])


def inertia_rate(theta: Floats, p: Floats, v: Floats) -> Floats:
    """Time derivative of `M(p)` along `v`, shape (2, 2)."""
    rate = -theta[1] * np.sin(p[1]) * v[1]
    return np.array([[2 * rate, rate], [rate, 0.0]])


def coriolis(theta: Floats, p: Floats, v: Floats) -> Floats:
    """`C(p, v)`, shape (2, 2)."""
    s = theta[1] * np.sin(p[1])
    return np.array([[-s * v[1], -s * (v[0] + v[1])], [s * v[0], 0.0]])


def gravity(theta: Floats, p: Floats, g: float) -> Floats:
    """`G(p)` in N·m, shape (2,)."""
    forearm = g * theta[3] * np.cos(p[0] + p[1])
    return np.array([g * theta[4] * np.cos(p[0]) + forearm, forearm])


def regressor(p: Floats, v: Floats, x: Floats, x_dot: Floats, g: float, shoulder: int = 0) -> Floats:
    """`Y(p, v, x, x')` of property P.3, shape (2, 5).

    Args:
        p: angles rad, shape (2,).
        v: velocities rad/s, shape (2,).
        x: the velocity that `C` multiplies, shape (2,).
        x_dot: the acceleration that `M` multiplies, shape (2,).
        g: gravity m/s².
        shoulder: which angle the paper's undefined symbol `^ip_i` in the gravity columns stands for: 0 for `p_i1` (the
            correct reading), 1 for `p_i2`.
    """
    c, s = np.cos(p[1]), np.sin(p[1])
    forearm = g * np.cos(p[shoulder] + p[1])
    y12 = c * (2 * x_dot[0] + x_dot[1]) - s * (x[0] * v[1] + x[1] * (v[0] + v[1]))
    y22 = x_dot[0] * c + x[0] * v[0] * s
    return np.array(
        [
            [x_dot[0], y12, x_dot[1], forearm, g * np.cos(p[shoulder])],
            [0.0, y22, x_dot[0] + x_dot[1], forearm, 0.0],
        ]
    )


def acceleration(arm: Arm, p: Floats, v: Floats, u: Floats) -> Floats:
    """`v'` of `model_case1`, rad/s², shape (2,)."""
    theta = arm.theta
    force = u - coriolis(theta, p, v) @ v - gravity(theta, p, arm.g)
    return np.asarray(np.linalg.solve(inertia(theta, p), force), dtype=np.float64)
