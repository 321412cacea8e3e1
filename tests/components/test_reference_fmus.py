"""modelica/Reference-FMUs, run by netcosim and compared with the results that they ship.

Skipped unless NETCOSIM_REFERENCE_FMUS names a folder with `2.0/BouncingBall.fmu`, `3.0/BouncingBall.fmu` and so on;
docs/fmi.md says how to build them. Their results are those of explicit Euler steps: `integrator: euler` with the same
step gives the same numbers. Where netcosim does better (state events, which they leave to the end of a step), results
must lie in the band of the FMI Cross-Check rules, as FMPy draws it, and on the exact solution.
"""

from __future__ import annotations

import csv
import io
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.util import validate_signal
from scipy.integrate import solve_ivp

from cosim.components.fmu import describe
from cosim.errors import ConfigError, RunEndedError
from cosim.fmu_commands import stub
from cosim.plan import Plan
from cosim.planning import load
from cosim.running import inline
from tests.distributed.networks import planned

FOLDER = os.environ.get("NETCOSIM_REFERENCE_FMUS", "")
pytestmark = pytest.mark.skipif(not FOLDER, reason="NETCOSIM_REFERENCE_FMUS names no folder (docs/fmi.md)")


@dataclass(frozen=True)
class Experiment:
    """How a model was run for the result that it ships: every how many seconds, how long, with which solver step."""

    period: str
    until: float
    solver_step: str
    versions: tuple[str, ...] = ("2.0", "3.0")


EXPERIMENTS = {
    "BouncingBall": Experiment("10 ms", 3.0, "1 ms"),
    "Dahlquist": Experiment("100 ms", 10.0, "100 ms"),
    "Feedthrough": Experiment("100 ms", 2.0, "100 ms"),
    "Resource": Experiment("1 s", 1.0, "1 s"),
    "Stair": Experiment("200 ms", 8.8, "200 ms"),
    "StateSpace": Experiment("1 s", 10.0, "1 ms", versions=("3.0",)),
    "VanDerPol": Experiment("10 ms", 20.0, "10 ms"),
}
CASES = [(name, version) for name, experiment in EXPERIMENTS.items() for version in experiment.versions]
COUPLINGS: dict[str, dict[str, str]] = {
    "Co-Simulation": {"method": "gauss-seidel"},
    "Model Exchange": {"method": "joint", "integrator": "euler"},
    "Model Exchange in Python": {"method": "joint", "integrator": "euler", "loop": "python"},
}


class Record:
    """Keeps every row."""

    def __init__(self) -> None:
        self.rows: list[Any] = []

    def tick(self, _tick: int, row: Any) -> None:
        self.rows.append(row)

    def fates(self, _fates: Any) -> None: ...


def path(name: str, version: str) -> Path:
    return Path(FOLDER) / version / f"{name}.fmu"


def scenario(name: str, version: str, coupling: dict[str, str], until: float | None = None, **component: Any) -> Plan:
    experiment = EXPERIMENTS[name]
    component["fmu"] = str(path(name, version))
    tree = {
        "name": "reference",
        "seed": 1,
        "period": experiment.period,
        "duration": f"{experiment.until if until is None else until} s",
        "coupling": coupling,
        "agents": {"1": {"components": {"model": component}}},
    }
    return planned(json.dumps(tree))


def play(plan: Plan) -> dict[str, np.ndarray]:
    """Per recorded variable, (ticks + 1,) or (ticks + 1, size) values."""
    record = Record()
    inline.run(plan, [record])
    rows, found, at = np.array(record.rows), {}, 0
    for name, port in plan.agents[0].record:
        size = port.variable.size
        values = rows[:, at : at + size]
        found[name.removeprefix("model.")] = values if port.variable.shape else values[:, 0]
        at += size
    return found


