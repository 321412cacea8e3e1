"""`cosim fmu export`: a Python component class becomes an FMU, by PythonFMU3 (the extra `export`)."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import cosim
import network
from cosim.components.component import Interface
from cosim.components.fmu.archive import refuse
from cosim.components.python import describe_python, load
from cosim.errors import ConfigError, Problem

_TRAVELS = (
    *("cosim/__init__.py", "cosim/attention.py", "cosim/errors.py", "network/__init__.py", "network/loading.py"),
    *(f"cosim/components/{name}.py" for name in ("__init__", "component", "exported", "python")),
    *(f"cosim/components/{name}.py" for name in ("saving", "start_values", "units")),
)
"""What a component needs inside an FMU."""

_PACKAGES = {package.__name__: Path(str(package.__file__)).parent for package in (cosim, network)}

_SCRIPT = """\
from cosim.components.exported import Exported
from pythonfmu3 import CoSimulation, Fmi3SlaveBase, ModelExchange


class {name}(Exported, Fmi3SlaveBase, {interfaces}):
    TARGET = {target!r}
    SIZES = {sizes!r}
"""


def export(target: str, out: Path | None, sizes: Mapping[str, int], files: Sequence[Path] = ()) -> Path:
    """Write the FMU: FMI 3.0, Co-Simulation, and Model Exchange where the class offers that.

    Args:
        target: `package.module:Class`.
        out: the new file, by default `<Class>.fmu` in the current folder.
        sizes: of its structural parameters, fixed in the FMU; others keep their start values.
        files: files and folders that its module needs as well.

    Raises:
        ConfigError: the extra is not installed, there is no such class, or the file cannot be written.
    """
    try:
        from pythonfmu3.builder import FmuBuilder
    except ImportError:
        text = "exporting takes PythonFMU3; install it with: pip install 'netcosim[export]'"
        raise ConfigError([Problem(text)]) from None
    description = describe_python(target, sizes)
    unknown = [n for n in sizes if n not in description.variables]
    if unknown:
        raise ConfigError([Problem(f"{target} has no structural parameter {name!r}") for name in unknown])
    arrays = [v.name for v in description.variables.values() if v.shape and v.dtype in ("String", "Enumeration")]
    if arrays:
        text = f"{target}: PythonFMU3 has no arrays of the type of {', '.join(arrays)}"
        raise ConfigError([Problem(text)])
    out = out or Path(f"{description.model}.fmu")
    if out.exists():
        raise refuse(out, "exists already; choose another name with -o or remove it")
    exchange = Interface.MODEL_EXCHANGE in description.interfaces
    interfaces = "ModelExchange, CoSimulation" if exchange else "CoSimulation"
    with tempfile.TemporaryDirectory(prefix="netcosim-export-") as folder:
        staging, built = Path(folder) / "staging", Path(folder) / "built"
        script = _stage(staging, target, description.model, sizes, interfaces)
        beside = [path for path in staging.iterdir() if path != script]
        made = FmuBuilder.build_FMU(script, dest=built, project_files=[*beside, *files])
        try:
            shutil.move(made, out)
        except OSError as error:
            raise refuse(out, f"cannot be written: {error.strerror}") from error
    return out


def _stage(staging: Path, target: str, model: str, sizes: Mapping[str, int], interfaces: str) -> Path:
    """What goes into the FMU's resources; the script that PythonFMU3 starts from."""
    for name in _TRAVELS:
        package, _, inside = name.partition("/")
        place = staging / name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(_PACKAGES[package] / inside, place)
    _copy_module(target, staging)
    # In one process, modules of one name would be one: the name says what is in it.
    content = f"{target}{sorted(sizes.items())}{Path(load(target).file).read_bytes()!r}".encode()
    script = staging / f"{model}_{hashlib.sha256(content).hexdigest()[:12]}.py"
    script.write_text(_SCRIPT.format(name=model, interfaces=interfaces, target=target, sizes=dict(sizes)), "utf-8")
    return script


def _copy_module(target: str, staging: Path) -> None:
    """The module of the class: its file, or the whole package that it lies in."""
    top, _, inside = target.partition(":")[0].partition(".")
    source = Path(load(target).file)
    if not inside:
        if source.name == "__init__.py":
            shutil.copytree(source.parent, staging / top, ignore=shutil.ignore_patterns("__pycache__"))
        elif top != "cosim":
            shutil.copyfile(source, staging / source.name)
        return
    if top == "cosim":
        place = staging / "cosim" / source.relative_to(_PACKAGES["cosim"])
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, place)
        return
    package = next(parent for parent in source.parents if parent.name == top)
    shutil.copytree(package, staging / top, ignore=shutil.ignore_patterns("__pycache__"))
