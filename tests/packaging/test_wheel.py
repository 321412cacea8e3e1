"""The wheel that hatchling builds with the hook: tagged for this platform, with the FMUs and the kernel inside."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from fmus import build

pytest.importorskip("hatchling", reason="the build backend")

ROOT = build.ROOT.parent
PARTS = [
    "cosim",
    "network",
    "fmus",
    "configs",
    "docs",
    "pyproject.toml",
    "hatch_build.py",
    "README.md",
    "LICENSE",
    ".gitignore",
]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the sources, without anything built."""
    ignore = shutil.ignore_patterns("built", "__pycache__", "*.so", "*.dylib", "*.dll")
    for part in PARTS:
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, tmp_path / "tree" / part, ignore=ignore)
        else:
            shutil.copy(ROOT / part, tmp_path / "tree" / part)
    return tmp_path / "tree"


def hatchling(tree: Path, target: str) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(tree / "dist")]
    result = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return next((tree / "dist").iterdir())


def built_files() -> set[str]:
    fmus = {f"fmus/built/{folder.name}.fmi{fmi}.fmu" for folder in build.model_folders() for fmi in (2, 3)}
    return fmus | {f"cosim/kernel/_kernel{build.library_suffix()}"}


def test_wheel(tree: Path) -> None:
    wheel = hatchling(tree, "wheel")
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    assert wheel.name.split("-", 2)[2] in (
        f"py3-none-{platform}.whl",
        f"py3-none-{platform}.whl".replace("universal2", "arm64"),
    )
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = archive.read(next(name for name in names if name.endswith("/WHEEL"))).decode()
    assert built_files() <= set(names)
    shipped = {"paper_leaders.yaml", "channels/wifi_busy.yaml", "traces/synthetic_cellular.trace"}
    assert {f"cosim/configs/{name}" for name in shipped} <= set(names)
    assert {"cosim/docs/channels.md", "cosim/docs/freshness.md"} <= set(names)
    assert "Root-Is-Purelib: false" in metadata
    assert any(name.endswith("licenses/fmus/include/LICENSE-FMI.txt") for name in names)


def test_editable_wheel_builds_into_the_tree(tree: Path) -> None:
    wheel = hatchling(tree, "wheel:editable")
    assert all((tree / name).is_file() for name in built_files())
    with zipfile.ZipFile(wheel) as archive:
        assert not built_files() & set(archive.namelist())


def test_source_distribution_holds_no_binary(tree: Path) -> None:
    archive = hatchling(tree, "sdist")
    shutil.unpack_archive(archive, tree / "unpacked")
    names = {path.name for path in (tree / "unpacked").rglob("*")}
    assert {"model.toml", "instance.c", "kernel.c", "hatch_build.py"} <= names
    assert not any(name.endswith((".fmu", ".so", ".dll", ".dylib")) for name in names)


def test_what_stops_the_build_is_said_without_a_traceback(tree: Path) -> None:
    (tree / "cosim" / "kernel" / "kernel.c").unlink()
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tree / "dist")]
    result = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    assert result.returncode != 0
    assert "netcosim could not be built: C source not found:" in result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr
