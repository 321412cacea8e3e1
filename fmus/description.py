"""A model's variables, read from its `model.toml`: the one description from which XML and C are written."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

MAX_ELEMENTS = 256
"""Elements of an array that FMI 2.0's value references leave room for; `ELEMENTS` in `adapter/fmi2.c`."""

_TYPES = ("Real", "Integer", "Size", "Boolean", "Enumeration")
_KEYS = {"name", "type", "size", "unit", "variability", "start", "min", "max", "description"}
_KEYS |= {"depends", "initial_depends", "state", "is_state"}

UNITS: dict[str, dict[str, int]] = {
    "1": {},
    "s": {"s": 1},
    "1/s": {"s": -1},
    "1/s2": {"s": -2},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "rad/s2": {"rad": 1, "s": -2},
    "rad/s3": {"rad": 1, "s": -3},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N/m": {"kg": 1, "s": -2},
    "N.s/m": {"kg": 1, "s": -1},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "N.m.s/rad": {"kg": 1, "m": 2, "s": -1, "rad": -1},
}
"""Units that a model may use, as exponents of FMI's base units."""


class DescriptionError(Exception):
    """A `model.toml` that cannot be built: the message names the file and the variable."""


@dataclass(frozen=True)
class Item:
    """One item of an enumeration; items are numbered from 1 in the file's order."""

    name: str
    description: str = ""


@dataclass(frozen=True)
class Variable:
    """One variable of a model.

    Attributes:
        reference: FMI 3.0's value reference: its place in `Model.variables`; -1 for memory, which has none.
        causality: FMI's, or `memory` for what only the model's C code sees.
        kind: `Real`, `Integer`, `Size`, `Boolean` or `Enumeration`.
        enumeration: name of its enumeration, if `kind` says so.
        shape: dimensions: numbers, or the names of the structural parameters that say how many.
        start: `columns` start values, or empty.
        depends: names of the variables that its value is computed from; empty for what is set from outside.
        initial_depends: the same in Initialization Mode, where that differs.
        state: for a derivative, the name of its state.
        is_state: whether the solver integrates it.
    """

    name: str
    reference: int
    causality: str
    variability: str
    kind: str = "Real"
    enumeration: str | None = None
    initial: str | None = None
    shape: tuple[int | str, ...] = ()
    unit: str | None = None
    start: tuple[float, ...] = ()
    minimum: int | None = None
    maximum: int | None = None
    description: str = ""
    depends: tuple[str, ...] = ()
    initial_depends: tuple[str, ...] | None = None
    state: str | None = None
    is_state: bool = False

    @property
    def c_name(self) -> str:
        """The member of the generated C structs: `der_p` for `der(p)`."""
        return f"der_{self.state}" if self.state else self.name

    @property
    def extents(self) -> tuple[str, ...]:
        """The structural parameters among its dimensions."""
        return tuple(extent for extent in self.shape if isinstance(extent, str))

    @property
    def dynamic(self) -> bool:
        """Whether structural parameters size it."""
        return bool(self.extents)

    @property
    def columns(self) -> int:
        """Number of elements; of a dynamic variable, as if every structural parameter were 1."""
        return math.prod(extent for extent in self.shape if isinstance(extent, int))

    @property
    def evaluated(self) -> bool:
        """Whether `model_evaluate` computes it."""
        return self.causality in ("output", "local") and not self.is_state and self.variability == "continuous"


