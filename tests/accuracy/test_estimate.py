"""The estimated error of the coupling, beside the true one of a linear loop whose solution is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.errors import CosimError
from cosim.running.estimation import Estimate
from cosim.running.inline import run
from network.messages import Fates
from tests.components.misbehaving import cosim, digest
from tests.distributed.networks import planned

SCENARIO = """\
period: 100 ms
duration: 2 s
agents:
  1:
    components:
      plant: {{fmu: MassSpringDamper, start: {{solver_step: 0.0005}}}}
      pd: {{fmu: PDController, start: {{k_p: 20, k_d: 3, p_ref: 0.4, v_ref: 0, u_ref: 0}}}}
    connections: [plant.p -> pd.p, plant.v -> pd.v, pd.u -> plant.u]
    record: [plant.p, plant.v]
coupling: {{method: {method}, step: {step}}}
"""


class Rows:
    def __init__(self) -> None:
        self.rows: list[np.ndarray] = []

    def tick(self, tick: int, row: np.ndarray) -> None:
        self.rows.append(row)

    def fates(self, fates: Fates) -> None:
        pass


def exact() -> np.ndarray:
    """Of p'' = 20 (0.4 - p) - 3 v - 0.5 v - p, at the ticks."""
    matrix = np.array([[0.0, 1.0, 0.0], [-21.0, -3.5, 8.0], [0.0, 0.0, 0.0]])
    return np.array([(expm(0.1 * k * matrix) @ [0.0, 0.0, 1.0])[:2] for k in range(21)])


@pytest.mark.parametrize(
    ("method", "step"),
    [("gauss-seidel", "5 ms"), ("jacobi", "2 ms"), ("midpoint", "10 ms"), ("joint, integrator: euler", "2 ms")],
)
def test_estimate_beside_the_true_error(method: str, step: str) -> None:
    plan = planned(SCENARIO.format(method=method, step=step))
    estimate, rows = Estimate(plan), Rows()
    estimate.prepare(lambda: False)
    run(plan, [estimate, rows])
    found = np.array(rows.rows)
    true = np.max(np.abs(found - exact()) / np.ptp(found, axis=0))
    (error,) = estimate.errors()
    assert error.relative == pytest.approx(true, rel=0.2)
    assert error.variable in ("plant.p[1]", "plant.v[1]")


def test_what_the_command_says_and_writes(tmp_path: Path) -> None:
    text = SCENARIO.format(method="gauss-seidel", step="20 ms")
    plain = cosim(tmp_path, "run", "net.yaml", "--out", "plain", "--no-report", text=text)
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--estimate-error", text=text)
    assert digest(done) == digest(plain)
    (line,) = (line for line in done.stdout.splitlines() if "coupling error" in line)
    assert "of agent 1" in line
    assert "warning: agent 1: the estimated error of plant." in done.stderr
    assert 'the step 20 ms is too long for gauss-seidel: try `--set coupling.step="5 ms"`' in done.stderr
    (written,) = json.loads((tmp_path / "out" / "manifest.json").read_text())["coupling_error"]
    assert written["agent"] == "1"
    assert written["relative"] > 0.01
    assert "Coupling error" in (tmp_path / "out" / "report.html").read_text()


def test_steps_that_cannot_be_halved() -> None:
    with pytest.raises(CosimError, match="no agent has one that can be halved"):
        Estimate(planned(SCENARIO.format(method="joint, integrator: dormand-prince", step="5 ms")))
