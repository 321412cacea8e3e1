"""Two oscillators coupled by a spring, split in two ways: the literature's standard test of how co-simulations couple.

    |--k1,d1--[ m1 ]--k_c,d_c--[ m2 ]--k2,d2--|

Force and displacement: the first oscillator takes the spring's force, the second has the spring and takes the first
one's motion. Force and force: both take the force, of a spring that is a component of its own. (Schweizer, Li, Lu:
*Explicit and implicit cosimulation methods: stability and convergence analysis*, 2015; Busch: *Continuous approximation
techniques for co-simulation methods*, 2016.) The whole is linear, so its solution is a matrix exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import yaml
from scipy.linalg import expm

from cosim.cli import main
from fmus import build
from tests.reference.arm import Floats

MODELS = Path(__file__).with_name("oscillators")
PERIOD_MS = 100
SPLITS = ("force-displacement", "force-force")


@dataclass(frozen=True)
class Oscillators:
    """Masses kg, stiffnesses N/m, damping coefficients N s/m; initial positions m, at rest."""

    m: tuple[float, float] = (1.0, 0.5)
    k: tuple[float, float] = (10.0, 20.0)
    d: tuple[float, float] = (0.2, 0.1)
    k_c: float = 30.0
    d_c: float = 0.3
    p: tuple[float, float] = (0.1, -0.05)

    def solution(self, times: Sequence[float] | Floats) -> Floats:
        """Positions at these times in s, shape (len(times), 2)."""
        (m1, m2), (k1, k2), (d1, d2), k, d = self.m, self.k, self.d, self.k_c, self.d_c
        matrix = np.array(
            [
                [0, 0, 1, 0],
                [0, 0, 0, 1],
                [-(k1 + k) / m1, k / m1, -(d1 + d) / m1, d / m1],
                [k / m2, -(k2 + k) / m2, d / m2, -(d2 + d) / m2],
            ]
        )
        start = np.array([*self.p, 0.0, 0.0])
        return np.array([(expm(matrix * t) @ start)[:2] for t in times])

    def scenario(self, split: str, built: Path) -> dict[str, object]:
        """One agent of two or three FMUs, of which those in `built` are only there for this test."""
        first = {"n_axes": 1, "m": self.m[0], "k": self.k[0], "d": self.d[0], "p": self.p[0]}
        spring = {"k_c": self.k_c, "d_c": self.d_c}
        components: dict[str, object] = {"first": {"fmu": "MassSpringDamper", "start": first}}
        second: dict[str, object] = {"m": self.m[1], "k": self.k[1], "d": self.d[1], "p": self.p[1]}
        if split == "force-displacement":
            file = built / "SuspendedMass.fmi3.fmu"
            components["second"] = {"fmu": str(file), "start": second | spring}
            connections = ["first.p -> second.p_c", "first.v -> second.v_c", "second.f -> first.u"]
        else:
            components["second"] = {"fmu": "MassSpringDamper", "start": {"n_axes": 1, **second}}
            components["spring"] = {"fmu": str(built / "Spring.fmi3.fmu"), "start": spring}
            connections = ["first.p -> spring.p1", "first.v -> spring.v1", "spring.f1 -> first.u"]
            connections += ["second.p -> spring.p2", "second.v -> spring.v2", "spring.f2 -> second.u"]
        agent = {"components": components, "connections": connections, "record": ["first.p", "second.p"]}
        return {"name": "oscillators", "period": f"{PERIOD_MS} ms", "duration": "10 s", "agents": {"pair": agent}}


STIFF = Oscillators(k_c=1000.0)
"""The same two, coupled 33 times as stiffly."""


def build_models(folder: Path) -> Path:
    """The FMUs of this test; returns the folder."""
    for name in ("SuspendedMass", "Spring"):
        build.build_model(MODELS / name, folder)
    return folder


def simulate(
    oscillators: Oscillators, split: str, method: str, step_us: float, built: Path, out: Path, until: str = "10 s"
) -> Floats:
    """Positions at the ticks that `cosim run` recorded, shape (ticks + 1, 2): fewer, if it broke down."""
    config = out.with_suffix(".yaml")
    config.write_text(yaml.safe_dump(oscillators.scenario(split, built), sort_keys=False), encoding="utf-8")
    command = ["run", str(config), "--out", str(out), "--quiet", "--no-report", "--until", until]
    command += ["--set", f"coupling.method={method}", "--set", f"coupling.step={round(step_us * 1000)} ns"]
    code = main(command)
    if code not in (0, 3):  # 3: it failed on its way, as one that diverges does
        raise RuntimeError(f"cosim {' '.join(command)}: exit code {code}")
    table = pq.read_table(out / "trajectories.parquet")
    second = "second.p" if split == "force-displacement" else "second.p[1]"
    return np.stack([table["first.p[1]"].to_numpy(), table[second].to_numpy()], axis=1)


def error(simulated: Floats, oscillators: Oscillators) -> float:
    """Largest difference of a position from the exact solution, over the ticks that were simulated, m."""
    exact = oscillators.solution(np.arange(len(simulated)) * PERIOD_MS / 1e3)
    return float(np.abs(simulated - exact).max())
