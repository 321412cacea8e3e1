"""Values of FMU variables in their own types: conversion from and to float64, and memory that FMI calls can use."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from cosim.components.component import Floats, Variable

FMI2_TYPES: dict[str, tuple[str, Any]] = {
    "Float64": ("Real", np.float64),
    "Int32": ("Integer", np.int32),
    "Enumeration": ("Integer", np.int32),
    "Boolean": ("Boolean", np.int32),
}
"""Per type: what its FMI functions are called, and how its values lie in memory."""

FMI3_TYPES: dict[str, tuple[str, Any]] = {
    "Float64": ("Float64", np.float64),
    "Float32": ("Float32", np.float32),
    "Int8": ("Int8", np.int8),
    "UInt8": ("UInt8", np.uint8),
    "Int16": ("Int16", np.int16),
    "UInt16": ("UInt16", np.uint16),
    "Int32": ("Int32", np.int32),
    "UInt32": ("UInt32", np.uint32),
    "Int64": ("Int64", np.int64),
    "UInt64": ("UInt64", np.uint64),
    "Enumeration": ("Int64", np.int64),
    "Boolean": ("Boolean", np.bool_),
}


class Buffer:
    """Memory for the values of one variable, in its own type, and the arguments of the FMI calls that move them."""

    def __init__(self, fmi: int, stored_as: tuple[str, Any], variable: Variable) -> None:
        suffix, dtype = stored_as
        self.getter = f"fmi{fmi}Get{suffix}"
        self.setter = f"fmi{fmi}Set{suffix}"
        self.values: np.ndarray[Any, np.dtype[Any]] = np.zeros(variable.size, dtype)
        references = (ctypes.c_uint * len(variable.references))(*variable.references)
        item = ctypes.c_bool if self.values.dtype == np.bool_ else np.ctypeslib.as_ctypes_type(self.values.dtype)
        pointer = self.values.ctypes.data_as(ctypes.POINTER(item))
        counts = (variable.size,) if fmi == 3 else ()
        self.arguments = (references, len(variable.references), pointer, *counts)

    def store(self, values: Floats) -> None:
        """Convert to the variable's own type: integers to the nearest within its range, Booleans by being non-zero."""
        if self.values.dtype == np.bool_ or self.setter == "fmi2SetBoolean":
            self.values[:] = values != 0.0
        elif self.values.dtype.kind == "f":
            with np.errstate(over="ignore"):
                self.values[:] = values
        else:
            self.values[:] = np.clip(np.rint(values), *integer_range(self.values.dtype))


def integer_range(dtype: np.dtype[Any]) -> tuple[float, float]:
    """The smallest and the largest float64 that lie within an integer type."""
    limits = np.iinfo(dtype)
    largest = float(limits.max)
    return float(limits.min), largest if int(largest) <= limits.max else float(np.nextafter(largest, 0.0))
