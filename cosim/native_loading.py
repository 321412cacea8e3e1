"""Native libraries are loaded so that other threads go on meanwhile: constructors may hang or crash."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

under_way = False
"""Whether one is being loaded. Until it is, nobody can load another one, which includes most imports."""


def load(library: Path) -> None:
    """Load a library, and run its constructors. `ctypes`, which would keep everybody waiting, then finds it loaded.

    What does not go well is found again, and told, by whoever loads it then.
    """
    global under_way  # noqa: PLW0603 - it belongs to all of the process
    if os.name == "nt":
        return
    dlopen = ctypes.CDLL(None).dlopen
    dlopen.restype, dlopen.argtypes = ctypes.c_void_p, (ctypes.c_char_p, ctypes.c_int)
    under_way = True
    try:
        dlopen(os.fsencode(library), os.RTLD_NOW)
    finally:
        under_way = False
