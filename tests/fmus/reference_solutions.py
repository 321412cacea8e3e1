"""Writes `fmus/<Model>/reference.csv`: each model alone, solved without the FMU, in closed form where there is one.

Run `python -m tests.fmus.reference_solutions` to write them again.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ellipj

from tests.fmus.theory import Floats, Law, arm_derivative, solve_tightly
from tests.reference import axes
from tests.reference.arm import Arm

FMUS = Path(__file__).resolve().parents[2] / "fmus"
T = 0.1
STOP = 3.0

_HEARD: dict[str, Any] = {
    "p": [0.2, -0.1],
    "v": [0.3, 0.6],
    "v_hat_start": [0.1, 0.0],
    "neighbour_p": [1.0, 0.5],
    "neighbour_v_hat": [0.3, 0.6],
    "neighbour_stamp": [0],
    "neighbour_time": [0.0],
    "weight": [1.0],
}
START: dict[str, dict[str, Any]] = {
    "TwoLinkArm": {"p": [0.4, -0.7], "v": [0.3, 0.6], "u": [3.0, 0.5]},
    "DoubleIntegrator": {"n_axes": 2, "p": [0.4, -0.7], "v": [0.3, 0.6], "u": [0.5, -1.0]},
    "MassSpringDamper": {
        "n_axes": 2,
        "m": [2.0, 0.5],
        "d": [0.4, 3.0],
        "k": [8.0, 2.0],
        "b": [1.0, 0.0],
        "p": [0.4, -0.7],
        "v": [0.3, 0.6],
        "u": [3.0, 0.5],
    },
    "Pendulum": {
        "n_axes": 2,
        "m": [1.0, 2.0],
        "l": [0.5, 0.8],
        "d": [0.0, 0.3],
        "p": [0.0, 2.5],
        "v": [6.0, 0.6],
        "u": [0.0, 1.0],
    },
    "ArmSyncController": _HEARD,
    "AxisSyncController": {"n_axes": 2, **_HEARD},
    "PDController": {
        "n_axes": 2,
        "k_p": [10.0, 4.0],
        "k_d": [5.0, 1.0],
        "p": [0.4, -0.7],
        "v": [0.3, 0.6],
        "p_ref": [1.0, 0.5],
        "v_ref": [0.0, 0.2],
        "u_ref": [0.0, -2.0],
    },
    "ConsensusController": {
        "n_axes": 2,
        "k_p": 2.0,
        "k_v": 0.5,
        "k_d": 0.25,
        "p": [0.4, -0.7],
        "v": [0.3, 0.6],
        "neighbour_p": [1.0, 0.5],
        "neighbour_v": [0.0, 0.2],
        "neighbour_stamp": [0],
        "weight": [0.5],
    },
}
"""Start values and constant inputs; the controllers with a mailbox have one in-neighbour, heard at tick 0."""

Table = tuple[list[str], Floats]
"""Names of the columns, and one row every 0.1 s."""


def _given(model: str) -> dict[str, Floats]:
    return {name: np.array(value) for name, value in START[model].items()}


def _names(*sizes: tuple[str, int | tuple[int, int]]) -> list[str]:
    names = ["time"]
    for name, size in sizes:
        shape = (size,) if isinstance(size, int) else size
        names += [f"{name}[{','.join(str(i + 1) for i in index)}]" for index in np.ndindex(*shape)]
    return names


def _positions_and_velocities(of: Callable[[float], tuple[Floats, Floats]]) -> Table:
    times = np.arange(round(STOP / T) + 1) * T
    return _names(("p", 2), ("v", 2)), np.array([[t, *np.concatenate(of(t))] for t in times])


def arm() -> Table:
    """By DOP853."""
    start = _given("TwoLinkArm")
    x, u = np.concatenate([start["p"], start["v"]]), start["u"]
    rows = [[0.0, *x]]
    for k in range(round(STOP / T)):
        x = solve_tightly(lambda _, y: arm_derivative(Arm(), y, u), k * T, (k + 1) * T, x)
        rows.append([(k + 1) * T, *x])
    return _names(("p", 2), ("v", 2)), np.array(rows)


def double_integrator() -> Table:
    """The parabola."""
    start = _given("DoubleIntegrator")
    p, v, u = start["p"], start["v"], start["u"]
    return _positions_and_velocities(lambda t: (p + v * t + u * t * t / 2, v + u * t))


def mass_spring_damper() -> Table:
    """The decaying oscillation of the first axis, and the two exponentials of the second, around rest."""
    start = _given("MassSpringDamper")
    m, d, k = start["m"], start["d"], start["k"]
    rest = (start["u"] - start["b"]) / k
    roots = (-d + np.sqrt(d * d - 4 * m * k + 0j)) / (2 * m), (-d - np.sqrt(d * d - 4 * m * k + 0j)) / (2 * m)
    second = (start["v"] - roots[0] * (start["p"] - rest)) / (roots[1] - roots[0])
    parts = start["p"] - rest - second, second

    def at(t: float) -> tuple[Floats, Floats]:
        p = rest + sum(part * np.exp(root * t) for part, root in zip(parts, roots, strict=True))
        return p.real, sum(part * root * np.exp(root * t) for part, root in zip(parts, roots, strict=True)).real

    return _positions_and_velocities(at)


def pendulum() -> Table:
    """The first, free of friction and torque, by Jacobi's elliptic functions; the second by DOP853."""
    start = _given("Pendulum")
    m, length, d, u = (start[name] for name in ("m", "l", "d", "u"))
    swing = math.sqrt(9.81 / length[0])
    modulus = start["v"][0] / (2 * swing)  # of a start at the lowest point; below 1 it swings
    second = axes.Axes((m[1] * length[1] ** 2,), (d[1],), (0.0,), (0.0,), (m[1] * 9.81 * length[1],))

    def damped(_: float, x: Floats) -> Floats:
        return np.concatenate([x[1:], axes.acceleration(second, x[:1], x[1:], u[1:])])

    def at(t: float) -> tuple[Floats, Floats]:
        sn, cn, _, _ = ellipj(swing * t, modulus**2)
        x = np.array([start["p"][1], start["v"][1]])
        x = solve_tightly(damped, 0.0, t, x) if t > 0 else x
        return np.array([2 * math.asin(modulus * sn), x[0]]), np.array([2 * modulus * swing * cn, x[1]])

    return _positions_and_velocities(at)


