"""FMUs of FMI 2.0 and 3.0: `describe` a file, `open_fmu` an instance.

Importing this package takes a while (FMPy brings lxml and more), so others import it inside functions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from cosim.components.component import Description, Interface, SizeError
from cosim.components.fmu.archive import refuse
from cosim.components.fmu.component import FmuComponent, Native
from cosim.components.fmu.fmi2 import Fmi2Component
from cosim.components.fmu.fmi3 import Fmi3Component
from cosim.components.fmu.library import FOLDERS, LIBRARY_SUFFIX, PLATFORM, File, read
from cosim.components.fmu.variables import variables_of
from cosim.errors import ComponentError
from cosim.logs import Sink, discard

__all__ = ["FmuComponent", "Native", "describe", "open_fmu"]


def describe(path: Path, structural: Mapping[str, int] | None = None) -> Description:
    """What an FMU says of itself.

    Args:
        path: of the file.
        structural: values of FMI 3.0 structural parameters, which size its arrays; others keep their start values.
            Names that are no structural parameters are ignored.

    Raises:
        ConfigError: missing, truncated or malicious file, no or a broken model description, FMI 1.0, no binary for this
            platform, or one that only works inside its own tool.
    """
    file = read(Path(path))
    if file.library_folder is None and file.archive.whole:
        raise refuse(file.archive.path, _no_library(file))
    implementations = file.implementations
    co_simulation = implementations.get(Interface.CO_SIMULATION)
    experiment = file.model.defaultExperiment
    try:
        variables = variables_of(file.model, structural or {})
        internal_step = usable_step(co_simulation and co_simulation.fixedInternalStepSize)
        usual_step = usable_step(experiment and experiment.stepSize)
        tolerance = _positive(experiment and experiment.tolerance)
    except SizeError as error:
        raise refuse(file.archive.path, f"cannot be described: {error}") from None
    except ValueError as error:
        raise refuse(file.archive.path, f"has a broken modelDescription.xml: {error}") from error
    return Description(
        model=file.model.modelName,
        fmi=f"{file.fmi}.0",
        interfaces=tuple(implementations),
        variables=variables,
        platforms=file.archive.platforms,
        sha256=file.archive.sha256,
        n_event_indicators=file.model.numberOfEventIndicators,
        variable_step=co_simulation is None or co_simulation.canHandleVariableCommunicationStepSize,
        internal_step=internal_step,
        usual_step=usual_step,
        tolerance=tolerance,
        asynchronous=file.fmi == 2 and co_simulation is not None and bool(co_simulation.canRunAsynchronuously),
        can_get_and_set_state=all(x.canGetAndSetFMUstate for x in implementations.values()),
        whole=file.archive.whole,
    )


def _no_library(file: File) -> str:
    """Why there is nothing to load, as a predicate."""
    here = [name for name in file.archive.names if name.startswith(tuple(f"binaries/{f}/" for f in FOLDERS[file.fmi]))]
    if libraries := [name for name in here if name.endswith(LIBRARY_SUFFIX)]:
        wanted = " and ".join(sorted(set(file.libraries.values())))
        return f"holds no {wanted}, as its model description calls it, but {', '.join(libraries)}; ask its supplier"
    offered = ", ".join(file.archive.platforms) or "none"
    return (
        f"has no binary for this platform ({PLATFORM}); it has: {offered}. "
        "Ask its supplier for one, or run on another platform"
    )


def _positive(written: str | float | None) -> float | None:
    """A tolerance; None where none, or none that could be, is given.

    Raises:
        ValueError: it is no number.
    """
    number = float(written) if written is not None else 0.0
    return number if 0.0 < number < math.inf else None


def usable_step(written: str | float | None) -> float | None:
    """A step size in seconds; None where none is given, or one of no length or of more than a year.

    Raises:
        ValueError: it is no number.
    """
    step = _positive(written)
    return step if step is not None and step <= _YEAR else None


_YEAR = 366 * 86400.0


def open_fmu(
    name: str, path: Path, interface: Interface, description: Description, log: Sink = discard
) -> FmuComponent:
    """A new instance.

    Args:
        name: of the component, for messages.
        path: of the file.
        interface: Model Exchange or Co-Simulation.
        description: from `describe`, with the arrays sized as they will be used.
        log: takes what the instance logs, line by line.

    Raises:
        ConfigError: the file cannot be used, see `describe`; or it holds only the description.
        ComponentError: the file is another one than was described, its library cannot be loaded, or it refuses.
    """
    file = read(Path(path))
    if description.sha256 != file.archive.sha256:
        raise ComponentError(name, f"{path} is not the file that the scenario was checked with (its SHA-256 differs)")
    if not file.archive.whole:
        raise refuse(path, f"holds only the description of {file.archive.original_name}; running it takes that file")
    if interface not in file.implementations:
        raise ComponentError(name, f"{path} does not offer {interface}")
    return (Fmi2Component if file.fmi == 2 else Fmi3Component)(name, file, interface, description, log)
