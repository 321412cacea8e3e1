"""The controller once more, in NumPy and straight from the paper's equations, to hold the FMUs against."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.reference.arm import Arm, acceleration, inertia, regressor

Floats = NDArray[np.float64]


def solve_tightly(f: Callable[[float, Floats], Floats], begin: float, end: float, x: Floats) -> Floats:
    """State at `end`, to about 1e-12."""
    result = solve_ivp(f, (begin, end), x, method="DOP853", rtol=1e-12, atol=1e-13)
    assert result.success
    return np.asarray(result.y[:, -1])


def runge_kutta(step: float) -> Callable[[Callable[[float, Floats], Floats], float, float, Floats], Floats]:
    """The classical method with steps of at most `step`."""

    def solve(f: Callable[[float, Floats], Floats], begin: float, end: float, x: Floats) -> Floats:
        count = max(1, math.ceil((end - begin) / step - 1e-6))
        for i in range(count):
            a = begin + (end - begin) * i / count
            b = end if i + 1 == count else begin + (end - begin) * (i + 1) / count
            h = b - a
            k1 = f(a, x)
            k2 = f(a + h / 2, x + h / 2 * k1)
            k3 = f(a + h / 2, x + h / 2 * k2)
            k4 = f(b, x + h * k3)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return solve


def energy(arm: Arm, p: Floats, v: Floats) -> float:
    """Kinetic and potential energy, J."""
    theta = arm.theta
    height = theta[4] * np.sin(p[0]) + theta[3] * np.sin(p[0] + p[1])
    return float(0.5 * v @ inertia(theta, p) @ v + arm.g * height)


def arm_derivative(arm: Arm, x: Floats, u: Floats) -> Floats:
    """Of the states p, v."""
    return np.concatenate([x[2:], acceleration(arm, x[:2], x[2:], u)])


def arm_regressor(p: Floats, v: Floats, x: Floats, x_dot: Floats) -> Floats:
    """Of an arm under the gravity of Section 5."""
    return regressor(p, v, x, x_dot, Arm().g)


@dataclass
class Law:
    """The control law of Corollary 2 at one instant; states v_bar, v_bar_dot, eta, psi, theta_hat in that order.

    `Pi` is repeated over the parameters, where there are more of them.
    """

    k_p: float = 2.0
    k_d: float = 2.0
    k_e: float = 10.0
    lambda_: float = 13.0
    k_eta: float = 2 * math.sqrt(13.0)
    Pi: Floats = field(default_factory=lambda: np.full(5, 0.3))
    sign: float = -1.0
    leader: bool = False
    coupled: bool = True
    regressor: Callable[[Floats, Floats, Floats, Floats], Floats] = arm_regressor

    def derivative_and_torque(
        self, x: Floats, p: Floats, v: Floats, v_hat: Floats, neighbours: Floats
    ) -> tuple[Floats, Floats]:
        """`neighbours`: the weighted mean of the neighbours' extrapolated positions."""
        m = len(p)
        v_bar, v_bar_dot, eta, psi, theta_hat = np.split(x, [m, 2 * m, 3 * m, 4 * m])
        zero = np.zeros(m)
        eta_dot = -self.k_eta * eta - self.lambda_ * (p - psi) if self.coupled else zero
        psi_dot = -psi + v_bar + neighbours if self.coupled else zero
        v_bar_2dot = zero if self.leader else -self.k_d * v_bar_dot - self.k_p * (v_bar - v_hat)
        v_r, v_r_dot = eta + v_bar, eta_dot + v_bar_dot
        e = v - v_r
        Y = self.regressor(p, v, v_r, v_r_dot)
        Pi = np.resize(self.Pi, len(theta_hat))
        u = Y @ theta_hat - self.k_e * e
        rates = [zero if self.leader else v_bar_dot, v_bar_2dot, eta_dot, psi_dot, self.sign * Pi * (Y.T @ e)]
        return np.concatenate(rates), u


@dataclass(frozen=True)
class Arrival:
    """A message that becomes known to the agent at `time`."""

    time: float
    neighbour: int
    stamp: int
    v_hat: tuple[float, float]


def observer(arrivals: list[Arrival], start: Floats, n_neighbours: int, period: float, ticks: int) -> Floats:
    """v_hat(0) .. v_hat(ticks) by `updatevk_follower` and `updatevk_f2`, word for word; shape (ticks + 1, 2)."""

    def freshest(neighbour: int, time: float) -> Arrival | None:
        known = [a for a in arrivals if a.neighbour == neighbour and a.time <= time + 1e-9]
        return max(known, key=lambda a: a.stamp, default=None)

    estimates = [np.asarray(start, dtype=np.float64)]
    for sigma in range(ticks):
        used = [estimates[-1]]
        for j in range(n_neighbours):
            now, before = freshest(j, sigma * period), freshest(j, (sigma - 1) * period)
            if now is not None and (before is None or now.stamp > before.stamp):
                used.append(np.array(now.v_hat))
        total = used[0]
        for other in used[1:]:
            total = total + other
        estimates.append(total / len(used))
    return np.array(estimates)
