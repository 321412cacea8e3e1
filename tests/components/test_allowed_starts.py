"""Which start values an FMU allows: by `initial`, also of resized arrays and of elements; through the command line."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

import fmus
from cosim import results
from cosim.cli import main
from tests.scenario.scenarios import changed

POSITIONS = {
    "DoubleIntegrator.fmi3": ('description="Positions" start="0.0"', 'description="Positions" start="1.0 2.0"'),
    "DoubleIntegrator.fmi2": (
        'name="p[2]" valueReference="1025" causality="output" variability="continuous" initial="exact" '
        'description="Positions">\n      <Real start="0.0" />',
        'name="p[2]" valueReference="1025" causality="output" variability="continuous" initial="calculated" '
        'description="Positions">\n      <Real />',
    ),
}
"""A state whose start values are not alike, and one that computes some of its elements."""


def edited(path: Path, fmu: str, *changes: tuple[str, str]) -> Path:
    """A shipped FMU whose description says something else."""
    with zipfile.ZipFile(fmus.path(fmu)) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                content = changed(*changes, text=content.decode()).encode()
            target.writestr(name, content)
    return path


def scenario(component: str, record: str = "p") -> str:
    return f"""\
period: 100 ms
duration: 200 ms
agents:
  one:
    components:
      plant: {{fmu: plant.fmu, {component}}}
    record: [plant.{record}]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder from here on."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def started(component: str, record: str = "p") -> list[float]:
    """What the plant starts from."""
    Path("net.yaml").write_text(scenario(component, record), encoding="utf-8")
    first, again = (f"{record}-{number}-{len(component)}" for number in (1, 2))
    assert main(["run", "net.yaml", "--out", first, "--no-report"]) == 0
    assert main(["run", f"{first}/scenario.yaml", "--out", again, "--no-report"]) == 0
    assert results.load(again).manifest["digest"] == results.load(first).manifest["digest"]
    return [float(x) for x in results.load(first).array(f"plant.{record}")[0].reshape(-1)]


def refused(capsys: pytest.CaptureFixture[str], component: str) -> str:
    """What is wrong with the component; the place is checked by the caller."""
    Path("net.yaml").write_text(scenario(component), encoding="utf-8")
    assert main(["check", "net.yaml"]) == 2
    return capsys.readouterr().err


def test_a_state_of_another_size_takes_a_start_value(folder: Path) -> None:
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi3", POSITIONS["DoubleIntegrator.fmi3"])
    assert started("start: {n_axes: 3, p: [4, 5, 6], v: 0, u: 0}") == [4, 5, 6]


def test_a_part_of_an_array_of_another_size_takes_none_by_itself(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi3", POSITIONS["DoubleIntegrator.fmi3"])
    said = refused(capsys, 'outputs: {q: "p[2]"}, start: {n_axes: 3, q: 4, v: 0, u: 0}')
    assert "net.yaml:6:75: error: 'q' is a part of 'p', which has 3 numbers, and nothing says what the others" in said
    assert started('outputs: {q: ["p[3]", "p[1]", "p[2]"]}, start: {n_axes: 3, q: [4, 5, 6], v: 0, u: 0}', "q") == [
        4,
        5,
        6,
    ]


def test_elements_that_are_not_computed_take_start_values(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi2", POSITIONS["DoubleIntegrator.fmi2"])
    said = refused(capsys, "start: {n_axes: 2, p: [4, 5, 6, 7], v: 0, u: 0}")
    assert "error: 'p' is computed in part, and takes no start value as a whole; 'p[1]' does" in said
    said = refused(capsys, 'start: {n_axes: 2, "p[2]": 4, v: 0, u: 0}')
    assert "net.yaml:6:58: error: 'p[2]' is computed; it takes no start value" in said
    said = refused(capsys, 'start: {n_axes: 2, "p[5]": 4, v: 0, u: 0}')
    assert "error: no variable 'p[5]'" in said
    assert started('start: {n_axes: 2, "p[1]": 4, v: 0, u: 0}') == [4, 0, 0, 0]
    assert started('outputs: {q: ["p[1]", "p[3]"]}, start: {n_axes: 3, q: [4, 5], v: 0, u: 0}', "q") == [4, 5]


def test_an_element_may_start_otherwise_than_its_array(folder: Path) -> None:
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi2")
    assert started('start: {"p[2]": 9, p: 4, v: 0, u: 0, n_axes: 4}') == [4, 9, 4, 4]
