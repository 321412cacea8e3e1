"""The shared library in an FMU, before it is loaded: for which machine it is, whether it is whole, what it may lack.

Loading one that is cut short would end the process by a bus error.
"""

from __future__ import annotations

import ctypes
import platform
import re
import struct
from collections.abc import Collection
from typing import Any

HEAD_BYTES = 4096
"""How much of the file `unfit` wants to see."""

_ELF_MACHINES = {3: "x86", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64", 22: "s390x", 21: "ppc64"}
_PE_MACHINES = {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"}
_MACH_MACHINES = {0x01000007: "x86_64", 0x0100000C: "aarch64"}
_SAME = {"amd64": "x86_64", "arm64": "aarch64", "i386": "x86", "i686": "x86", "x64": "x86_64"}
_LOADED = 1
"""A segment of an ELF file that is loaded."""


def unfit(head: bytes, size: int) -> str:
    """Why a library cannot be loaded here, as a predicate; empty if nothing is known against it.

    Args:
        head: the first `HEAD_BYTES` of the file.
        size: of the file.
    """
    system = {"Linux": "Linux", "Darwin": "macOS", "Windows": "Windows"}.get(platform.system(), platform.system())
    here = platform.machine().lower()
    wanted = f"{system} on {_SAME.get(here, here)}"
    found = _made_for(head)
    if found is None:
        return "is no shared library"
    if found and found != wanted:
        return f"is a library for {found}, and this is {wanted}; ask the FMU's supplier for the right one"
    if _is_cut(head, size):
        return "is cut short; get the file again"
    return ""


def _made_for(head: bytes) -> str | None:
    """System and machine; empty if it is not known, None if it is no library."""
    if head[:4] == b"\x7fELF" and len(head) >= 20:
        (machine,) = struct.unpack_from("<H" if head[5] == 1 else ">H", head, 18)
        return f"Linux on {_ELF_MACHINES.get(machine, f'machine {machine}')}"
    if head[:2] == b"MZ" and len(head) >= 64:
        (at,) = struct.unpack_from("<I", head, 0x3C)
        (machine,) = struct.unpack_from("<H", head, at + 4) if at + 6 <= len(head) else (0,)
        return f"Windows on {_PE_MACHINES.get(machine, f'machine {machine}')}"
    if head[:4] == b"\xcf\xfa\xed\xfe" and len(head) >= 8:
        (machine,) = struct.unpack_from("<I", head, 4)
        return f"macOS on {_MACH_MACHINES.get(machine, f'machine {machine}')}"
    return "" if head[:4] == b"\xca\xfe\xba\xbe" else None  # one for several machines


def _is_cut(head: bytes, size: int) -> bool:
    """Whether an ELF file of 64 bits has less than it loads."""
    if head[:4] != b"\x7fELF" or head[4:6] != b"\x02\x01" or len(head) < 64:
        return False
    (table,) = struct.unpack_from("<Q", head, 32)
    entry, count = struct.unpack_from("<HH", head, 54)
    for i in range(count):
        at = table + i * entry
        if at + 40 > len(head):
            return bool(at + 40 > size)
        (kind,), (offset,), (length,) = (
            struct.unpack_from(f, head, at + o) for f, o in (("<I", 0), ("<Q", 8), ("<Q", 32))
        )
        if kind == _LOADED and offset + length > size:
            return True
    return False


# --- functions --------------------------------------------------------------------------------------------------------
_OPTIONAL = re.compile(
    r"fmi[23](.*FMU[sS]tate.*|.*Directional.*|.*Adjoint.*|.*Dependenc.*|.*Clock|.*Interval.*|.*Shift.*|SetDebugLogging|"
    r"ActivateModelPartition|EvaluateDiscreteStates|.*OutputDerivatives|SetRealInputDerivatives|CancelStep|"
    r"Get\w*Status|Get(Types)?(Platform|Version)|GetNumberOf.*|.*ConfigurationMode|Reset)"
)
"""What is called on request only, or never."""


def complete(library: Any, functions: Collection[str], types: Collection[str]) -> list[str]:
    """Put functions that return Error in the place of those that a library lacks and can do without.

    Args:
        library: loaded by ctypes.
        functions: that belong to the interface in use.
        types: of the FMU's variables, as the names of their getters have them.

    Returns:
        The functions that it cannot do without.
    """
    lacking = []
    for name in functions:
        if hasattr(library, name):
            continue
        access = re.fullmatch(r"fmi[23][GS]et([A-Z]\w*?\d*)", name)
        known = access is not None and access[1] in _TYPES
        if _OPTIONAL.fullmatch(name) or (known and access is not None and access[1] not in types):
            setattr(library, name, ctypes.CFUNCTYPE(ctypes.c_int)(_refuse))
        else:
            lacking.append(name)
    return lacking


_TYPES = frozenset(
    {"Real", "Integer", "Boolean", "String", "Float32", "Float64", "Binary"}
    | {f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
)


def _refuse() -> int:
    return 3
