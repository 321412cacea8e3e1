"""FMU files that hold only the description: what they say, and that they are never run."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

import fmus
from cosim.components.component import Interface
from cosim.components.fmu import describe, open_fmu
from cosim.components.fmu.archive import ORIGINAL
from cosim.components.fmu.stripping import strip
from cosim.errors import ConfigError
from tests.cli.conftest import Cosim, cosim
from tests.scenario.scenarios import BASE, changed

__all__ = ["cosim"]


@pytest.mark.parametrize("name", ["ArmSyncController.fmi2", "ArmSyncController.fmi3"])
def test_it_is_described_as_the_original_is(name: str, tmp_path: Path) -> None:
    stripped = tmp_path / "stripped.fmu"
    stripped.write_bytes(strip(fmus.path(name)))
    for structural in ({}, {"n_neighbours": 3}):
        original = describe(fmus.path(name), structural)
        assert describe(stripped, structural) == replace(original, whole=False)
    with zipfile.ZipFile(stripped) as archive:
        assert archive.namelist() == ["modelDescription.xml", ORIGINAL]


def test_the_same_file_gives_the_same_bytes_also_from_a_stripped_one(tmp_path: Path) -> None:
    stripped = tmp_path / "stripped.fmu"
    stripped.write_bytes(strip(fmus.path("TwoLinkArm")))
    assert strip(fmus.path("TwoLinkArm")) == stripped.read_bytes() == strip(stripped)


def test_it_is_not_run(tmp_path: Path) -> None:
    stripped = tmp_path / "stripped.fmu"
    stripped.write_bytes(strip(fmus.path("TwoLinkArm")))
    with pytest.raises(ConfigError, match=r"holds only the description of TwoLinkArm\.fmi3\.fmu; running it takes"):
        open_fmu("plant", stripped, Interface.MODEL_EXCHANGE, describe(stripped))


def test_a_whole_fmu_that_says_it_is_another_is_none(tmp_path: Path) -> None:
    path = tmp_path / "both.fmu"
    path.write_bytes(fmus.path("TwoLinkArm").read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(ORIGINAL, '{"sha256": "' + "ab" * 32 + '", "name": "../other.fmu"}')
    description = describe(path)
    assert description.sha256 == "ab" * 32
    assert not description.whole
    with pytest.raises(ConfigError, match=r"only the description of other\.fmu"):
        open_fmu("plant", path, Interface.MODEL_EXCHANGE, description)


@pytest.mark.parametrize("said", ["", "[]", "{}", '{"sha256": "x"}'])
def test_broken_word_on_the_original(said: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.fmu"
    path.write_bytes(fmus.path("TwoLinkArm").read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(ORIGINAL, said)
    with pytest.raises(ConfigError, match=f"has a broken {ORIGINAL}"):
        describe(path)


# --- on the command line ----------------------------------------------------------------------------------------------
def test_the_command_and_what_check_and_run_say(cosim: Cosim, tmp_path: Path) -> None:
    arm = tmp_path / "arm.fmu"
    arm.write_bytes(fmus.path("TwoLinkArm").read_bytes())
    done = cosim("fmu", "strip", "arm.fmu")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "wrote arm.description.fmu: what arm.fmu says of itself, and its SHA-256\n"
    arm.unlink()
    (tmp_path / "net.yaml").write_text(changed(("fmu: TwoLinkArm\n", "fmu: arm.description.fmu\n"), text=BASE))
    where = tmp_path / "arm.description.fmu"
    said = "holds only the description of an FMU, which agents 1..3 need"

    checked = cosim("check", "net.yaml")
    assert checked.returncode == 0, checked.stderr
    assert f"{where}: warning: {said}" in checked.stderr
    for how in ([], ["--distributed"]):
        ran = cosim("run", "net.yaml", *how)
        assert ran.returncode == 2
        assert f"{where}: error: {said}" in ran.stderr
        assert not (tmp_path / "runs").exists()


def test_what_cannot_be_stripped(cosim: Cosim, tmp_path: Path) -> None:
    (tmp_path / "arm.fmu").write_bytes(fmus.path("TwoLinkArm").read_bytes())
    (tmp_path / "none.fmu").write_text("no FMU")
    assert cosim("fmu", "strip", "arm.fmu", "-o", "out.fmu").returncode == 0
    digest = hashlib.sha256((tmp_path / "out.fmu").read_bytes()).hexdigest()
    for arguments, sentence in (
        (["arm.fmu", "-o", "out.fmu"], "out.fmu: error: out.fmu exists already"),
        (["arm.fmu", "-o", "no/folder.fmu"], "cannot be written: No such file or directory"),
        (["out.fmu"], "out.fmu holds only the description already"),
        (["none.fmu"], "none.fmu is not an FMU"),
        (["missing.fmu"], "missing.fmu does not exist"),
    ):
        done = cosim("fmu", "strip", *arguments)
        assert done.returncode == 2
        assert sentence in done.stderr
        assert "Traceback" not in done.stderr
    assert hashlib.sha256((tmp_path / "out.fmu").read_bytes()).hexdigest() == digest