def shipped(name: str, version: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The result inside the FMU: time, and the numeric columns."""
    with zipfile.ZipFile(path(name, version)) as archive:
        text = archive.read(f"extra/org.fmi-standard.fmi-ls-ref/{name}_out.csv").decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    columns = {}
    for column in rows[0]:
        if not column.startswith(("String", "Binary")):
            numbers = [{"false": "0", "true": "1"}.get(row[column], row[column]).split() for row in rows]
            columns[column] = (
                np.array(numbers, dtype=float).squeeze(-1) if len(numbers[0]) == 1 else np.array(numbers, float)
            )
    return columns.pop("time"), columns


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize(("name", "version"), CASES)
def test_the_shipped_result(name: str, version: str, coupling: str) -> None:
    experiment = EXPERIMENTS[name]
    settings = dict(COUPLINGS[coupling])
    settings["step"] = experiment.solver_step if "Model" in coupling else experiment.period
    result = play(scenario(name, version, settings))
    time, expected = shipped(name, version)
    compared = [column for column in expected if column in result]
    assert compared == [column for column in result if column in expected]
    assert compared
    for column in compared:
        n = len(result[column])
        assert np.allclose(time[:n], np.arange(n) * time[1])
        if name == "BouncingBall" and "Model" in coupling:  # its events are located, the shipped result's are not
            _, _, _, outside = validate_signal(time[:n], result[column], time, expected[column])
            assert not outside.any()
        else:
            np.testing.assert_allclose(result[column], expected[column][:n], rtol=1e-9, atol=1e-9)


def ball(time: float) -> float:
    """Height of the ball: g = 9.81, e = 0.7, at rest as soon as it would bounce with less than 0.1 m/s."""
    since, speed = time - np.sqrt(2.0 / 9.81), np.sqrt(2.0 * 9.81)
    if since < 0.0:
        return float(1.0 - 0.5 * 9.81 * time**2)
    while (speed := 0.7 * speed) >= 0.1:
        if since < 2.0 * speed / 9.81:
            return float(speed * since - 0.5 * 9.81 * since**2)
        since -= 2.0 * speed / 9.81
    return 0.0


def exact(name: str, times: np.ndarray) -> dict[str, np.ndarray]:
    if name == "BouncingBall":
        return {"h": np.array([ball(time) for time in times])}
    if name == "Dahlquist":
        return {"x": np.exp(-times)}
    if name == "StateSpace":  # x' = x + u, x(0) = 0, y = x + u
        return {"y": np.exp(times)[:, None] * np.array([1.0, 2.0, 3.0])}
    solution = solve_ivp(
        lambda _, x: (x[1], (1.0 - x[0] ** 2) * x[1] - x[0]),
        (0.0, times[-1]),
        (2.0, 0.0),
        "DOP853",
        times,
        rtol=1e-13,
        atol=1e-13,
    )
    return {"x0": solution.y[0], "x1": solution.y[1]}


@pytest.mark.parametrize("integrator", ["rk4", "dormand-prince"])
@pytest.mark.parametrize(
    ("name", "version"), [case for case in CASES if case[0] in {"BouncingBall", "Dahlquist", "StateSpace", "VanDerPol"}]
)
def test_the_exact_solution(name: str, version: str, integrator: str) -> None:
    result = play(scenario(name, version, {"method": "joint", "integrator": integrator}))
    n = len(next(iter(result.values())))
    times = np.linspace(0.0, EXPERIMENTS[name].until, n)
    for column, expected in exact(name, times).items():
        assert np.abs(result[column] - expected).max() < 2e-8 * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize(("name", "version"), [case for case in CASES if case[0] in {"BouncingBall", "VanDerPol"}])
def test_stepped_by_cvode(name: str, version: str) -> None:
    result = play(scenario(name, version, {"method": "jacobi", "step": "10 ms"}, solver="cvode", tolerance=1e-10))
    times = np.linspace(0.0, EXPERIMENTS[name].until, len(next(iter(result.values()))))
    for column, expected in exact(name, times).items():
        assert np.abs(result[column] - expected).max() < 1e-5


STARTS: dict[str, Any] = {
    "Float64_continuous_input": -2.5,
    "Float64_discrete_input": 1e300,
    "Int32_input": -(2**31),
    "Boolean_input": True,
    "String_input": "FMI is awesome!",
    "Enumeration_input": "Option 2",
}
STARTS3: dict[str, Any] = {
    "Float32_continuous_input": 0.25,
    "Float32_discrete_input": -1.0,
    "Int8_input": -128,
    "UInt8_input": 255,
    "Int16_input": -(2**15),
    "UInt16_input": 2**16 - 1,
    "UInt32_input": 2**32 - 1,
    "Int64_input": -(2**63),
    "UInt64_input": 2**53,
    "Binary_input": "626172",
}


@pytest.mark.parametrize("method", ["gauss-seidel", "joint"])
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_values_of_every_type(version: str, method: str) -> None:
    starts = STARTS if version == "2.0" else STARTS | STARTS3
    result = play(scenario("Feedthrough", version, {"method": method}, until=0.2, start=starts))
    numeric = {name: value for name, value in starts.items() if not name.startswith(("String", "Binary"))}
    for name, value in numeric.items():
        expected = 2 if value == "Option 2" else value
        assert set(result[name.replace("input", "output")]) == {expected}


def test_roberts_is_described() -> None:
    """A Boolean structural parameter, event indicators, the layered standard for differential-algebraic equations."""
    description = describe(path("Roberts", "3.0"))
    assert description.n_event_indicators == 2
    assert description.variables["dae"].causality == "structuralParameter"


@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize("coupling", [{"method": "gauss-seidel", "step": "200 ms"}, {"method": "joint"}], ids=str)
def test_stair_asks_for_the_end(version: str, coupling: dict[str, str]) -> None:
    """It terminates the simulation when it counts 10, at 9 s."""
    with pytest.raises(RunEndedError, match=r"at t = (8\.8|9) s: asks to end the simulation"):
        play(scenario("Stair", version, coupling, until=10.0))


def test_scheduled_execution_is_refused() -> None:
    with pytest.raises(ConfigError, match="offers neither Model Exchange nor Co-Simulation"):
        describe(path("Clocks", "3.0"))


@pytest.mark.parametrize(("name", "version"), CASES)
def test_what_wire_writes_is_accepted_without_a_warning(tmp_path: Path, name: str, version: str) -> None:
    text = stub.scenario(str(Path(FOLDER, version, f"{name}.fmu")), "plant", tmp_path)
    (tmp_path / "stub.yaml").write_text(text, encoding="utf-8")
    planned = load(str(tmp_path / "stub.yaml"))
    assert not planned.warnings
    assert planned.plan.agents[0].record
