"""Each FMU alone in FMPy: it is valid, and both interfaces match the reference solution."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu

from fmus.description import load
from tests.fmus.driver import CS, ME
from tests.fmus.reference_solutions import FMUS, SOLUTIONS, START, STOP, T

MODELS = list(SOLUTIONS)
# The reference solutions' own error is 1e-10; the rest is CVODE's accumulated error and RK4's at 1 ms.
TOLERANCE = {ME: 1e-5, CS: 2e-8}


def reference(model: str) -> tuple[list[str], np.ndarray]:
    names, *rows = csv.reader((FMUS / model / "reference.csv").read_text(encoding="utf-8").splitlines())
    return names, np.array(rows, dtype=np.float64)


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
    """Start values under the names of FMI 2.0's elements.

    Of an array of more columns than are used, the first row is given.
    """
    variables = read_model_description(str(path)).modelVariables
    result = {}
    for name, value in values.items():
        elements = [v.name for v in variables if v.name == name or v.name.startswith(f"{name}[")]
        if elements == [name]:
            result[name] = value
        else:
            result.update(zip(elements, value, strict=False))
    return result


def first_axis(model: str, values: dict[str, Any], names: list[str]) -> tuple[dict[str, Any], list[int]]:
    """Start values of one axis, for FMPy cannot set FMI 3.0's structural parameters; and the columns of that axis."""
    described = load(FMUS / model / "model.toml")

    def place(name: str) -> int | None:
        shape = described.named(name).shape
        return shape.index("n_axes") if "n_axes" in shape else None

    start = {name: value if place(name) is None else value[:1] for name, value in values.items() if name != "n_axes"}
    subscripts = {name: name[:-1].partition("[")[::2] for name in names[1:]}
    kept = [
        column
        for column, (array, subscript) in enumerate(subscripts.values(), 1)
        if place(array) is None or subscript.split(",")[place(array) or 0] == "1"
    ]
    return start, kept


@pytest.mark.parametrize(("model", "version", "interface"), list(itertools.product(MODELS, ("fmi2", "fmi3"), (ME, CS))))
def test_alone_in_fmpy(built: dict[str, Path], model: str, version: str, interface: str) -> None:
    names, expected = reference(model)
    path = built[f"{model}.{version}"]
    start, columns = START[model], list(range(1, len(names)))
    if version == "fmi2":
        start = flattened(start, path)
    else:
        start, columns = first_axis(model, start, names)
    if load(FMUS / model / "model.toml").states:
        start["solver_step"] = 0.001
    arrays = list(dict.fromkeys(name.split("[")[0] for name in names[1:]))
    outputs = names[1:] if version == "fmi2" else arrays
    result = simulate_fmu(
        str(path),
        fmi_type=interface,
        start_values=start,
        stop_time=STOP,
        output_interval=T,
        relative_tolerance=1e-9,
        output=outputs,
        record_events=False,
    )
    values = np.hstack([np.reshape(np.asarray(result[output].tolist()), (len(result), -1)) for output in outputs])
    np.testing.assert_allclose(result["time"], expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(values, expected[:, columns], rtol=TOLERANCE[interface], atol=TOLERANCE[interface])