@dataclass(frozen=True)
class Model:
    """A model as described.

    Attributes:
        variables: in the order of their value references.
        memory: what only the model's C code sees.
        uses: folders beside this file with headers that the model's code includes.
    """

    name: str
    description: str
    variables: tuple[Variable, ...]
    memory: tuple[Variable, ...]
    enumerations: dict[str, tuple[Item, ...]] = field(default_factory=dict)
    uses: tuple[str, ...] = ()

    def named(self, name: str) -> Variable:
        return next(variable for variable in self.variables if variable.name == name)

    @property
    def states(self) -> list[Variable]:
        return [variable for variable in self.variables if variable.is_state]

    @property
    def derivatives(self) -> list[Variable]:
        return [variable for variable in self.variables if variable.state]

    @property
    def structural(self) -> list[Variable]:
        return [variable for variable in self.variables if variable.kind == "Size"]

    def largest(self, variable: Variable) -> tuple[int, ...]:
        """Its dimensions in FMI 2.0, where structural parameters only say how much of the declared maximum is used."""
        return tuple(
            extent if isinstance(extent, int) else self.named(extent).maximum or 0 for extent in variable.shape
        )

    def dependencies(self, variable: Variable) -> list[Variable]:
        """Inputs, states and time that the value of `variable` depends on while the model runs (FMI 2.0.5, 2.2.8)."""
        if variable.is_state:
            return [variable]
        known = {v.name for v in self.variables if v.is_state or v.causality in ("input", "independent")}
        return self._closure(variable.depends, known, initial=False)

    def initial_dependencies(self, variable: Variable) -> list[Variable]:
        """What its value depends on in Initialization Mode: everything set from outside, through calculated starts."""
        known = {v.name for v in self.variables if v.initial == "exact" or v.causality in ("input", "independent")}
        return self._closure(_initially(variable), known, initial=True)

    def _closure(self, names: tuple[str, ...], known: set[str], *, initial: bool) -> list[Variable]:
        found: set[str] = set()
        seen: set[str] = set()
        open_names = list(names)
        while open_names:
            name = open_names.pop()
            if name in seen:
                continue
            seen.add(name)
            if name in known:
                found.add(name)
            else:
                other = self.named(name)
                open_names.extend(_initially(other) if initial else () if other.is_state else other.depends)
        return [variable for variable in self.variables if variable.name in found]


def _initially(variable: Variable) -> tuple[str, ...]:
    return variable.depends if variable.initial_depends is None else variable.initial_depends


