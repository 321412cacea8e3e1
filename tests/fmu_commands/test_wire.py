"""`cosim fmu wire`: what it guesses, and that `cosim check` accepts what it writes."""

from __future__ import annotations

from pathlib import Path

import pytest

import fmus
from cosim.cli import main
from cosim.components.fmu import describe
from cosim.fmu_commands.guessing import guess
from cosim.planning import load
from tests.components.probe import write_fmu
from tests.mapping.foreign import renamed


def description(*variables: str) -> str:
    """An FMI 2.0 description: `name causality unit derivative-of`, any of the last two '-'."""
    rows = [text.split() for text in variables]
    names = [row[0] for row in rows]
    scalars, outputs = [], []
    for number, (name, causality, unit, of) in enumerate(rows, 1):
        derivative = f' derivative="{names.index(of) + 1}"' if of != "-" else ""
        start = ' start="0"' if causality == "input" else ""
        real = f"<Real{f' unit={unit!r}' if unit != '-' else ''}{derivative}{start}/>".replace("'", '"')
        scalars.append(
            f'<ScalarVariable name="{name}" valueReference="{number}" causality="{causality}">{real}</ScalarVariable>'
        )
        if causality == "output":
            outputs.append(f'<Unknown index="{number}"/>')
    return (
        '<fmiModelDescription fmiVersion="2.0" modelName="M" guid="probe">'
        '<CoSimulation modelIdentifier="probe" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{''.join(scalars)}</ModelVariables>"
        f"<ModelStructure><Outputs>{''.join(outputs)}</Outputs></ModelStructure></fmiModelDescription>"
    )


GUESSES = {
    "units": (
        ["a input N -", "b input V -", "c output mm -", "d output mm/s -"],
        (["a"], ["c"], ["d"]),
    ),
    "derivatives, whatever they are called": (
        ["drive input N.m -", "one output - -", "two output - -", "s1 output - -", "s2 output - -"],
        (["drive"], ["s1", "s2"], []),
    ),
    "derivatives": (
        ["f input - -", "q1 output - -", "q2 output - -", "b output - q2", "a output - q1"],
        (["f"], ["q1", "q2"], ["a", "b"]),
    ),
    "outputs before what is behind them": (
        ["h output m -", "h_ft output ft -", "v output m/s -", "der(h) local m/s h"],
        ([], ["h"], ["v"]),
    ),
    "names": (
        ["tau_1 input - -", "tau_2 input - -", "q1 output - -", "q2 output - -", "qd2 output - -", "qd1 output - -"],
        (["tau_1", "tau_2"], ["q1", "q2"], ["qd1", "qd2"]),
    ),
    "names with dots": (
        ["motor.torque input - -", "load.phi output rad -", "load.w output rad/s -", "load.a output rad/s2 -"],
        (["motor.torque"], ["load.phi"], ["load.w"]),
    ),
    "local variables where no output will do": (
        ["u input - -", "energy output J -", "x local m -", "v local m/s x"],
        (["u"], ["x"], ["v"]),
    ),
    "coordinates": (
        ["x output - -", "y output - -", "d_x output - -", "d_y output - -"],
        ([], ["x", "y"], ["d_x", "d_y"]),
    ),
    "what a block gives is no coordinate": (["u input - -", "y output - -", "X output - -"], (["u"], [], [])),
    "local variables by their names alone": (["a input - -", "pump.p local - -", "pump.phi local - -"], ([], [], [])),
    "nothing": (["level input - -", "alarm output - -"], ([], [], [])),
}


@pytest.mark.parametrize("name", GUESSES)
def test_guesses(tmp_path: Path, probe_library: Path, name: str) -> None:
    variables, expected = GUESSES[name]
    path = write_fmu(tmp_path / "any.fmu", probe_library, description(*variables))
    found = guess(describe(path))
    assert tuple([v.name for v in kind] for kind in (found.force, found.position, found.velocity)) == expected
    assert main(["fmu", "wire", str(path), "-o", str(tmp_path / "any.yaml")]) == 0
    assert main(["check", str(tmp_path / "any.yaml")]) == 0


