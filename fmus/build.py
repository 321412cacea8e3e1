"""Build the shipped FMUs, with the C compiler found or with `ziglang`: `python -m fmus.build`.

Needs only the standard library, because it runs where the package is built. Every `<Model>/model.toml` beside this file
becomes `built/<Model>.fmi2.fmu` and `built/<Model>.fmi3.fmu`.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from fmus import c_table, description, model_description
from fmus.description import DescriptionError

ROOT = Path(__file__).resolve().parent
BUILT = ROOT / "built"
KERNEL = ROOT.parent / "cosim" / "kernel"

_FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-g0")
_WARNINGS = ("-Wall", "-Wextra", "-Wno-unused-parameter")
_TIMESTAMP = (1980, 1, 1, 0, 0, 0)


class BuildError(Exception):
    """Something that stops the build, and what to do about it."""


# --- platform -------------------------------------------------------------------------------------------------------
def library_suffix() -> str:
    """Suffix of a shared library: `.so`, `.dylib` or `.dll`."""
    return {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


def _machine() -> str:
    machine = platform.machine().lower()
    return {"amd64": "x86_64", "x64": "x86_64", "arm64": "aarch64", "i386": "x86", "i686": "x86"}.get(machine, machine)


def platform_folder(fmi: int) -> str:
    """The folder under `binaries` (FMI 2.0.5, section 2.3.1; FMI 3.0.2, section 2.5.1.4.1).

    FMI 2.0 names only x86; for other machines it takes FMI 3.0's tuple, as importers do.
    """
    system = {"linux": "linux", "darwin": "darwin", "win32": "windows"}.get(sys.platform)
    machine = _machine()
    if system is None:
        raise BuildError(f"FMI has no platform name for {sys.platform}")
    if fmi == 2 and machine in ("x86_64", "x86"):
        return {"windows": "win"}.get(system, system) + ("64" if machine == "x86_64" else "32")
    return f"{machine}-{system}"


# --- compiling ------------------------------------------------------------------------------------------------------
def find_compiler() -> list[str] | None:
    """Command of the C compiler: $CC, gcc, cc, clang, or `ziglang` where it is installed; None without any."""
    if os.environ.get("CC"):
        return os.environ["CC"].split()
    for name in ("gcc", "cc", "clang"):
        found = shutil.which(name)
        if found:
            return [found]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc", *_zig_target()]
    return None


def _zig_target() -> list[str]:
    """Zig compiles for the very processor it runs on unless a target is given."""
    system = {"linux": "linux-gnu.2.17", "darwin": "macos", "win32": "windows-gnu"}[sys.platform]
    return ["-target", f"{_machine()}-{system}"]


def compile_shared(
    sources: Sequence[Path], output: Path, includes: Sequence[Path] = (), defines: Sequence[str] = ()
) -> None:
    """Compile C sources into one shared library that exports only what is marked.

    Raises:
        BuildError: no compiler, a missing source, or the compiler's own message.
    """
    missing = [str(source) for source in sources if not source.is_file()]
    if missing:
        raise BuildError(f"C source not found: {', '.join(missing)}")
    compiler = find_compiler()
    if compiler is None:
        raise BuildError("no C compiler found: install gcc or clang, or `pip install ziglang`, or set CC")
    position = () if sys.platform == "win32" else ("-fPIC",)
    command = [*compiler, *_FLAGS, *_WARNINGS, *position, "-shared"]
    command += [f"-I{include}" for include in includes] + [f"-D{define}" for define in defines]
    command += [*map(str, sources), "-o", str(output)]
    if sys.platform != "win32":
        command.append("-lm")
    output.parent.mkdir(parents=True, exist_ok=True)
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    except OSError as error:
        raise BuildError(f"the C compiler {compiler[0]} cannot be run: {error}") from None
    if result.returncode != 0:
        raise BuildError(f"the C compiler failed: {' '.join(command)}\n{result.stderr.strip()}")
    if result.stderr.strip():
        print(result.stderr.strip(), file=sys.stderr)


def required_functions(fmi: int) -> list[str]:
    """Names of the functions that an FMU exports, read from the official header."""
    header = (ROOT / "include" / f"fmi{fmi}Functions.h").read_text(encoding="utf-8")
    return re.findall(rf"^\s*FMI{fmi}_Export\s+fmi{fmi}\w+TYPE\s+(fmi{fmi}\w+);", header, flags=re.MULTILINE)


def check_exports(library: Path, functions: Sequence[str]) -> None:
    """Load the library and look up every function.

    Raises:
        BuildError: it cannot be loaded, or a function is missing.
    """
    try:
        loaded = ctypes.CDLL(str(library))
    except OSError as error:
        raise BuildError(f"{library.name} was compiled but cannot be loaded: {error}") from None
    missing = [name for name in functions if not hasattr(loaded, name)]
    _unload(loaded)
    if missing or not functions:
        raise BuildError(f"{library.name} does not export {', '.join(missing) or 'anything'}")


def _unload(library: ctypes.CDLL) -> None:
    """Windows does not let go of the file otherwise."""
    if sys.platform == "win32":
        import _ctypes

        _ctypes.FreeLibrary(library._handle)


# --- packing --------------------------------------------------------------------------------------------------------
def _sources(folder: Path, model: description.Model) -> list[Path]:
    """Everything that decides what a model's binary and XML are."""
    shared = [*sorted((ROOT / "adapter").glob("*.[ch]")), *sorted((ROOT / "include").glob("*.h"))]
    shared += [header for name in model.uses for header in sorted((ROOT / name).glob("*.h"))]
    generators = [ROOT / name for name in ("build.py", "c_table.py", "description.py", "model_description.py")]
    return [*shared, *generators, folder / "model.toml", *sorted(folder.glob("*.[ch]"))]


