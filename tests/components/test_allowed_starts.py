"""Which start values an FMU allows: by `initial`, also of resized arrays and of elements; through the command line."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

import fmus
from cosim import results
from cosim.cli import main
from tests.scenario.scenarios import changed, errors, marked

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


# --- min and max ------------------------------------------------------------------------------------------------------
NARROW = ('description="Positions" start="0.0"', 'description="Positions" min="-1" max="1" start="0.0"')


PYTHON = """\
from cosim.components.python import Output, PythonComponent, Structural

class Large(PythonComponent):
    n = Structural(1)
    y = Output(shape=("n",))
"""


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ("n_axes: 0", "'n_axes' is 0, below its min, 1"),
        ("n_axes: 9", "'n_axes' is 9, above its max, 8"),
    ],
)
def test_structural_parameters_keep_their_limits(
    folder: Path, capsys: pytest.CaptureFixture[str], sizes: str, said: str
) -> None:
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi3", ('min="1" start="1"', 'min="1" max="8" start="1"'))
    assert refused(capsys, f"start: {{{sizes}, u: 0}}") == f"net.yaml:6:47: error: {said}\n1 error\n"


def test_the_number_of_neighbours_keeps_its_limits(folder: Path) -> None:
    at_most = ('min="0" start="1"', 'min="0" max="1" start="1"')
    edited(folder / "controller.fmu", "ArmSyncController.fmi3", at_most)
    text, place = marked(changed(("fmu: ArmSync", "fmu: controller.fmu # "), ("count: con", "count: §con")))
    (found,) = errors(folder, text)
    assert str(found.where) == place
    said = "an agent here hears 2 others: 'controller.n_neighbours' would be above its max, 1"
    assert found.message == said


def test_arrays_beyond_measure_are_refused_before_they_are_made(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That was a MemoryError, or the end of the process."""
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi3")
    said = refused(capsys, "start: {n_axes: 300000000}")
    assert "net.yaml:6:47: error: plant.fmu cannot be described: 'u' would hold 300,000,000 numbers" in said
    Path("large.py").write_text(PYTHON, encoding="utf-8")
    Path("net.yaml").write_text(scenario("start: {n: 300000000}").replace("fmu: plant.fmu", 'python: "large:Large"'))
    assert main(["check", "net.yaml"]) == 2
    assert (
        "net.yaml:6:49: error: large:Large declares a variable that cannot be: 'y' would hold"
        in capsys.readouterr().err
    )
    size = ('description="Number of axes" min="1" start="1"', 'description="Number of axes" start="3000000000"')
    edited(folder / "large.fmu", "DoubleIntegrator.fmi3", size)
    assert main(["fmu", "inspect", "large.fmu"]) == 2
    assert "'u' would hold 3,000,000,000 numbers" in capsys.readouterr().err


def test_a_start_value_outside_of_the_limits_is_a_warning(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The FMU may refuse it, or have a reason to allow it (FMI 2.0.5, section 2.2.7)."""
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi3", NARROW)
    for start, said in (
        ("[0, 1.5]", "6:65: warning: 'p[2]' starts at 1.5, above its max, 1: what the component"),
        ("{uniform: [-3, -2]}", "below its min, -1 in agent 'one': what"),
        ("[1, -1]", ""),
    ):
        Path("net.yaml").write_text(scenario(f"start: {{n_axes: 2, u: 0, v: 0, p: {start}}}"), encoding="utf-8")
        assert main(["check", "net.yaml"]) == 0
        heard = capsys.readouterr().err
        assert said in heard
        assert heard.count("warning:") == bool(said)


def test_limits_hold_for_what_the_component_gets(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Through a gain, as the scenario's values are not those of the component."""
    edited(folder / "plant.fmu", "DoubleIntegrator.fmi3", NARROW)
    for start, warned in (("[30, -90]", 0), ("[30, 101]", 1)):
        mapped = f"outputs: {{cm: {{from: p, gain: 100}}}}, start: {{n_axes: 2, u: 0, v: 0, cm: {start}}}"
        Path("net.yaml").write_text(scenario(mapped, "cm"), encoding="utf-8")
        assert main(["check", "net.yaml"]) == 0
        assert capsys.readouterr().err.count("'cm[2]' starts at 1.01, above its max, 1") == warned


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_that_breaks_its_own_limits(folder: Path, capsys: pytest.CaptureFixture[str], fmi: int) -> None:
    change = ('<Integer min="1" max="4" start="1" />', '<Integer min="2" max="4" start="1" />')
    odd = ('unit="s" start="0.005"', 'unit="s" min="1" max="0" start="0.005"')
    unsigned = ('min="1" start="1"', 'min="2" start="1"')
    edited(folder / "plant.fmu", f"DoubleIntegrator.fmi{fmi}", change if fmi == 2 else unsigned, odd)
    assert main(["fmu", "inspect", "plant.fmu"]) == 0
    said = capsys.readouterr().out
    assert '  "n_axes" starts at 1, below its min, 2\n' in said
    assert '  "solver_step" has a min of 1, which is above its max, 0\n' in said
    assert main(["fmu", "test", "plant.fmu"]) == 2
    said = capsys.readouterr().out
    assert 'problem  description        "n_axes" starts at 1, below its min, 2\n' in said
    assert "dimensions         n_axes" in said or fmi == 2
