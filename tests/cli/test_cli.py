"""The command line itself: help, exit codes, problems one per line, no traceback."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cosim import cli
from tests.cli.conftest import ROOT, Cosim
from tests.scenario.scenarios import BASE, FILE, changed


def test_help_names_every_command_and_exit_code(cosim: Cosim) -> None:
    done = cosim("--help")
    assert (done.returncode, done.stderr) == (0, "")
    for word in ("run", "check", "report", "init", "schema", "exit codes:", "130"):
        assert word in done.stdout


@pytest.mark.parametrize("command", ["run", "check", "report", "init", "schema"])
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exited:
        cli.main([command, "--help"])
    assert exited.value.code == 0
    assert "exit codes:" in capsys.readouterr().out


def test_help_asks_in_good_order(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["channel", "--help"])
    assert "what would a controller get?\n" in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom cosim import cli\n"
        "try:\n    cli.main(['run', '--help'])\nexcept SystemExit:\n    pass\n"
        "print([name for name in ('numpy', 'pydantic', 'yaml', 'fmpy', 'zenoh', 'matplotlib', 'pandas', 'pyarrow')"
        " if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    "arguments", [[], ["rnu"], ["run"], ["run", "a", "b"], ["check", "a", "--seed", "x"], ["check", "a", "--sed", "1"]]
)
def test_a_wrong_command_line_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exited:
        cli.main(arguments)
    assert exited.value.code == 2
    assert "error:" in capsys.readouterr().err


def test_version(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda name: {"netcosim": "1.2.3"}[name])
    with pytest.raises(SystemExit) as exited:
        cli.main(["--version"])
    assert exited.value.code == 0
    assert capsys.readouterr().out == "cosim (netcosim 1.2.3)\n"


def test_problems_are_one_a_line_with_their_place_and_a_count(cosim: Cosim, tmp_path: Path) -> None:
    text = changed(
        ("- 1 -> 2", "- 1 -> 22"), ("role: follower", "rol: follower"), ("      weight: controller.weight\n", "")
    )
    (tmp_path / FILE).write_text(text)
    done = cosim("check", FILE)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines() == [
        "net.yaml:10:7: warning: 'controller.weight' is not connected and keeps its start value; a value under 'start' "
        "says that this is meant",
        "net.yaml:12:17: error: no variable 'rol' (did you mean 'role'?)",
        "net.yaml:35:7: error: unknown agent '22' (did you mean '2'?)",
        "2 errors, 1 warning",
    ]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["check", "paper_leadr"], "error: no shipped scenario 'paper_leadr' (did you mean 'paper_leaders'?)"),
        (["check", "gone.yaml"], "gone.yaml: error: no such file"),
        (
            ["run", FILE, "--until", "soon"],
            "--until: error: duration: 'soon' is not a time; write a number with a unit",
        ),
        (["run", FILE, "--until", "10 ms"], "--until: error: the duration 10 ms is no multiple of the period 100 ms"),
        (["run", FILE, "--seed", "-1"], "--seed: error: seed: must be at least 0, not -1"),
        (["run", FILE, "--set", "seed"], "--set seed: error: write --set KEY=VALUE"),
        (
            ["check", FILE, "--set", "coupling.stpe=1"],
            "--set coupling.stpe: error: coupling: unknown key 'stpe' (did you mean",
        ),
        (["init", "x", "--from", "paper"], "error: no shipped scenario 'paper'"),
    ],
)
def test_mistakes_on_the_command_line(
    arguments: list[str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / FILE).write_text(BASE)
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(line)
    assert printed.err.endswith("1 error\n")


def test_ctrl_c_exits_with_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cosim.planning.load", interrupted)
    assert cli.main(["check", "paper_leaders"]) == 130


def test_schema_is_json_and_survives_a_reader_that_leaves(cosim: Cosim) -> None:
    assert "agents" in json.loads(cosim("schema").stdout)["properties"]
    command = f"{sys.executable} -m cosim schema | head -1"
    done = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("{\n", "")


def test_a_copy_of_a_shipped_scenario_has_the_files_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["init", "mine", "--from", "mixed_network"]) == 0
    assert (tmp_path / "traces" / "synthetic_cellular.trace").is_file()
    assert cli.main(["check", "mine.yaml"]) == 0
    assert str(tmp_path / "traces") in capsys.readouterr().out
