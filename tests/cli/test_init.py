"""`cosim init`: a copy of a shipped scenario that is the user's own."""

from pathlib import Path

import pytest

from cosim import cli
from cosim.planning import load
from cosim.scenario import configs
from tests.cli.conftest import Cosim


def test_a_copy_runs_under_its_own_name(cosim: Cosim, tmp_path: Path) -> None:
    done = cosim("init", "mine")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "wrote mine.yaml, a copy of paper_leaders; next: cosim check mine.yaml\n"
    plan = load(str(tmp_path / "mine.yaml")).plan
    assert plan.name == "mine"
    assert plan.agents[0].components[0].start == load("paper_leaders").plan.agents[0].components[0].start
    checked = cosim("check", "mine", "--set", "coupling.loop=python")
    assert checked.stdout.startswith("mine: Ten arms, leaders 1 and 4\n")


@pytest.mark.parametrize("name", configs.names())
def test_every_shipped_scenario_can_be_copied(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["init", "sub.yaml", "--from", name]) == 0
    original = configs.shipped(name).read_text(encoding="utf-8").splitlines()
    changed = [
        pair for pair in zip(original, Path("sub.yaml").read_text().splitlines(), strict=True) if len(set(pair)) > 1
    ]
    assert changed == [(f"name: {name}", "name: sub")]


def test_nothing_is_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text("precious")
    assert cli.main(["init", "mine"]) == 2
    assert capsys.readouterr().err == "mine.yaml: error: exists already; choose another name or remove it\n1 error\n"
    assert Path("mine.yaml").read_text() == "precious"


def test_a_folder_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["init", "gone/mine"]) == 2
    assert "gone/mine.yaml: error: cannot be written: No such file or directory" in capsys.readouterr().err


def test_a_name_that_no_scenario_can_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["init", "my: arms"]) == 2
    assert "error: 'my: arms' cannot name a scenario" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
