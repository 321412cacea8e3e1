"""A class is the one that its file describes now, its hash that of the text that runs, however long a process lives."""

from __future__ import annotations

import hashlib
import importlib
import sys
from pathlib import Path

import pytest

from network.loading import Loaded, load


class Law:
    """What the classes of these tests are derived from."""

    gain: float


def write(folder: Path, name: str, gain: int, before: str = "", base: str = "Law") -> str:
    """A module with a class, in a text of one length whatever the gain; the hash of its file."""
    text = f"from {__name__} import Law\n{before}\nclass Own({base}):\n    gain = {gain}\n"
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.py").write_text(text)
    return hashlib.sha256(text.encode()).hexdigest()


def found(dotted: str) -> tuple[float, str]:
    loaded: Loaded[Law] = load(dotted, Law)
    return loaded.cls.gain, loaded.sha256


@pytest.fixture(autouse=True)
def _path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])


def test_a_module_that_is_edited_is_imported_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even twice in one second, by a text of the same length, which Python does not tell apart."""
    monkeypatch.chdir(tmp_path)
    for gain in range(4):
        sha256 = write(tmp_path, "edited_law", gain)
        first = load("edited_law:Own", Law)
        assert load("edited_law:Own", Law).cls is first.cls
        assert (first.cls.gain, first.sha256, first.file) == (gain, sha256, str(tmp_path / "edited_law.py"))
    (tmp_path / "edited_law.py").touch()
    assert load("edited_law:Own", Law).cls is first.cls
    (tmp_path / "edited_law.py").unlink()
    assert load("edited_law:Own", Law).cls is first.cls


def test_all_that_was_imported_is_imported_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A class must not be derived from what another module was before."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "laws").mkdir()
    write(tmp_path / "laws", "base", 1)
    sha256 = write(tmp_path / "laws", "derived", 5, "from laws import base", "base.Own")
    sha256_other = write(tmp_path, "importing_law", 7, "from laws.base import Own as Base", "Base")
    assert found("laws.derived:Own") == (5, sha256)
    assert found("importing_law:Own") == (7, sha256_other)
    write(tmp_path / "laws", "base", 2)
    for dotted in ("importing_law:Own", "laws.derived:Own"):
        loaded = load(dotted, Law)
        assert loaded.cls.__mro__[1].__dict__["gain"] == 2
        assert loaded.cls.__mro__[1] is load("laws.base:Own", Law).cls


def test_equal_names_in_two_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hashes = [write(tmp_path / name, "law_here", gain) for gain, name in enumerate("ab")]
    before = [*sys.path]
    for gain in (0, 1, 0):
        monkeypatch.chdir(tmp_path / "ab"[gain])
        assert found("law_here:Own") == (gain, hashes[gain])
        assert sys.path == [*before, str(Path.cwd())]


def test_a_module_may_import_another_one_when_it_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "late_help.py").write_text("number = 3\n")
    late = "def late():\n    import late_help\n    return late_help.number\n"
    write(tmp_path, "late_law", 1, late)
    module = sys.modules[load("late_law:Own", Law).cls.__module__]
    assert module.late() == 3


def test_a_module_that_others_have_imported_is_left_to_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    sha256 = write(tmp_path, "law_of_others", 1)
    module = importlib.import_module("law_of_others")
    assert load("law_of_others:Own", Law) == Loaded(module.Own, str(tmp_path / "law_of_others.py"), sha256)
    sha256 = write(tmp_path, "law_of_others", 2)
    with pytest.raises(ValueError, match=r"law_of_others.py has changed since this process imported it; start the"):
        load("law_of_others:Own", Law)
    importlib.reload(module)
    assert found("law_of_others:Own") == (2, sha256)
    write(tmp_path / "other", "law_of_others", 3)
    sys.path[0] = str(tmp_path / "other")
    with pytest.raises(ValueError, match=r"'law_of_others' is here .*other/law_of_others.py, but this process has "):
        load("law_of_others:Own", Law)


def test_only_what_is_derived_from_the_base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "some_law", 1, "class Other: pass")
    with pytest.raises(ValueError, match=r"some_law:Other is no Law: derive it from .*test_loading\.Law"):
        load("some_law:Other", Law)
    with pytest.raises(ValueError, match=r"module some_law has no class 'Owm' \(did you mean 'Own'\?\)"):
        load("some_law:Owm", Law)
    with pytest.raises(ValueError, match=r"there is no Python module 'some_lew' \(did you mean 'some_law'\?\)"):
        load("some_lew:Own", Law)