@pytest.mark.parametrize("name", fmus.names())
def test_what_is_written_for_a_shipped_fmu_can_be_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    role = "controller" if "Controller" in name else "plant"
    assert main(["fmu", "wire", name, "--role", role]) == 0
    Path("stub.yaml").write_text(capsys.readouterr().out)
    assert main(["run", "stub.yaml", "--until", "100 ms", "--no-report", "--quiet"]) == 0


def test_arrays_and_units_of_the_arm() -> None:
    for name in ("TwoLinkArm", "TwoLinkArm.fmi2"):
        found = guess(describe(fmus.path(name)))
        assert [[v.name for v in kind] for kind in (found.force, found.position, found.velocity)] == [
            ["u"],
            ["p"],
            ["v"],
        ]


def test_the_written_file_maps_and_names_the_fmu_from_where_it_lies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "fmus").mkdir()
    (tmp_path / "scenarios").mkdir()
    renamed(tmp_path / "fmus" / "other arm.fmu")
    out = tmp_path / "scenarios" / "arm.yaml"
    assert main(["fmu", "wire", str(tmp_path / "fmus" / "other arm.fmu"), "--role", "arm", "-o", str(out)]) == 0
    text = out.read_text()
    for line in (
        "fmu: ../fmus/other arm.fmu",
        "u: [tau_shoulder, tau_elbow]  # N.m",
        "p: [q1, q2]  # rad",
        "v: [qd1, qd2]  # rad/s",
        "publish: {p: arm.p, v: arm.v}",
        "#   m1: 1.0  # kg; Mass of link 1",
    ):
        assert line in text
    assert main(["check", str(out)]) == 0
    capsys.readouterr()
    assert main(["fmu", "wire", str(tmp_path / "fmus" / "other arm.fmu"), "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_what_a_usual_name_hides_is_mapped_as_well(tmp_path: Path, probe_library: Path) -> None:
    rows = ["u input V -", "F input N -", "x output m -", "v output V -", "der(x) local m/s x", "p input K -"]
    path = write_fmu(tmp_path / "motor.fmu", probe_library, description(*rows))
    assert main(["fmu", "wire", str(path), "-o", str(tmp_path / "motor.yaml")]) == 0
    text = (tmp_path / "motor.yaml").read_text()
    for line in ("u: F  # N", "own_u: u  # V", "own_p: p  # K", "p: x  # m", "v: der(x)  # m/s", "own_v: v  # V"):
        assert f"          {line}\n" in text
    assert "publish: {p: plant.p, v: plant.v}" in text
    planned = load(str(tmp_path / "motor.yaml"))
    assert [name for name, _ in planned.plan.agents[0].record] == ["plant.p", "plant.v", "plant.own_v"]


def test_local_variables_are_recorded_where_there_is_no_output(tmp_path: Path, probe_library: Path) -> None:
    path = write_fmu(tmp_path / "closed.fmu", probe_library, description("level local - -", "temperature local K -"))
    assert main(["fmu", "wire", str(path), "-o", str(tmp_path / "closed.yaml")]) == 0
    planned = load(str(tmp_path / "closed.yaml"))
    assert [name for name, _ in planned.plan.agents[0].record] == ["plant.level", "plant.temperature"]


def test_the_period_consists_of_the_steps_that_an_fmu_insists_on(tmp_path: Path, probe_library: Path) -> None:
    text = description("y output - -").replace('StepSize="true"/>', 'StepSize="false"/>')
    text = text.replace("<ModelVariables>", '<DefaultExperiment stepSize="0.03"/><ModelVariables>')
    path = write_fmu(tmp_path / "fixed.fmu", probe_library, text)
    assert main(["fmu", "wire", str(path), "-o", str(tmp_path / "fixed.yaml")]) == 0
    planned = load(str(tmp_path / "fixed.yaml"))
    assert planned.plan.period_ns == 120_000_000
    assert planned.plan.agents[0].coupling.step_ns == 30_000_000


def test_a_role_that_can_name_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmu", "wire", "TwoLinkArm", "--role", "my plant"]) == 2
    assert "--role: 'my plant' cannot name a component" in capsys.readouterr().err
