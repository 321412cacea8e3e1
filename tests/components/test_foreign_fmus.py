"""FMUs of any tool, through the command line and through FMPy: the same numbers.

Skipped unless NETCOSIM_FMUS names a folder; every `*.fmu` in it and below is tried (docs/fmi.md). Each runs in
processes of its own, as it may crash. In Co-Simulation, stepped at the same points, both must give the same bits; in
Model Exchange netcosim's Dormand-Prince and FMPy's CVODE must agree as the rules of the FMI Cross-Check want it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.util import validate_signal

from cosim import results
from cosim.components.component import Description, Interface
from cosim.components.fmu import describe
from cosim.errors import ConfigError
from tests.components.misbehaving import cosim

FOLDER = os.environ.get("NETCOSIM_FMUS", "")
FILES = sorted(Path(FOLDER).rglob("*.fmu")) if FOLDER else []
pytestmark = pytest.mark.skipif(not FOLDER, reason="NETCOSIM_FMUS names no folder (docs/fmi.md)")

TICKS, PARTS = 20, 5
STEP_NS = 10_000_000

STEPPED = """
import json, sys, fmpy
path, step, parts, ticks, *names = json.loads(sys.argv[1])
model = fmpy.read_model_description(path, validate=False)
folder = fmpy.extract(path)
arguments = dict(guid=model.guid, unzipDirectory=folder, modelIdentifier=model.coSimulation.modelIdentifier)
stop = ticks * parts * step / 1e9
experiment = model.defaultExperiment
tolerance = float(experiment.tolerance) if experiment is not None and experiment.tolerance else None
references = [next(v for v in model.modelVariables if v.name == name).valueReference for name in names]
if model.fmiVersion == "2.0":
    from fmpy.fmi2 import FMU2Slave
    fmu = FMU2Slave(instanceName="fmu", **arguments)
    fmu.instantiate()
    fmu.setupExperiment(tolerance=tolerance, startTime=0.0, stopTime=stop)
    fmu.enterInitializationMode()
    read = fmu.getReal
else:
    from fmpy.fmi3 import FMU3Slave
    fmu = FMU3Slave(instanceName="fmu", **arguments)
    fmu.instantiate()
    fmu.enterInitializationMode(tolerance=tolerance, startTime=0.0, stopTime=stop)
    read = fmu.getFloat64
fmu.exitInitializationMode()
rows = [list(read(references))]
for tick in range(ticks):
    for part in range(parts):
        fmu.doStep(tick * parts * step / 1e9 + part * (step / 1e9), step / 1e9)
    rows.append(list(read(references)))
print("\\n" + json.dumps(rows))
"""
SOLVED = """
import json, sys, fmpy
path, step, parts, ticks, *names = json.loads(sys.argv[1])
found = fmpy.simulate_fmu(
    path, validate=False, stop_time=ticks * parts * step / 1e9, output_interval=step / 1e9, solver="CVode",
    relative_tolerance=1e-8, fmi_type="ModelExchange", output=names,
)
print("\\n" + json.dumps([found["time"].tolist(), *(found[name].tolist() for name in names)]))
"""


def described(path: Path, interface: Interface) -> tuple[Description, list[str]]:
    """The FMU, and which of its variables are compared: numbers that it gives, else some that it has inside."""
    try:
        description = describe(path)
    except ConfigError as error:
        pytest.skip(error.problems[0].message)
    if interface not in description.interfaces:
        pytest.skip(f"does not offer {interface}")
    floats = [v for v in description.variables.values() if v.dtype == "Float64" and not v.shape]
    names = [v.name for v in floats if v.causality == "output"] or [v.name for v in floats if v.causality == "local"]
    if not names:
        pytest.skip("has no numbers to compare")
    return description, names[:40]


def in_fmpy(script: str, path: Path, names: list[str]) -> Any:
    request = json.dumps([str(path.absolute()), STEP_NS, PARTS, TICKS, *names])
    done = subprocess.run(
        [sys.executable, "-c", script, request], capture_output=True, text=True, timeout=100, check=False
    )
    if done.returncode:
        pytest.skip(f"FMPy fails: {(done.stderr.strip().splitlines() or ['it crashed'])[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def in_netcosim(path: Path, folder: Path, names: list[str], coupling: dict[str, str]) -> tuple[Any, np.ndarray]:
    """Times, and (ticks + 1, names) values."""
    tree = {
        "period": f"{PARTS * STEP_NS} ns",
        "duration": f"{TICKS * PARTS * STEP_NS} ns",
        "agents": {
            "one": {"components": {"fmu": {"fmu": str(path.absolute())}}, "record": [f"fmu.{name}" for name in names]}
        },
        "coupling": {**coupling, "step": f"{STEP_NS} ns"},
    }
    done = cosim(folder, "run", "net.yaml", "--out", "out", "--no-report", text=json.dumps(tree))
    assert done.returncode == 0, done.stderr
    table = results.load(folder / "out").trajectories
    return table["time"].to_numpy(), table[[f"fmu.{name}" for name in names]].to_numpy(float)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(FOLDER)))
def test_co_simulation_gives_the_bits_that_fmpy_gets(path: Path, tmp_path: Path) -> None:
    description, names = described(path, Interface.CO_SIMULATION)
    if not description.variable_step or description.internal_step is not None:
        pytest.skip("takes steps of one length only")
    expected = np.array(in_fmpy(STEPPED, path, names))
    _, found = in_netcosim(path, tmp_path, names, {"method": "gauss-seidel"})
    if not np.array_equal(found, expected):  # some give the processor time that they took, which is another every time
        alike = (np.array(in_fmpy(STEPPED, path, names)) == expected).all(axis=0)
        found, expected = found[:, alike], expected[:, alike]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(FOLDER)))
def test_model_exchange_agrees_with_cvode(path: Path, tmp_path: Path) -> None:
    _, names = described(path, Interface.MODEL_EXCHANGE)
    time, *expected = in_fmpy(SOLVED, path, names)
    times, found = in_netcosim(path, tmp_path, names, {"method": "joint", "integrator": "dormand-prince"})
    for name, column, values in zip(names, found.T, expected, strict=True):
        if np.isfinite(values).all() and np.ptp(values) > 0.0:
            *_, outside = validate_signal(times, column, np.array(time), np.array(values))
            assert not outside.any(), name
