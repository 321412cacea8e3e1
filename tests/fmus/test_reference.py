"""Each FMU alone in FMPy: it is valid, and both interfaces match the reference solution."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu

from tests.fmus.driver import CS, ME
from tests.fmus.reference_solutions import FMUS, SOLUTIONS, START, STOP, T

MODELS = ["TwoLinkArm", "ArmSyncController"]
# The reference solutions' own error is 1e-10; the rest is CVODE's accumulated error and RK4's at 1 ms.
TOLERANCE = {ME: 1e-5, CS: 2e-8}


def reference(model: str) -> tuple[list[str], np.ndarray]:
    path = FMUS / model / "reference.csv"
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    return names, np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.mark.parametrize(("model", "version"), list(itertools.product(MODELS, ("fmi2", "fmi3"))))
def test_fmpy_has_no_finding(built: dict[str, Path], model: str, version: str) -> None:
    path = str(built[f"{model}.{version}"])
    assert validate_fmu(path) == []
    read_model_description(path, validate=True, validate_variable_names=True, validate_model_structure=True)


@pytest.mark.parametrize("model", MODELS)
def test_reference_solution_is_what_its_script_writes(model: str) -> None:
    names, rows = SOLUTIONS[model]()
    written_names, written_rows = reference(model)
    assert names == written_names
    np.testing.assert_allclose(rows, written_rows, rtol=2e-9, atol=2e-10)


def flattened(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """Start values under the names of FMI 2.0's elements; FMI 3.0 takes the arrays."""
    variables = read_model_description(str(path)).modelVariables
    result = {}
    for name, value in values.items():
        elements = [v.name for v in variables if v.name == name or v.name.startswith(f"{name}[")]
        if elements == [name]:
            result[name] = value
        else:
            result.update(zip(elements, value, strict=False))
    return result


@pytest.mark.parametrize(("model", "version", "interface"), list(itertools.product(MODELS, ("fmi2", "fmi3"), (ME, CS))))
def test_alone_in_fmpy(built: dict[str, Path], model: str, version: str, interface: str) -> None:
    names, expected = reference(model)
    path = built[f"{model}.{version}"]
    start = {**flattened(START[model], path), "solver_step": 0.001}
    arrays = list(dict.fromkeys(name.split("[")[0] for name in names[1:]))
    result = simulate_fmu(
        str(path),
        fmi_type=interface,
        start_values=start,
        stop_time=STOP[model],
        output_interval=T,
        relative_tolerance=1e-9,
        output=names[1:] if version == "fmi2" else arrays,
        record_events=False,
    )
    columns = names[1:] if version == "fmi2" else arrays
    values = np.hstack([np.reshape(np.asarray(result[column].tolist()), (len(result), -1)) for column in columns])
    np.testing.assert_allclose(result["time"], expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(values, expected[:, 1:], rtol=TOLERANCE[interface], atol=TOLERANCE[interface])
