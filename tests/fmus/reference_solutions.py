"""Writes `fmus/<Model>/reference.csv`: each model alone, solved without the FMU by SciPy's DOP853 (rtol 1e-12).

Run `python -m tests.fmus.reference_solutions` to write them again.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from tests.fmus.theory import Floats, Law, arm_derivative, solve_tightly
from tests.reference.arm import Arm

FMUS = Path(__file__).resolve().parents[2] / "fmus"
T = 0.1

START: dict[str, dict[str, Any]] = {
    "TwoLinkArm": {"p": [0.4, -0.7], "v": [0.3, 0.6], "u": [3.0, 0.5]},
    "ArmSyncController": {
        "p": [0.2, -0.1],
        "v": [0.3, 0.6],
        "v_hat_start": [0.1, 0.0],
        "neighbour_p": [1.0, 0.5],
        "neighbour_v_hat": [0.3, 0.6],
        "neighbour_stamp": [0],
        "neighbour_time": [0.0],
        "weight": [1.0],
    },
}
"""Start values and constant inputs of the two experiments (the controller has one in-neighbour, heard at tick 0)."""

STOP = {"TwoLinkArm": 3.0, "ArmSyncController": 3.0}


def arm() -> tuple[list[str], Floats]:
    """Names of the columns, and one row every 0.1 s."""
    start = START["TwoLinkArm"]
    x, u = np.array(start["p"] + start["v"]), np.array(start["u"])
    rows = [[0.0, *x]]
    for k in range(round(STOP["TwoLinkArm"] / T)):
        x = solve_tightly(lambda _, y: arm_derivative(Arm(), y, u), k * T, (k + 1) * T, x)
        rows.append([(k + 1) * T, *x])
    return ["time", "p[1]", "p[2]", "v[1]", "v[2]"], np.array(rows)


def controller() -> tuple[list[str], Floats]:
    """The same for the controller, whose v_hat becomes the mean of both estimates at t = T."""
    start = {name: np.array(value) for name, value in START["ArmSyncController"].items()}
    p, v, v_hat = start["p"], start["v"], start["v_hat_start"]
    law = Law()
    x = np.concatenate([v_hat, np.zeros(4), p, np.zeros(5)])

    def row(time: float) -> list[float]:
        neighbour = start["neighbour_p"] + start["neighbour_v_hat"] * time
        _, u = law.derivative_and_torque(x, p, v, v_hat, neighbour)
        return [time, *u, *v_hat, *x]

    rows = [row(0.0)]
    for k in range(round(STOP["ArmSyncController"] / T)):
        held = v_hat

        def f(t: float, y: Floats, held: Floats = held) -> Floats:
            neighbour = start["neighbour_p"] + start["neighbour_v_hat"] * t
            return law.derivative_and_torque(y, p, v, held, neighbour)[0]

        x = solve_tightly(f, k * T, (k + 1) * T, x)
        v_hat = (v_hat + start["neighbour_v_hat"]) / 2 if k == 0 else v_hat
        rows.append(row((k + 1) * T))
    names = [("u", 2), ("v_hat", 2), ("v_bar", 2), ("v_bar_dot", 2), ("eta", 2), ("psi", 2), ("theta_hat", 5)]
    return ["time", *(f"{name}[{i + 1}]" for name, size in names for i in range(size))], np.array(rows)


SOLUTIONS = {"TwoLinkArm": arm, "ArmSyncController": controller}


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
