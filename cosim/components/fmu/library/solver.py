"""CVODE, as it comes with FMPy."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable
from typing import Any

from cosim.errors import ComponentError

_SILENCE = {f"SUNLOGGER_{level}_FILENAME": os.devnull for level in ("ERROR", "WARNING")}


def cvode_solver(component: str, failed: Callable[[], bool], shortest: float, **arguments: Any) -> Any:
    """FMPy's `CVodeSolver`, whose library comes with it for the usual platforms; it prints nothing.

    Args:
        component: for messages.
        failed: whether a callback has failed, so that CVODE must end.
        shortest: step in seconds.
        arguments: of FMPy's class.

    Raises:
        ComponentError: there is none for this platform.
    """
    try:
        from fmpy import sundials
        from fmpy.sundials.libraries import sundials_core, sundials_cvode
    except Exception as error:  # a library that is missing shows in many ways
        raise ComponentError(component, f"FMPy has no CVODE for this platform: {error}") from error

    class Solver(sundials.CVodeSolver):  # type: ignore[misc]
        """The callbacks say what went wrong: negative for good, positive if a shorter step may do."""

        def f(self, t: float, y: Any, ydot: Any, user_data: Any) -> int:
            super().f(t, y, ydot, user_data)
            slopes = sundials.NV_DATA_S(ydot)
            return -1 if failed() else int(not all(math.isfinite(slopes[i]) for i in range(self.nx)))

        def g(self, t: float, y: Any, gout: Any, user_data: Any) -> int:
            super().g(t, y, gout, user_data)
            return -1 if failed() else 0

    before = {name: os.environ.get(name) for name in _SILENCE}
    os.environ.update(_SILENCE)  # SUNDIALS looks there when it is created
    try:
        solver = Solver(**arguments)
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    clear, set_min_step = sundials_core.SUNContext_ClearErrHandlers, sundials_cvode.CVodeSetMinStep
    clear.argtypes = [sundials.SUNContext]
    clear(solver.sunctx)  # among them one that prints
    sundials.SUNContext_PushErrHandler(solver.sunctx, solver.ehfun_, None)
    set_min_step.argtypes = [ctypes.c_void_p, ctypes.c_double]
    set_min_step(solver.cvode_mem, shortest)
    return solver
