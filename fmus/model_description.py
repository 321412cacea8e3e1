"""modelDescription.xml for FMI 2.0 and 3.0, from a model's description."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from math import prod
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmus.description import MAX_ELEMENTS, UNITS, Model, Variable

GENERATION_TOOL = "netcosim fmus.build"

_Dependencies = Callable[[Variable], list[Variable]]

_FMI3_TYPES = {
    "Real": "Float64",
    "Integer": "Int64",
    "Size": "UInt64",
    "Boolean": "Boolean",
    "Enumeration": "Enumeration",
}
_FMI2_TYPES = {**{kind: kind for kind in _FMI3_TYPES}, "Size": "Integer"}


def write_fmi2(model: Model, token: str) -> bytes:
    """FMI 2.0 (2.0.5, section 2.2): arrays flattened, structural parameters fixed parameters."""
    return _Fmi2(model, token).document()


def write_fmi3(model: Model, token: str) -> bytes:
    """FMI 3.0 (3.0.2, section 2.4): arrays with dimensions, numbers or structural parameters."""
    return _Fmi3(model, token).document()


class _Writer:
    """What both versions have in common."""

    def __init__(self, model: Model, token: str) -> None:
        self.model = model
        self.token = token
        self.root = Element("fmiModelDescription")

    def document(self) -> bytes:
        self.head()
        units = SubElement(self.root, "UnitDefinitions")
        for name in sorted({v.unit for v in self.model.variables if v.unit}):
            SubElement(
                SubElement(units, "Unit", name=name), "BaseUnit", {base: str(n) for base, n in UNITS[name].items()}
            )
        if self.model.enumerations:
            self.types(SubElement(self.root, "TypeDefinitions"))
        categories = SubElement(self.root, "LogCategories")
        SubElement(categories, "Category", name="logStatusError", description="Why a call failed")
        SubElement(self.root, "DefaultExperiment", startTime="0", stopTime="10", stepSize="0.01")
        self.variables(SubElement(self.root, "ModelVariables"))
        self.structure(SubElement(self.root, "ModelStructure"))
        indent(self.root, space="  ")
        body: str = tostring(self.root, encoding="unicode")
        return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'.encode()

    def head(self) -> None:
        raise NotImplementedError

    def types(self, parent: Element) -> None:
        raise NotImplementedError

    def variables(self, parent: Element) -> None:
        raise NotImplementedError

    def structure(self, parent: Element) -> None:
        raise NotImplementedError

    def unknowns(self) -> tuple[list[Variable], list[Variable]]:
        """Outputs, and what is unknown in Initialization Mode: calculated outputs, states and derivatives."""
        outputs = [v for v in self.model.variables if v.causality == "output"]
        initial = [
            v
            for v in self.model.variables
            if v.initial == "calculated" and (v.causality == "output" or v.is_state or v.state)
        ]
        return outputs, initial

    def common(self, variable: Variable) -> dict[str, str]:
        """Attributes that both versions spell alike; `initial` only where it is not the default."""
        attributes = {"causality": variable.causality, "variability": variable.variability}
        if variable.initial and variable.causality in ("output", "local"):
            attributes["initial"] = variable.initial
        if variable.description:
            attributes["description"] = variable.description
        return attributes


class _Fmi2(_Writer):
    def head(self) -> None:
        model = self.model
        self.root.attrib |= {
            "fmiVersion": "2.0",
            "modelName": model.name,
            "guid": self.token,
            "description": model.description,
            "generationTool": GENERATION_TOOL,
            "variableNamingConvention": "structured",
            "numberOfEventIndicators": "0",
        }
        capabilities = {
            "modelIdentifier": model.name,
            "canNotUseMemoryManagementFunctions": "true",
            "canGetAndSetFMUstate": "true",
            "canSerializeFMUstate": "true",
            "providesDirectionalDerivative": "false",
        }
        SubElement(self.root, "ModelExchange", {**capabilities, "completedIntegratorStepNotNeeded": "true"})
        SubElement(self.root, "CoSimulation", {**capabilities, "canHandleVariableCommunicationStepSize": "true"})

    def types(self, parent: Element) -> None:
        for name, items in self.model.enumerations.items():
            enumeration = SubElement(SubElement(parent, "SimpleType", name=name), "Enumeration")
            for value, item in enumerate(items, 1):
                SubElement(enumeration, "Item", name=item.name, value=str(value), description=item.description)

    def variables(self, parent: Element) -> None:
        self.index: dict[tuple[str, int], int] = {}
        for variable in self.model.variables:
            for element, subscript in enumerate(self.subscripts(variable)):
                self.index[variable.name, element] = len(self.index) + 1
                self.scalar(parent, variable, element, subscript)

    def scalar(self, parent: Element, variable: Variable, element: int, subscript: str) -> None:
        name = f"der({variable.state}{subscript})" if variable.state else f"{variable.name}{subscript}"
        attributes = {"name": name, "valueReference": str(variable.reference * MAX_ELEMENTS + element)}
        common = self.common(variable)
        if variable.kind == "Size":
            common["causality"] = "parameter"
        node = SubElement(parent, "ScalarVariable", {**attributes, **common})
        value = SubElement(node, _FMI2_TYPES[variable.kind])
        if variable.enumeration:
            value.set("declaredType", variable.enumeration)
        if variable.unit:
            value.set("unit", variable.unit)
        if variable.minimum is not None and not variable.enumeration:
            value.set("min", str(variable.minimum))
        if variable.maximum is not None and not variable.enumeration:
            value.set("max", str(variable.maximum))
        if variable.start:
            value.set("start", _literal(variable, variable.start[element % variable.columns]))
        if variable.state:
            value.set("derivative", str(self.index[variable.state, element]))

    def subscripts(self, variable: Variable) -> list[str]:
        """`[1]`, `[2]` or `[1,1]`, `[1,2]`, … row-major; dynamic arrays at their declared maximum."""
        if not variable.shape:
            return [""]
        shape = self.model.largest(variable)
        return [f"[{','.join(map(str, index))}]" for index in product(*(range(1, n + 1) for n in shape))]

    def structure(self, parent: Element) -> None:
        outputs, initial = self.unknowns()
        self.section(parent, "Outputs", outputs, self.model.dependencies)
        self.section(parent, "Derivatives", self.model.derivatives, self.model.dependencies)
        self.section(parent, "InitialUnknowns", initial, self.model.initial_dependencies)

    def section(self, parent: Element, tag: str, unknowns: Sequence[Variable], dependencies: _Dependencies) -> None:
        if not unknowns:
            return
        section = SubElement(parent, tag)
        for variable in unknowns:
            known = [self.index[v.name, e] for v in dependencies(variable) for e in range(len(self.subscripts(v)))]
            for element in range(len(self.subscripts(variable))):
                own = [self.index[variable.name, element]] if variable.is_state and tag == "Outputs" else sorted(known)
                attributes = {"index": str(self.index[variable.name, element]), "dependencies": _list(own)}
                SubElement(section, "Unknown", attributes)


class _Fmi3(_Writer):
    def head(self) -> None:
        model = self.model
        self.root.attrib |= {
            "fmiVersion": "3.0",
            "modelName": model.name,
            "instantiationToken": self.token,
            "description": model.description,
            "generationTool": GENERATION_TOOL,
            "variableNamingConvention": "structured",
        }
        capabilities = {
            "modelIdentifier": model.name,
            "canBeInstantiatedOnlyOncePerProcess": "false",
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
            "providesDirectionalDerivatives": "false",
        }
        SubElement(self.root, "ModelExchange", {**capabilities, "needsCompletedIntegratorStep": "false"})
        step = {
            "canHandleVariableCommunicationStepSize": "true",
            "providesIntermediateUpdate": "false",
            "hasEventMode": "false",
        }
        SubElement(self.root, "CoSimulation", {**capabilities, **step})

    def types(self, parent: Element) -> None:
        for name, items in self.model.enumerations.items():
            enumeration = SubElement(parent, "EnumerationType", name=name)
            for value, item in enumerate(items, 1):
                SubElement(enumeration, "Item", name=item.name, value=str(value), description=item.description)

    def variables(self, parent: Element) -> None:
        for variable in self.model.variables:
            attributes = {"name": variable.name, "valueReference": str(variable.reference), **self.common(variable)}
            if variable.enumeration:
                attributes["declaredType"] = variable.enumeration
            if variable.unit:
                attributes["unit"] = variable.unit
            if variable.minimum is not None and not variable.enumeration:
                attributes["min"] = str(variable.minimum)
            if variable.start:
                repeated = prod(int(self.model.named(extent).start[0]) for extent in variable.extents)
                attributes["start"] = _list(_literal(variable, value) for value in variable.start * repeated)
            if variable.state:
                attributes["derivative"] = str(self.model.named(variable.state).reference)
            node = SubElement(parent, _FMI3_TYPES[variable.kind], attributes)
            for extent in variable.shape:
                if isinstance(extent, int):
                    SubElement(node, "Dimension", start=str(extent))
                else:
                    SubElement(node, "Dimension", valueReference=str(self.model.named(extent).reference))

    def structure(self, parent: Element) -> None:
        outputs, initial = self.unknowns()
        self.section(parent, "Output", outputs, self.model.dependencies)
        self.section(parent, "ContinuousStateDerivative", self.model.derivatives, self.model.dependencies)
        self.section(parent, "InitialUnknown", initial, self.model.initial_dependencies)

    def section(self, parent: Element, tag: str, unknowns: Sequence[Variable], dependencies: _Dependencies) -> None:
        for variable in unknowns:
            known = _list(v.reference for v in dependencies(variable))
            SubElement(parent, tag, valueReference=str(variable.reference), dependencies=known)


def _literal(variable: Variable, value: float) -> str:
    if variable.kind == "Real":
        return repr(float(value))
    return ("true" if value else "false") if variable.kind == "Boolean" else str(int(value))


def _list(values: Iterable[object]) -> str:
    return " ".join(map(str, values))
