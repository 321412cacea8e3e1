"""`cosim fmu inspect`: what it prints of good FMUs and of others."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest

import fmus
from cosim.cli import main
from tests.components.probe import description2, description3, write_fmu
from tests.mapping.foreign import renamed
from tests.scenario.scenarios import changed


def inspected(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["fmu", "inspect", *arguments]) == 0
    return capsys.readouterr().out


def test_a_shipped_one(capsys: pytest.CaptureFixture[str]) -> None:
    out = inspected(capsys, "TwoLinkArm")
    assert out.startswith("TwoLinkArm.fmi3.fmu: TwoLinkArm, FMI 3.0, made by netcosim")
    for part in (
        "Model Exchange, 4 continuous states, 0 event indicators",
        "Co-Simulation: take communication steps of any length, save and restore its state",
        "(this one)",
        "  u[2]         Float64  N.m    0      Joint torques\n",
        "3 local variables more: --all",
        "no problems found",
    ):
        assert part in out
    assert "derivative of p" in inspected(capsys, "TwoLinkArm", "--all")


def test_every_kind_of_variable(probes: dict[int, Path], capsys: pytest.CaptureFixture[str]) -> None:
    for fmi in (2, 3):
        out = inspected(capsys, str(probes[fmi]))
        assert "one of nothing, step_discards" in out
        assert "  label" in out
        assert "Enumeration" in out
    assert "structural parameters\n  n" in out
    assert "made by ProbeTool" in out


def test_what_is_wrong_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = description2().replace('<Real start="1"/>', '<Real start="1" unit="gon"/>')
    out = inspected(capsys, str(write_fmu(tmp_path / "poor.fmu", None, text)))
    assert "platforms   none: it holds no library" in out
    assert "no library for this platform" in out
    assert "units that nothing defines, so that they do not convert: gon" in out
    assert "outputs that may depend directly on every input, as nothing else is declared: instances" in out
    assert "gon" in out.split("problems")[1]


def test_findings_of_the_validation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    renamed(tmp_path / "twice.fmu", {"p[1]": "same", "v[1]": "same"})
    out = inspected(capsys, str(tmp_path / "twice.fmu"))
    assert "problem" in out
    assert "same" in out.split("problem")[1]


def test_only_the_description(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stripped = tmp_path / "secret.fmu"
    assert main(["fmu", "strip", str(fmus.path("TwoLinkArm")), "-o", str(stripped)]) == 0
    assert "only the description of TwoLinkArm.fmi3.fmu" in inspected(capsys, str(stripped))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("TwoLinkArn", "error: no file and no shipped FMU is called 'TwoLinkArn' (did you mean 'TwoLinkArm"),
        ("there.fmu", "there.fmu: error: no such file (did you mean 'text.fmu'?)"),
        ("link.fmu", "link.fmu: error: is a link to nowhere.fmu, which does not exist"),
        ("folder.fmu", "folder.fmu: error: is a folder, not an FMU file"),
        ("unpacked", "unpacked: error: is the folder of an unpacked FMU; zip what is in it: cd 'unpacked' && zip -r"),
        ("text.fmu", "text.fmu is not an FMU: not a ZIP archive"),
        ("old.fmu", "is an FMU of FMI 1.0; export it for FMI 2.0 or 3.0"),
    ],
)
def test_what_is_no_fmu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.fmu").write_text("no")
    Path("link.fmu").symlink_to("nowhere.fmu")
    Path("folder.fmu").mkdir()
    Path("unpacked").mkdir()
    Path("unpacked/modelDescription.xml").write_text("no")
    with zipfile.ZipFile("old.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", '<fmiModelDescription fmiVersion="1.0"/>')
    assert main(["fmu", "inspect", name]) == 2
    assert sentence in capsys.readouterr().err


def test_a_shipped_one_beside_a_folder_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("TwoLinkArm").mkdir()
    assert "TwoLinkArm" in inspected(capsys, "TwoLinkArm")


@pytest.mark.parametrize("step", ["INF", "1e300", "NaN", "-1"])
def test_steps_that_nobody_can_make(tmp_path: Path, capsys: pytest.CaptureFixture[str], step: str) -> None:
    """They were the end of `cosim check`, in a traceback."""
    plain = '<CoSimulation modelIdentifier="probe" canHandleVariableCommunicationStepSize="true"/>'
    fixed = f'<CoSimulation modelIdentifier="probe" fixedInternalStepSize="{step}"/>'
    text = changed(
        (plain, fixed),
        ("<TypeDefinitions>", f'<DefaultExperiment stepSize="{step}"/><TypeDefinitions>'),
        text=description3(),
    )
    path = write_fmu(tmp_path / "x.fmu", None, text)
    output = inspected(capsys, str(path))
    assert f"  a fixedInternalStepSize of {step} s, which is ignored" in output
    assert f"  a default experiment with steps of {step} s, which is ignored" in output


def test_findings_that_are_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Once, with their places; tools make the same mistake at every variable."""
    text = description2().replace("<Real ", '<Real colour="red" ').replace("><", ">\n<")
    output = inspected(capsys, str(write_fmu(tmp_path / "x.fmu", None, text)))
    (line,) = [line for line in output.splitlines() if "'colour'" in line]
    assert re.fullmatch(r"  lines \d+, \d+, \d+ and \d+ more: Element 'Real', attribute 'colour': .*", line)


def test_names_of_variables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the naming convention; thousands of them, as tools write, within a moment."""
    good = ["a.b[1,2].c", "der(x.y)", "der(x,2)", "'any thing[{'.b", "_1"]
    bad = ["1a", "a..b", "a[1", "der(x", "a b", "'x", "a[x]"]
    names = [*good, *bad, *(f"part{i}.flange.phi[{i}]" for i in range(5000))]
    scalars = "".join(
        f'<ScalarVariable name="{name}" valueReference="{1000 + i}"><Real/></ScalarVariable>\n'
        for i, name in enumerate(names)
    )
    text = description2().replace("</ModelVariables>", f"{scalars}</ModelVariables>")
    path = tmp_path / "x.fmu"
    write_fmu(
        path, None, text.replace("<fmiModelDescription", '<fmiModelDescription variableNamingConvention="structured"')
    )
    lines = [line for line in inspected(capsys, str(path)).splitlines() if "is not named by" in line]
    assert [line.split('"')[1] for line in lines] == bad
    write_fmu(path, None, text)
    assert "is not named by" not in inspected(capsys, str(path))
