"""The conformance kit finds nothing at components that keep to the rules, and the broken rule at those that do not."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest

import fmus
from cosim.cli import main
from cosim.conformance import ConformanceError, Report, Verdict, check
from cosim.errors import ConfigError
from tests.components.probe import description3, write_fmu
from tests.conformance import components


def problems(report: Report) -> dict[str, str]:
    """By check, the sentences about it."""
    return {finding.check: finding.text for finding in report.problems}


@pytest.mark.parametrize("name", ["TwoLinkArm.fmi2", "TwoLinkArm.fmi3", "ArmSyncController.fmi3"])
def test_shipped_fmus(name: str) -> None:
    report = check(fmus.path(name))
    report.require()
    assert {finding.check for finding in report.findings if finding.verdict is Verdict.OK} >= {
        *("description", "initialise", "start values", "run", "determinism", "independence", "reset"),
        *("save and restore", "step splitting", "evaluation", "dependencies", "bad values"),
    }


def test_discrete_inputs_change_too(probes: dict[int, Path]) -> None:
    """The probe refuses them between events; the other one breaks where it gets what it did not begin with."""
    for path in probes.values():
        assert not re.search(r"Set\w+ returned Error", str(check(path)))
    assert "ValueError: there is no light" in problems(check(components.Switched))["run"]


def test_initial_unknowns_are_a_note(tmp_path: Path) -> None:
    """Two of three FMUs have them wrong, whatever tool they are from, and nothing here depends on them."""
    path = tmp_path / "arm.fmu"
    with zipfile.ZipFile(fmus.path("TwoLinkArm.fmi2")) as whole, zipfile.ZipFile(path, "w") as archive:
        for member in whole.infolist():
            content = whole.read(member)
            if member.filename == "modelDescription.xml":
                content = re.sub(rb"<InitialUnknowns>.*</InitialUnknowns>", b"", content, flags=re.DOTALL)
            archive.writestr(member, content)
    report = check(path)
    report.require()
    (found,) = [finding for finding in report.findings if finding.check == "description"]
    assert found.verdict is Verdict.NOTE
    assert "Nothing here depends on that" in found.text


@pytest.mark.parametrize("cls", [components.Lag, components.Ramp, components.Counting])
def test_python_classes_that_keep_to_the_rules(cls: type) -> None:
    report = check(cls)
    report.require()
    assert {"reset", "save and restore"} <= {f.check for f in report.findings if f.verdict is Verdict.OK}


BROKEN = [
    (components.Forgetful, {"step splitting": "y differs by "}),
    (
        components.Shared,
        {
            "determinism": "two runs alike differ: y by ",
            "independence": "y by ",
            "reset": "after a reset it remembers: y by ",
            "save and restore": "what follows a restored state differs: y by",
            "step splitting": "y differs by",
        },
    ),
    (components.Direct, {"dependencies": "y follows u at once, which is not declared among its dependencies"}),
    (components.Remembering, {"evaluation": "derivatives at one point differ by"}),
    (components.Blurting, {"save and restore": "what follows a restored state differs: y by"}),
    (components.Fixed, {"dimensions": "n = 1: IndexError: index 1 is out of bounds"}),
    (
        components.Fragile,
        {"bad values": "crashes its process (SIGABRT); the last line that it printed: what is this?"},
    ),
    (components.Endless, {"bad values": "does not come to an end within 4 s"}),
    (components.Picky, {"initialise": "ValueError: 1 is no good start (components.py, line"}),
]


@pytest.mark.parametrize(("cls", "expected"), BROKEN, ids=lambda x: getattr(x, "__name__", ""))
def test_a_python_class_that_breaks_a_rule(cls: type, expected: dict[str, str]) -> None:
    report = check(cls, deadline=4.0 if cls is components.Endless else 30.0)
    found = problems(report)
    assert found.keys() >= expected.keys()
    for name, sentence in expected.items():
        assert sentence in found[name]
    assert found.keys() == expected.keys()
    with pytest.raises(ConformanceError, match=f"{len(report.problems)} problem"):
        report.require()


def test_what_fails_at_once_is_said_once() -> None:
    report = check(components.Picky)
    assert len(report.problems) == 1
    assert {(f.verdict, f.text) for f in report.findings[1:]} == {(Verdict.SKIPPED, "see initialise")}
    assert len(report.findings) > 8


def test_structural_parameters_are_changed_by_their_type(tmp_path: Path, probe_library: Path) -> None:
    name = 'name="Boolean_in" valueReference="20" causality="'
    text = description3().replace(f'{name}input"', f'{name}structuralParameter" variability="fixed"')
    report = check(write_fmu(tmp_path / "probe.fmu", probe_library, text))
    said = {(f.verdict, f.text) for f in report.findings if f.check == "dimensions"}
    assert said == {(Verdict.OK, "n, Boolean_in can be changed")}


def test_fmus_that_break_rules(probes: dict[int, Path]) -> None:
    """The probe counts its instances in memory that they share, and lacks functions that are not needed otherwise."""
    for fmi, path in probes.items():
        found = problems(check(path))
        assert "two runs alike differ: instances by" in found["determinism"]
        assert "instances by" in found["independence"]
        assert found["reset"].startswith(f"fmi{fmi}Reset returned Error")


def test_one_that_works_once_in_a_process() -> None:
    """What crashes only after others have ended is no fault of the check that was on; the others are still tried."""
    report = check(components.Once)
    text = next(problem.text for problem in report.problems if problem.check == "independence")
    assert text.startswith("crashes its process (SIGABRT), after other instances have ended in it; `isolate: true`")
    accepted = {finding.check for finding in report.findings if finding.verdict is Verdict.OK}
    assert {"initialise", "start values", "run"} <= accepted


def test_one_that_closes_all_descriptors_and_goes_on() -> None:
    """The end of what its process says is not the end of the process."""
    report = check(components.Closing, deadline=2.0)
    assert "closes file descriptors that are not its own, and does not come to an end within 2 s" in str(report)


@pytest.mark.parametrize(
    ("fails", "name", "sentence"),
    [
        ("step_error", "run", "fmi3DoStep returned Error (its last log line: [Error] probe gives up at t = 0)"),
        ("never_settles", "run", "its discrete states did not settle within"),
        ("derivative_nan", "run", "not finite within 20 steps of 0.1 s: x"),
        ("derivative_crashes", "run", "crashes its process (SIGSEGV)"),
        ("derivative_hangs", "run", "does not come to an end within 4 s"),
    ],
)
def test_fmus_that_fail(tmp_path: Path, probe_library: Path, fails: str, name: str, sentence: str) -> None:
    text = description3().replace("<ModelVariables>", '<DefaultExperiment stepSize="0.1"/><ModelVariables>')
    unused = "CoSimulation" if "step" not in fails else "ModelExchange"
    lines = [line for line in text.split("\n") if f"<{unused} " not in line]
    path = write_fmu(tmp_path / "probe.fmu", probe_library, "\n".join(lines))
    report = check(path, start={"fails": fails}, deadline=4.0 if fails == "derivative_hangs" else 30.0)
    assert any(p.check == name and sentence in p.text for p in report.problems), str(report)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own_lag.py").write_text("from tests.conformance.components import Lag as Mine\n")
    assert main(["fmu", "test", "own_lag:Mine", "--start", "u=[1, 2]", "--start", "time_constant=0.2"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("own_lag:Mine: Lag, Python\n\nModel Exchange\n  ok       initialise ")
    assert out.endswith("no problems\n")
    assert main(["fmu", "test", "tests.conformance.components:Direct"]) == 2
    assert "1 problem\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nothing.fmu"], "nothing.fmu: error: no such file"),
        (["no_module:Class"], "there is no Python module 'no_module'"),
        (["TwoLinkArm", "--start", "mass=1"], "has no variable 'mass'"),
        (["TwoLinkArm", "--start", "m1"], "--start m1: write NAME=VALUE"),
    ],
)
def test_what_cannot_be_tried_out(arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmu", "test", *arguments]) == 2
    assert sentence in capsys.readouterr().err


def test_a_class_that_no_other_process_can_find() -> None:
    class Local(components.Ramp):
        pass

    with pytest.raises(ConfigError, match="must lie in a module"):
        check(Local)