def instantiation_token(folder: Path) -> str:
    """Hash of the sources: an XML file and a binary of different sources don't fit each other."""
    digest = hashlib.sha256()
    for source in _sources(folder, description.load(folder / "model.toml")):
        content = source.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{source.name}:{len(content)}:".encode() + content)
    return f"{{{digest.hexdigest()}}}"


def _write_zip(path: Path, files: dict[str, bytes]) -> None:
    """A zip whose bytes depend on nothing but the files: sorted, fixed times and permissions."""
    temporary = path.with_suffix(f".{os.getpid()}.partial")
    with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, _TIMESTAMP)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, files[name])
    temporary.replace(path)


def build_model(folder: Path, destination: Path = BUILT) -> list[Path]:
    """Build both FMUs of the model in `folder`; returns their paths.

    Raises:
        BuildError: see `compile_shared` and `check_exports`.
        DescriptionError: a `model.toml` that cannot be built.
    """
    model = description.load(folder / "model.toml")
    token = instantiation_token(folder)
    with tempfile.TemporaryDirectory(prefix="fmus-") as temporary:
        work = Path(temporary)
        (work / "variables.h").write_text(c_table.variables_header(model, token), encoding="utf-8")
        (work / "table.h").write_text(c_table.table_header(model), encoding="utf-8")
        library = work / f"{model.name}{library_suffix()}"
        sources = [*sorted((ROOT / "adapter").glob("*.c")), *sorted(folder.glob("*.c"))]
        shared = [ROOT / name for name in ("include", "adapter", *model.uses)]
        compile_shared(sources, library, includes=[work, *shared, folder])
        check_exports(library, [*required_functions(2), *required_functions(3)])
        binary = library.read_bytes()
    destination.mkdir(parents=True, exist_ok=True)
    paths = []
    for fmi, write in ((2, model_description.write_fmi2), (3, model_description.write_fmi3)):
        path = destination / f"{model.name}.fmi{fmi}.fmu"
        files = {
            "modelDescription.xml": write(model, token),
            f"binaries/{platform_folder(fmi)}/{model.name}{library_suffix()}": binary,
        }
        _write_zip(path, files)
        paths.append(path)
    return paths


def build_kernel() -> Path:
    """Compile the native loop of `cosim`, `cosim/kernel/*.c`, to `cosim/kernel/_kernel.so` (or .dylib, .dll).

    Raises:
        BuildError: see `compile_shared` and `check_exports`; or `kernel.c` is not there.
    """
    sources = sorted({KERNEL / "kernel.c", *KERNEL.glob("*.c")})
    output = KERNEL / f"_kernel{library_suffix()}"
    partial = output.with_suffix(f".{os.getpid()}{library_suffix()}")
    try:
        compile_shared(sources, partial, includes=[ROOT / "include", KERNEL])
        text = "\n".join(source.read_text(encoding="utf-8") for source in sources)
        check_exports(partial, sorted(set(re.findall(r"^EXPORT .*?(\w+)\(", text, flags=re.MULTILINE))))
        partial.replace(output)  # at once: a process that runs the old one keeps it
    finally:
        partial.unlink(missing_ok=True)
    return output


def model_folders() -> list[Path]:
    """Folders beside this file that hold a `model.toml`, sorted."""
    return sorted(path.parent for path in ROOT.glob("*/model.toml"))


def build_all() -> list[Path]:
    """Build every FMU and the kernel; returns the files.

    Raises:
        BuildError: see `compile_shared` and `check_exports`.
        DescriptionError: a `model.toml` that cannot be built.
    """
    return [*(path for folder in model_folders() for path in build_model(folder)), build_kernel()]


def main() -> int:
    """Build everything and print what was built; the exit code."""
    try:
        for path in build_all():
            print(f"built {path.relative_to(ROOT.parent)} ({path.stat().st_size} bytes)")
    except (BuildError, DescriptionError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
