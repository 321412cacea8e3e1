"""FMPy: reading model descriptions, loading libraries, the log. Only this package imports FMPy.

A file is read and unpacked once per process, its library loaded once; every instance then costs little more than its
own instantiation.
"""

from __future__ import annotations

from cosim.components.fmu.library.files import File, read, runs_in_python
from cosim.components.fmu.library.imported import (
    DO_STEP_STATUS,
    FOLDERS,
    LAST_SUCCESSFUL_TIME,
    LIBRARY_SUFFIX,
    PLATFORM,
    TERMINATED,
    FMICallException,
)
from cosim.components.fmu.library.loading import open_library
from cosim.components.fmu.library.log import LOG_LINES, Log, fmi2_callbacks, status_name
from cosim.components.fmu.library.solver import cvode_solver
from cosim.components.fmu.library.validation import findings

__all__ = [
    "DO_STEP_STATUS",
    "FOLDERS",
    "LAST_SUCCESSFUL_TIME",
    "LIBRARY_SUFFIX",
    "LOG_LINES",
    "PLATFORM",
    "TERMINATED",
    "FMICallException",
    "File",
    "Log",
    "cvode_solver",
    "findings",
    "fmi2_callbacks",
    "open_library",
    "read",
    "runs_in_python",
    "status_name",
]