def synchronization(model: str, law: Law, parameters: int | tuple[int, int]) -> Table:
    """A controller whose v_hat becomes the mean of both estimates at t = T; by DOP853."""
    start = _given(model)
    p, v, v_hat = start["p"], start["v"], start["v_hat_start"]
    x = np.concatenate([v_hat, np.zeros(4), p, np.zeros(int(np.prod(parameters)))])

    def row(time: float) -> list[float]:
        neighbour = start["neighbour_p"] + start["neighbour_v_hat"] * time
        _, u = law.derivative_and_torque(x, p, v, v_hat, neighbour)
        return [time, *u, *v_hat, *x]

    rows = [row(0.0)]
    for k in range(round(STOP / T)):
        held = v_hat

        def f(t: float, y: Floats, held: Floats = held) -> Floats:
            neighbour = start["neighbour_p"] + start["neighbour_v_hat"] * t
            return law.derivative_and_torque(y, p, v, held, neighbour)[0]

        x = solve_tightly(f, k * T, (k + 1) * T, x)
        v_hat = (v_hat + start["neighbour_v_hat"]) / 2 if k == 0 else v_hat
        rows.append(row((k + 1) * T))
    columns: list[tuple[str, int | tuple[int, int]]] = [
        (name, 2) for name in ("u", "v_hat", "v_bar", "v_bar_dot", "eta", "psi")
    ]
    return _names(*columns, ("theta_hat", parameters)), np.array(rows)


def _constant(u: Floats) -> Table:
    times = np.arange(round(STOP / T) + 1) * T
    return _names(("u", len(u))), np.array([[t, *u] for t in times])


def proportional_derivative() -> Table:
    """Of constant inputs, a constant."""
    x = _given("PDController")
    return _constant(x["u_ref"] + x["k_p"] * (x["p_ref"] - x["p"]) + x["k_d"] * (x["v_ref"] - x["v"]))


def consensus() -> Table:
    """Of constant inputs, a constant."""
    x = _given("ConsensusController")
    pull = x["k_p"] * (x["neighbour_p"] - x["p"]) + x["k_v"] * (x["neighbour_v"] - x["v"])
    return _constant(x["weight"][0] * pull - x["k_d"] * x["v"])


SOLUTIONS: dict[str, Callable[[], Table]] = {
    "TwoLinkArm": arm,
    "DoubleIntegrator": double_integrator,
    "MassSpringDamper": mass_spring_damper,
    "Pendulum": pendulum,
    "ArmSyncController": lambda: synchronization("ArmSyncController", Law(), 5),
    "AxisSyncController": lambda: synchronization("AxisSyncController", Law(regressor=axes.regressor), (2, 5)),
    "PDController": proportional_derivative,
    "ConsensusController": consensus,
}


def as_csv(names: list[str], rows: Floats) -> str:
    """Twelve significant digits: what the solver is good for."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([f"{value:.12g}" for value in row] for row in rows)
    return text.getvalue()


if __name__ == "__main__":
    for model, solve in SOLUTIONS.items():
        (FMUS / model / "reference.csv").write_text(as_csv(*solve()), encoding="utf-8")
        print(f"wrote fmus/{model}/reference.csv")
