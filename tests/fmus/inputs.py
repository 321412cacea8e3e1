"""A scripted environment for one controller: smooth own motion, and messages with delays from three neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.fmus.driver import Driver, Floats

T = 0.1
N = 3

START: dict[str, Any] = {
    "n_neighbours": N,
    "weight": [0.5, 0.3, 0.2],
    "v_hat_start": [0.1, -0.2],
    "theta_hat_start": [0.1, 0.05, 0.02, 0.1, 0.2],
    "p": [0.4, -0.3],
    "v": [0.2, 0.1],
}

RECORDED = (
    "u",
    "v_hat",
    "v_bar",
    "v_bar_dot",
    "eta",
    "psi",
    "theta_hat",
    "v_r",
    "e",
    "v_bar_integral",
    "der(theta_hat)",
)


def own(time: float) -> tuple[Floats, Floats]:
    """Own position and velocity."""
    p = np.array([0.4 + 0.3 * np.sin(time), -0.3 + 0.5 * time])
    return p, np.array([0.3 * np.cos(time), 0.5])


def messages(tick: int) -> dict[str, Any]:
    """The mailbox from tick `tick` on: neighbour j has an age of j + 1 ticks, and neighbour 2 is heard late."""
    stamp = np.array([tick - 1, tick - 2, tick - 3 if tick > 8 else -1])
    stamp = np.maximum(stamp, -1)
    time = np.maximum(stamp, 0) * T
    shift = np.array([[0.1, 0.2], [-0.3, 0.1], [0.2, -0.2]])
    return {
        "neighbour_stamp": stamp,
        "neighbour_time": time,
        "neighbour_p": shift + np.outer(time, [0.3, 0.6]),
        "neighbour_v_hat": np.array([0.3, 0.6]) + 0.1 * np.cos(np.outer(time, [1.0, 2.0])),
    }


def record(fmu: Driver) -> Floats:
    return np.concatenate([fmu.get(name) for name in RECORDED])


def play(fmu: Driver, begin: int, end: int, steps: int = 4) -> Floats:
    """Co-Simulation from tick `begin` to tick `end` with `steps` communication steps a tick; one row a step."""
    rows = []
    for tick in range(begin, end):
        fmu.set(**messages(tick))
        for i in range(1, steps + 1):
            p, v = own(fmu.time)
            fmu.set(p=p, v=v)
            fmu.step_to((tick + i / steps) * T)
            rows.append(record(fmu))
    return np.array(rows)
