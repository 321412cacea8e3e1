"""The structure of a system: components, nested systems, connectors and connections (SSP 1.0 and 2.0, chapter 5)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from cosim.components.units import BASE, Measure, Scale
from cosim.errors import ConfigError, Problem
from cosim.ssp.package import Node, Package
from cosim.ssp.parameters import Binding, read_bindings
from cosim.ssp.transformations import REALS, linear

_FMU = "application/x-fmu-sharedlibrary"
_SSD = "application/x-ssp-definition"


@dataclass(frozen=True)
class Connector:
    """A variable of a component or system that can be connected.

    Attributes:
        kind: `input`, `output`, `parameter`, …
        unit: as it says, or None.
    """

    name: str
    kind: str
    unit: str | None
    node: Node


@dataclass(frozen=True)
class Connection:
    """From a connector to another one; None stands for the system's own.

    Attributes:
        scale: the linear transformation, or None.
        suppressed: units are not converted.
    """

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    scale: Scale | None
    suppressed: bool
    node: Node


@dataclass(frozen=True)
class Component:
    """An FMU.

    Attributes:
        member: of the package.
        implementation: `any`, `ModelExchange` or `CoSimulation`.
    """

    name: str
    member: str
    implementation: str
    connectors: dict[str, Connector]
    bindings: Sequence[Binding]
    node: Node


@dataclass(frozen=True)
class System:
    """A system of components and systems."""

    name: str
    connectors: dict[str, Connector]
    elements: dict[str, Component | System]
    connections: Sequence[Connection]
    bindings: Sequence[Binding]
    node: Node


@dataclass
class Structure:
    """A whole package.

    Attributes:
        units: what the units that it defines mean.
        start, stop: of the default experiment in seconds, or None.
        step: with which values are exchanged, in seconds, as tools write it into annotations; or None.
    """

    system: System
    units: dict[str, Measure] = field(default_factory=dict)
    start: float | None = None
    stop: float | None = None
    step: float | None = None


class Reader:
    """Reads the structure of a package, collecting what is not supported.

    Args:
        package: that is read.
    """

    def __init__(self, package: Package) -> None:
        self.package = package
        self.problems: list[Problem] = []
        self._open: list[str] = []

    def read(self) -> Structure:
        """The structure.

        Raises:
            ConfigError: everything that is broken or not supported.
        """
        root = self.package.document(self.package.root, "SystemStructureDescription")
        structure = Structure(self._top(root))
        structure.units = dict(units_of(root))
        for experiment in root.all("DefaultExperiment"):
            if experiment.get("stopTime") is not None:
                structure.stop = experiment.number("stopTime", 0.0)
            structure.start = experiment.number("startTime", 0.0)
        structure.step = _annotated_step(root)
        if self.problems:
            raise ConfigError(self.problems)
        return structure

    def _top(self, root: Node) -> System:
        systems = root.all("System")
        if not systems:
            raise root.error("a description without a System")
        return self._system(systems[0])

    def _system(self, node: Node) -> System:
        elements: dict[str, Component | System] = {}
        for child in (child for elements_node in node.all("Elements") for child in elements_node.children()):
            if child.kind not in ("Component", "System"):
                if child.kind:
                    self._unsupported(child, child.kind)
                continue
            name = child.required("name")
            if name in elements:
                self._problem(child, f"there are two elements {name!r}")
            element = self._system(child) if child.kind == "System" else self._component(child, name)
            if element is not None:
                elements[name] = element
        for dictionary in node.all("SignalDictionaries", "SignalDictionary"):
            self._unsupported(dictionary, "SignalDictionary")
        connections = [self._connection(x) for x in node.all("Connections", "Connection")]
        return System(
            node.required("name"),
            self._connectors(node),
            elements,
            [x for x in connections if x is not None],
            self._bindings(node),
            node,
        )

    def _component(self, node: Node, name: str) -> Component | System | None:
        kind, source = node.get("type") or _FMU, node.get("source")
        if source is None:
            self._problem(node, f"component {name!r} has no source")
            return None
        if kind not in (_FMU, _SSD):
            self._unsupported(node, f"component {name!r} of the type {kind}")
            return None
        try:
            member = self.package.resolve(node, source)
            if kind == _SSD:
                return self._referenced(node, name, member)
        except ConfigError as error:
            self.problems += error.problems
            return None
        implementation = node.get("implementation") or "any"
        if implementation == "ScheduledExecution":
            self._unsupported(node, f"component {name!r} with ScheduledExecution")
        return Component(name, member, implementation, self._connectors(node), self._bindings(node), node)

    def _referenced(self, node: Node, name: str, member: str) -> System:
        """The system of another description in the package, with the component's bindings after its own."""
        if member in self._open:
            raise node.error(f"{member} refers to itself")
        self._open.append(member)
        system = self._top(self.package.document(member, "SystemStructureDescription"))
        self._open.pop()
        bindings = [*system.bindings, *self._bindings(node)]
        return System(name, system.connectors, system.elements, system.connections, bindings, node)

    def _bindings(self, node: Node) -> Sequence[Binding]:
        found, problems = read_bindings(self.package, node)
        self.problems += problems
        return found

    def _connectors(self, node: Node) -> dict[str, Connector]:
        found = {}
        for child in node.all("Connectors", "Connector"):
            kind = child.required("kind")
            if kind == "inout" or child.all("Clock"):
                self._unsupported(child, f"connector {child.get('name')!r}: {'inout' if kind == 'inout' else 'clocks'}")
            unit = next((x.get("unit") for x in child.children() if x.kind in REALS), None)
            found[child.required("name")] = Connector(child.required("name"), kind, unit, child)
        return found

    def _connection(self, node: Node) -> Connection | None:
        for name in ("startIndices", "endIndices"):
            if node.get(name) is not None:
                self._unsupported(node, name)
                return None
        try:
            scale = linear(node)
        except ConfigError as error:
            self.problems += error.problems
            return None
        return Connection(
            (node.get("startElement") or None, node.required("startConnector")),  # OMSimulator writes ""
            (node.get("endElement") or None, node.required("endConnector")),
            scale,
            node.flag("suppressUnitConversion"),
            node,
        )

    def _unsupported(self, node: Node, what: str) -> None:
        self._problem(node, f"{what} is not supported")

    def _problem(self, node: Node, message: str) -> None:
        self.problems.append(Problem(message, node.where))


_STEPS = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}
"""Where OSP's tools and OMSimulator write the step; the standard has no place for it."""


def _annotated_step(root: Node) -> float | None:
    """The step that an annotation gives, the outermost and first one; None where there is none that could be."""
    for child in root.descendants():
        if child.kind in _STEPS and child.get(_STEPS[child.kind]) is not None:
            step = child.number(_STEPS[child.kind], 0.0)
            return step if 0.0 < step < math.inf else None
    return None


def units_of(root: Node) -> Iterator[tuple[str, Measure]]:
    """The units that a document defines."""
    for unit in root.all("Units", "Unit"):
        for base in unit.all("BaseUnit"):
            exponents = tuple(int(base.number(name, 0.0)) for name in BASE)
            yield unit.required("name"), Measure(exponents, base.number("factor", 1.0), base.number("offset", 0.0))
