"""One-step-at-a-time solvers for an initial value problem over one smooth segment, all with the same signature.

An integrator is a function `(rhs, y0, h) -> y(h)`; `rhs(s, y)` takes and returns 1-D sequences of floats.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import ode, solve_ivp

Floats = NDArray[np.float64]
Rhs = Callable[[float, Floats], Sequence[float]]
Integrator = Callable[[Rhs, Floats, float], Floats]


class SolverError(ArithmeticError):
    """The solver could not cross a segment, which happens when the solution escapes to infinity.

    Attributes:
        after: how far it came, s from the segment's start.
        size: largest magnitude of a component of the state there.
    """

    def __init__(self, after: float, size: float) -> None:
        self.after = after
        self.size = size
        super().__init__(f"stopped {after:.9g} s into the segment, at a state of magnitude {size:.3g}")


def dop853(rtol: float = 1e-12, atol: float = 1e-13, max_step: float = 10e-3, max_steps: int = 20_000) -> Integrator:
    """Hairer's DOP853, a Runge-Kutta method of order 8 with error control: the reference solution.

    The steps are bounded (s) as well: the arm's fastest mode has a time constant of 5 ms, and a step of several times
    that now and then passes the error test by chance, with an error of 1e-9. Up to 10 ms none was seen above 1e-12.
    """

    def integrate(rhs: Rhs, y0: Floats, h: float) -> Floats:
        solver = ode(rhs).set_integrator("dop853", rtol=rtol, atol=atol, max_step=max_step, nsteps=max_steps)
        solver.set_initial_value(y0, 0.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a failure is reported through `successful`
            y: Floats = solver.integrate(h)
        if not solver.successful():
            raise SolverError(solver.t, float(np.abs(y).max()))
        return y

    return integrate


def implicit(method: str = "Radau", rtol: float = 1e-11, atol: float = 1e-13) -> Integrator:
    """An implicit method of `solve_ivp` (`Radau`, order 5; `LSODA`), the second opinion."""

    def integrate(rhs: Rhs, y0: Floats, h: float) -> Floats:
        solution = solve_ivp(rhs, (0.0, h), y0, method=method, rtol=rtol, atol=atol, t_eval=(h,))
        if not solution.success:
            raise SolverError(float(solution.t[-1]), float(np.abs(solution.y[:, -1]).max()))
        y: Floats = solution.y[:, -1]
        return y

    return integrate


def rk4(step: float) -> Integrator:
    """Classical Runge-Kutta of order 4 in equal steps of at most `step` seconds."""

    def integrate(rhs: Rhs, y0: Floats, h: float) -> Floats:
        n = max(1, math.ceil(h / step - 1e-9))
        dt, y = h / n, y0
        for i in range(n):
            s = i * dt
            k1 = np.asarray(rhs(s, y))
            k2 = np.asarray(rhs(s + dt / 2, y + dt / 2 * k1))
            k3 = np.asarray(rhs(s + dt / 2, y + dt / 2 * k2))
            k4 = np.asarray(rhs(s + dt, y + dt * k3))
            y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return y

    return integrate