def load(path: Path) -> Model:
    """Read and check a `model.toml`.

    Raises:
        DescriptionError: a key, type, unit, size or dependency that the build does not know.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise DescriptionError(f"{path}: {error}") from None
    try:
        return _Reader(path, table).model()
    except KeyError as error:
        raise DescriptionError(f"{path}: {error} is missing") from None


class _Reader:
    """Turns the groups of a `model.toml` into variables."""

    def __init__(self, path: Path, table: dict[str, Any]) -> None:
        self.path = path
        self.table = table
        structural = table.get("structural", [])
        self.structural = [structural] if isinstance(structural, dict) else structural
        self.enumerations = {
            name: tuple(Item(**item) for item in items) for name, items in table.get("enumerations", {}).items()
        }
        self.variables: list[Variable] = []
        self.memory: list[Variable] = []

    def model(self) -> Model:
        self._add({"name": "time", "unit": "s", "description": "Simulation time"}, "independent", "continuous", None)
        for entry in self.structural:
            self._add({"type": "Size", **entry}, "structuralParameter", "fixed", "exact")
        groups = self.table["variables"]
        unknown = set(groups) - {"parameters", "inputs", "states", "outputs", "locals", "memory"}
        if unknown:
            raise DescriptionError(f"{self.path}: unknown group of variables {sorted(unknown)[0]!r}")
        for entry in groups.get("parameters", ()):
            self._add(entry, "parameter", "fixed", "exact")
        for entry in groups.get("inputs", ()):
            self._add(entry, "input", entry.get("variability", "continuous"), None)
        for entry in groups.get("states", ()):
            self._add_state(entry)
        for entry in groups.get("states", ()):
            self._add_derivative(entry)
        for group, causality in (("outputs", "output"), ("locals", "local")):
            for entry in groups.get(group, ()):
                self._add(entry, causality, entry.get("variability", "continuous"), "calculated")
        for entry in groups.get("memory", ()):
            self.memory.append(self._variable(entry, -1, "memory", "discrete", None))
        model = Model(
            name=self.table["name"],
            description=self.table["description"],
            variables=tuple(self.variables),
            memory=tuple(self.memory),
            enumerations=self.enumerations,
            uses=tuple(self.table.get("uses", ())),
        )
        self._check(model)
        return model

    def _add(self, entry: dict[str, Any], causality: str, variability: str, initial: str | None) -> None:
        self.variables.append(self._variable(entry, len(self.variables), causality, variability, initial))

    def _add_state(self, entry: dict[str, Any]) -> None:
        own = {
            key: value for key, value in entry.items() if key not in ("rate_unit", "depends", "causality", "initial")
        }
        initial = entry.get("initial", "calculated")
        self._add({**own, "is_state": True}, entry.get("causality", "local"), "continuous", initial)

    def _add_derivative(self, entry: dict[str, Any]) -> None:
        derivative = {
            "name": f"der({entry['name']})",
            "size": entry.get("size", []),
            "unit": entry.get("rate_unit"),
            "depends": entry["depends"],
            "state": entry["name"],
            "description": f"Time derivative of {entry['name']}",
        }
        self._add(derivative, "local", "continuous", "calculated")

    def _variable(
        self, entry: dict[str, Any], reference: int, causality: str, variability: str, initial: str | None
    ) -> Variable:
        name, kind, enumeration = entry["name"], entry.get("type", "Real"), None
        minimum, maximum = entry.get("min"), entry.get("max")
        if kind in self.enumerations:
            kind, enumeration = "Enumeration", kind
            minimum, maximum = 1, len(self.enumerations[enumeration])
        shape = tuple(entry.get("size", []))
        self._check_entry(name, kind, shape, entry)
        columns = math.prod(extent for extent in shape if isinstance(extent, int))
        start = entry.get("start", ())
        variable = Variable(
            name=name,
            reference=reference,
            causality=causality,
            variability=variability,
            kind=kind,
            enumeration=enumeration,
            initial=initial,
            shape=shape,
            unit=entry.get("unit"),
            start=tuple(start) if isinstance(start, (list, tuple)) else (start,) * columns,
            minimum=minimum,
            maximum=maximum,
            description=entry.get("description", ""),
            depends=tuple(entry.get("depends", ())),
            initial_depends=tuple(entry["initial_depends"]) if "initial_depends" in entry else None,
            state=entry.get("state"),
            is_state=entry.get("is_state", False),
        )
        n_start = columns if initial == "exact" or causality == "input" else 0
        if len(variable.start) != n_start:
            raise DescriptionError(f"{self.path}: {name} must have {n_start or 'no'} start value(s)")
        return variable

    def _check_entry(self, name: str, kind: str, size: tuple[Any, ...], entry: dict[str, Any]) -> None:
        for key in entry:
            if key not in _KEYS:
                raise DescriptionError(f"{self.path}: {name} has an unknown key {key!r}")
        if kind not in _TYPES:
            raise DescriptionError(f"{self.path}: {name} has an unknown type {kind!r}")
        sizing = [other["name"] for other in self.structural]
        if not all(extent in sizing or (isinstance(extent, int) and extent > 0) for extent in size):
            known = ", ".join(("a number", *sizing))
            raise DescriptionError(f"{self.path}: {name} has a size that is none of {known}")
        if len(size) > 2 or any(isinstance(extent, str) for extent in size[1:] if isinstance(size[0], int)):
            raise DescriptionError(f"{self.path}: {name} must have at most two dimensions, a variable one first")
        if entry.get("unit") is not None and entry["unit"] not in UNITS:
            raise DescriptionError(f"{self.path}: {name} has an unknown unit {entry['unit']!r}; add it to UNITS")

    def _check(self, model: Model) -> None:
        names = [variable.name for variable in (*model.variables, *model.memory)]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice:
            raise DescriptionError(f"{self.path}: {twice} is described twice")
        public = {variable.name for variable in model.variables}
        for variable in model.variables:
            for other in (*variable.depends, *(variable.initial_depends or ())):
                if other not in public:
                    raise DescriptionError(f"{self.path}: {variable.name} depends on {other!r}, which does not exist")
            if variable.is_state and variable.dynamic != model.states[0].dynamic:
                raise DescriptionError(f"{self.path}: either all states are sized by structural parameters or none is")
            if math.prod(model.largest(variable)) > MAX_ELEMENTS:
                raise DescriptionError(f"{self.path}: {variable.name} has more than {MAX_ELEMENTS} elements")
        if model.states and "solver_step" not in public:
            raise DescriptionError(f"{self.path}: a model with states needs the parameter solver_step")
