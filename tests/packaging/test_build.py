"""The build: reproducible, checked, and clear about what stops it."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import textwrap
import zipfile
from pathlib import Path

import pytest

from fmus import build, description


def _example(language: str) -> str:
    """A code block of `fmus/README.md`: what a newcomer copies."""
    text = (build.ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(rf"^ *```{language}\n(.*?)^ *```$", text, flags=re.DOTALL | re.MULTILINE)
    assert len(blocks) == 1
    return textwrap.dedent(blocks[0])


MODEL = _example("toml")
CODE = _example("c")


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Folder of a small model of its own."""
    folder = tmp_path / "Decay"
    folder.mkdir()
    (folder / "model.toml").write_text(MODEL, encoding="utf-8")
    (folder / "model.c").write_text(CODE, encoding="utf-8")
    return folder


# --- what is built --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("folder", build.model_folders(), ids=lambda folder: folder.name)
def test_rebuilt_fmu_is_bit_identical(tmp_path: Path, folder: Path) -> None:
    first = build.build_model(folder, tmp_path / "first")
    second = build.build_model(folder, tmp_path / "second")
    assert [path.name for path in first] == [f"{folder.name}.fmi2.fmu", f"{folder.name}.fmi3.fmu"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_archive(model: Path, tmp_path: Path) -> None:
    two, three = build.build_model(model, tmp_path / "built")
    for path, fmi in ((two, 2), (three, 3)):
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
        library = f"binaries/{build.platform_folder(fmi)}/Decay{build.library_suffix()}"
        assert [entry.filename for entry in entries] == [library, "modelDescription.xml"]
        assert {entry.date_time for entry in entries} == {(1980, 1, 1, 0, 0, 0)}
    assert sorted((tmp_path / "built").iterdir()) == sorted((two, three))


def test_example_of_the_readme_runs(model: Path, tmp_path: Path) -> None:
    from fmpy import simulate_fmu
    from fmpy.validation import validate_fmu

    for path in build.build_model(model, tmp_path / "built"):
        assert validate_fmu(str(path)) == []
        for interface in ("ModelExchange", "CoSimulation"):
            result = simulate_fmu(str(path), fmi_type=interface, stop_time=1.0, relative_tolerance=1e-8)
            assert result["x"][-1] == pytest.approx(0.1353352832366127, abs=1e-6)


def test_token_follows_the_sources(model: Path) -> None:
    first = build.instantiation_token(model)
    assert re.fullmatch(r"\{[0-9a-f]{64}\}", first)
    assert build.instantiation_token(model) == first
    (model / "model.c").write_text(CODE.replace("-model", "-2.0 * model"), encoding="utf-8")
    assert build.instantiation_token(model) != first


def test_instances_share_no_writable_data(tmp_path: Path) -> None:
    """Two instances of one library could otherwise meet: it holds nothing but the runtime's own variables."""
    nm = shutil.which("nm")
    if nm is None or sys.platform != "linux":
        pytest.skip("needs nm and ELF")
    constant = {"variables"}  # const, but in a section that the loader writes addresses to
    runtime = re.compile(r"completed\.\d+|__.*|_edata|_end|_DYNAMIC|_GLOBAL_OFFSET_TABLE_")
    for folder in build.model_folders():
        with zipfile.ZipFile(build.build_model(folder, tmp_path / "built")[1]) as archive:
            library = archive.extract(archive.namelist()[0], tmp_path)
        symbols = subprocess.run([nm, library], capture_output=True, text=True, check=True).stdout
        writable = set(re.findall(r" [bBdDC] (\S+)$", symbols, flags=re.MULTILINE))
        assert {name for name in writable - constant if not runtime.fullmatch(name)} == set()


def test_required_functions_are_the_headers() -> None:
    assert {"fmi2Instantiate", "fmi2DoStep", "fmi2GetTypesPlatform"} <= set(build.required_functions(2))
    assert {"fmi3InstantiateModelExchange", "fmi3DoStep", "fmi3ActivateModelPartition"} <= set(
        build.required_functions(3)
    )


def test_flattening_of_the_adapter_and_of_the_build_agree() -> None:
    source = (build.ROOT / "adapter" / "fmi2.c").read_text(encoding="utf-8")
    assert f"#define ELEMENTS {description.MAX_ELEMENTS}\n" in source


@pytest.mark.parametrize(
    ("platform", "machine", "fmi2", "fmi3"),
    [
        ("linux", "x86_64", "linux64", "x86_64-linux"),
        ("linux", "aarch64", "aarch64-linux", "aarch64-linux"),
        ("darwin", "x86_64", "darwin64", "x86_64-darwin"),
        ("darwin", "arm64", "aarch64-darwin", "aarch64-darwin"),
        ("win32", "AMD64", "win64", "x86_64-windows"),
        ("win32", "x86", "win32", "x86-windows"),
        ("win32", "ARM64", "aarch64-windows", "aarch64-windows"),
    ],
)
def test_platform_folders(monkeypatch: pytest.MonkeyPatch, platform: str, machine: str, fmi2: str, fmi3: str) -> None:
    monkeypatch.setattr("fmus.build.sys.platform", platform)
    monkeypatch.setattr("fmus.build.platform.machine", lambda: machine)
    assert (build.platform_folder(2), build.platform_folder(3)) == (fmi2, fmi3)


# --- what stops it --------------------------------------------------------------------------------------------------
def test_missing_source(tmp_path: Path) -> None:
    with pytest.raises(build.BuildError, match=r"C source not found: .*kernel\.c"):
        build.compile_shared([tmp_path / "kernel.c"], tmp_path / "_kernel.so")


def test_missing_kernel(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(build, "KERNEL", tmp_path)
    with pytest.raises(build.BuildError, match=r"C source not found: .*kernel\.c"):
        build.build_kernel()


def test_no_compiler(monkeypatch: pytest.MonkeyPatch, model: Path, tmp_path: Path) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    monkeypatch.setattr("fmus.build.importlib.util.find_spec", lambda _name: None)
    with pytest.raises(build.BuildError, match="no C compiler found: install gcc or clang, or `pip install ziglang`"):
        build.build_model(model, tmp_path)


def test_compiler_that_does_not_exist(monkeypatch: pytest.MonkeyPatch, model: Path, tmp_path: Path) -> None:
    monkeypatch.setenv("CC", str(tmp_path / "no-such-cc"))
    with pytest.raises(build.BuildError, match="no-such-cc cannot be run"):
        build.build_model(model, tmp_path)


def test_ziglang_where_there_is_nothing_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With an explicit target: by default zig compiles for the very processor it runs on."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    monkeypatch.setattr("fmus.build.importlib.util.find_spec", lambda name: object() if name == "ziglang" else None)
    command = build.find_compiler()
    assert command is not None
    assert command[:5] == [sys.executable, "-m", "ziglang", "cc", "-target"]


def test_code_that_does_not_compile(model: Path, tmp_path: Path) -> None:
    (model / "model.c").write_text(CODE.replace("der_x", "der_y"), encoding="utf-8")
    with pytest.raises(build.BuildError, match=r"(?s)the C compiler failed: .*der_y"):
        build.build_model(model, tmp_path)


def test_library_without_its_functions(tmp_path: Path) -> None:
    source = tmp_path / "empty.c"
    source.write_text('__attribute__((visibility("default"))) int one(void) { return 1; } int two(void) { return 2; }')
    library = tmp_path / f"empty{build.library_suffix()}"
    build.compile_shared([source], library)
    build.check_exports(library, ["one"])
    with pytest.raises(build.BuildError, match="does not export two, fmi3DoStep"):
        build.check_exports(library, ["one", "two", "fmi3DoStep"])


def test_model_without_one_of_its_functions(model: Path, tmp_path: Path) -> None:
    (model / "model.c").write_text(CODE.replace("bool model_evaluate", "static bool evaluate"), encoding="utf-8")
    with pytest.raises(build.BuildError, match="model_evaluate"):
        build.build_model(model, tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "m",', 'unit = "furlong",', "x has an unknown unit 'furlong'; add it to UNITS"),
        ('depends = ["x", "k"]', 'depends = ["y"]', r"der\(x\) depends on 'y', which does not exist"),
        ('name = "k",', 'name = "x",', "x is described twice"),
        ('name = "solver_step"', 'name = "step"', "a model with states needs the parameter solver_step"),
        ("start = 1.0,", "", r"x must have 1 start value\(s\)"),
        ("start = 2.0", 'start = 2.0, type = "Float"', "k has an unknown type 'Float'"),
        ("start = 2.0", "start = 2.0, colour = 1", "k has an unknown key 'colour'"),
        ("start = 2.0", "start = 2.0, size = [300]", "k has more than 256 elements"),
        ("start = 2.0", 'start = 2.0, size = ["n"]', "k has a size that is none of a number"),
        ("parameters =", "constants =", "unknown group of variables 'constants'"),
        ('name = "Decay"', "", "'name' is missing"),
        ('name = "Decay"', "name = ", r"model\.toml: Invalid value"),
    ],
)
def test_description_that_is_wrong(model: Path, old: str, new: str, message: str) -> None:
    assert old in MODEL
    (model / "model.toml").write_text(MODEL.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(description.DescriptionError, match=message):
        description.load(model / "model.toml")


def test_command_reports_and_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(build, "model_folders", list)
    monkeypatch.setattr(build, "KERNEL", tmp_path)
    assert build.main() == 1
    assert capsys.readouterr().err.startswith("error: C source not found")


def test_build_needs_only_the_standard_library() -> None:
    """It runs in an isolated environment that holds hatchling, and at most ziglang."""
    for name in ("build", "c_table", "description", "model_description"):
        spec = importlib.util.find_spec(f"fmus.{name}")
        assert spec is not None
        assert spec.origin is not None
        imported = re.findall(r"^\s*(?:from|import) (\w+)", Path(spec.origin).read_text(encoding="utf-8"), re.MULTILINE)
        assert set(imported) <= set(sys.stdlib_module_names) | {"fmus", "__future__"}
