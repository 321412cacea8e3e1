"""What is taken from FMPy; but for its parts that are loaded late, it is imported here alone."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping

with contextlib.redirect_stdout(io.StringIO()):  # where FMPy has no logger for the platform, it prints so
    import fmpy
    from fmpy.fmi1 import FMICallException
    from fmpy.fmi2 import (
        FMU2Model,
        FMU2Slave,
        defaultCallbacks,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
        fmi2DoStepStatus,
        fmi2LastSuccessfulTime,
        fmi2Terminated,
    )
    from fmpy.fmi3 import FMU3Model, FMU3Slave
    from fmpy.model_description import ValidationError, read_model_description

__all__ = [
    "DO_STEP_STATUS",
    "FOLDERS",
    "LAST_SUCCESSFUL_TIME",
    "LIBRARY_SUFFIX",
    "PLATFORM",
    "TERMINATED",
    "FMICallException",
    "FMU2Model",
    "FMU2Slave",
    "FMU3Model",
    "FMU3Slave",
    "ValidationError",
    "defaultCallbacks",
    "fmi2CallbackFunctions",
    "fmi2CallbackLoggerTYPE",
    "read_model_description",
]

PLATFORM: str = fmpy.platform_tuple
FOLDERS: Mapping[int, tuple[str, ...]] = {
    2: (fmpy.platform, fmpy.platform_tuple),
    3: (fmpy.platform_tuple,),
}
"""What this platform is called under `binaries/`: `linux64` in FMI 2.0, `x86_64-linux` in 3.0 and by some in 2.0."""

LIBRARY_SUFFIX: str = fmpy.sharedLibraryExtension
LAST_SUCCESSFUL_TIME: int = fmi2LastSuccessfulTime
DO_STEP_STATUS: int = fmi2DoStepStatus
TERMINATED: int = fmi2Terminated
