"""A modelDescription.xml as XML: changed so that FMPy can read whatever the standard allows, and what FMPy leaves out.

FMPy 0.3.32 stumbles over comments in type definitions, lists with two blanks, and types of clocks and binaries; it
reads neither `relativeQuantity` of a variable nor bounds of unsigned integers nor all strings of an array.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from lxml import etree

_FMI2_TYPES = frozenset({"Real", "Integer", "Boolean", "String", "Enumeration"})
_TYPE_ATTRIBUTES = frozenset(
    {"name", "description", "quantity", "unit", "displayUnit", "relativeQuantity"}
    | {"min", "max", "nominal", "unbounded"}
)
_ITEM_ATTRIBUTES = frozenset({"name", "value", "description"})
_LISTS = ("dependencies", "dependenciesKind", "clocks")


def parse(xml: bytes) -> Any:
    """The root element.

    Raises:
        ValueError: it is no XML; says why, and where.
    """
    try:
        return etree.fromstring(xml, etree.XMLParser(no_network=True, load_dtd=False, huge_tree=False))
    except etree.XMLSyntaxError as error:
        raise ValueError(error.msg) from None


# --- before FMPy reads it ---------------------------------------------------------------------------------------------
def make_readable(root: Any) -> bool:
    """Take out what FMPy cannot read although the standard allows it; whether there is anything of that."""
    changes = [change(root) for change in (_plain_lists, _plain_types, _without_clock_types, _without_comments)]
    return any(changes)


def serialised(root: Any) -> bytes:
    """The document as text; lines keep their numbers, but for those within a tag."""
    text: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return text


def _plain_lists(root: Any) -> bool:
    changed = False
    for element in root.iter(etree.Element):
        for name in _LISTS:
            text = element.get(name)
            if text and text != (plain := " ".join(text.split())):
                element.set(name, plain)
                changed = True
    return changed


def _plain_types(root: Any) -> bool:
    """Types and items without attributes that FMPy does not know, such as `maxSize`."""
    changed = False
    for kind in root.iterfind("TypeDefinitions/*"):
        of_type = kind.iterchildren(etree.Element) if kind.tag == "SimpleType" else (kind,)
        for element in of_type:
            changed |= _keep(element, _TYPE_ATTRIBUTES)
            for item in element.iterfind("Item"):
                changed |= _keep(item, _ITEM_ATTRIBUTES)
    return changed


def _keep(element: Any, known: frozenset[str]) -> bool:
    """Drop all other attributes; whether there were any."""
    unknown = [name for name in element.attrib if name not in known]
    for name in unknown:
        del element.attrib[name]
    return bool(unknown)


def _without_clock_types(root: Any) -> bool:
    changed = False
    types = {element.get("name") for element in root.iterfind("TypeDefinitions/ClockType")}
    for element in root.iterfind("ModelVariables/Clock"):
        if element.get("declaredType") in types:
            del element.attrib["declaredType"]
            changed = True
    return changed


def _without_comments(root: Any) -> bool:
    """A type begins with its first element, not with a comment."""
    comments = [node for types in root.iterfind("TypeDefinitions") for node in types.iter(etree.Comment, etree.PI)]
    for node in comments:
        lines = "\n" * str(node.text or "").count("\n") + (node.tail or "")
        before, parent = node.getprevious(), node.getparent()
        if before is not None:
            before.tail = (before.tail or "") + lines
        else:
            parent.text = (parent.text or "") + lines
        node.tail = None
        parent.remove(node)
    return bool(comments)


def without_odd_display_units(root: Any) -> list[str]:
    """Take away display units of variables without a unit that is defined; what is to be said of each."""
    types = {element.get("name"): element for element in root.iterfind("TypeDefinitions/*")}
    defined = {element.get("name") for element in root.iterfind("UnitDefinitions/Unit")}
    said = []
    for variable, typed in _variables(root):
        declared = types.get(typed.get("declaredType"))
        inner = declared[0] if declared is not None and declared.tag == "SimpleType" and len(declared) else declared
        unit = typed.get("unit") or (inner.get("unit") if inner is not None else None)
        if unit in defined:
            continue
        for element in (typed, *variable.iterfind("Alias")):
            if (shown := element.attrib.pop("displayUnit", None)) is not None:
                name = element.get("name") or variable.get("name")
                said.append(f'"{name}" (line {variable.sourceline}) has the display unit "{shown}" without a unit')
    return said


# --- after FMPy has read it -------------------------------------------------------------------------------------------
def complete(model: Any, root: Any) -> None:
    """Put into FMPy's `ModelDescription` what FMPy does not read."""
    of_name = {variable.get("name"): (variable, typed) for variable, typed in _variables(root)}
    for v in model.modelVariables:
        variable, typed = of_name[(v.alias or v).name]
        v.sourceline = variable.sourceline
        relative = typed.get("relativeQuantity")
        v.relativeQuantity = None if relative is None else relative.strip() in ("true", "1")
        v.min, v.max = typed.get("min"), typed.get("max")
        if variable.tag in ("String", "Binary") and v.start is not None:  # FMI 3.0: an element each
            v.start = [start.get("value") for start in variable.iterfind("Start")]


def _variables(root: Any) -> Iterator[tuple[Any, Any]]:
    """Every variable, and the element that holds the attributes of its type: in FMI 3.0, itself."""
    for variable in root.iterfind("ModelVariables/*"):
        if variable.get("name") is not None:
            typed = next((child for child in variable if child.tag in _FMI2_TYPES), variable)
            yield variable, typed


# --- where FMPy could not read it -------------------------------------------------------------------------------------
def mistakes(root: Any) -> Iterator[str]:
    """References that lead nowhere, and what else FMPy stumbles over without saying which variable it was."""
    variables = list(_variables(root))
    types = {element.get("name") for element in root.iterfind("TypeDefinitions/*")}
    if root.get("fmiVersion") == "2.0":
        names = {str(i + 1) for i in range(len(variables))}
        number, noun = "index", "variable number"
        unknowns = root.iterfind("ModelStructure/*/Unknown")
    else:
        names = {variable.get("valueReference") for variable, _ in variables}
        number, noun = "valueReference", "the value reference"
        unknowns = root.iterfind("ModelStructure/*")
    starts = {variable.get("valueReference"): typed.get("start") for variable, typed in variables}
    for variable, typed in variables:
        who = f'"{variable.get("name")}" (line {variable.sourceline})'
        reference = variable.get("valueReference")
        if reference is None or not reference.strip().isdigit():
            yield f"{who} has {'no valueReference' if reference is None else f'the valueReference {reference!r}'}"
        if typed.get("declaredType") not in types | {None}:
            yield f"{who} has the type {typed.get('declaredType')!r}, which is not defined"
        for dimension in variable.iterfind("Dimension"):
            size = dimension.get("valueReference")
            if dimension.get("start") is None and size not in names:
                yield f"{who} has a size given by the value reference {size}, which no variable has"
            elif dimension.get("start") is None and not str(starts[size]).strip().isdigit():
                yield f"{who} has a size given by a variable whose start value is {starts[size] or 'missing'}"
        if typed.get("derivative") not in names | {None}:
            yield f"{who} is the derivative of {noun} {typed.get('derivative')}, which does not exist"
        for clock in (typed.get("clocks") or "").split():
            if clock not in names:
                yield f"{who} belongs to a clock with the value reference {clock}, which does not exist"
    for unknown in unknowns:
        if not isinstance(unknown.tag, str) or unknown.get(number) is None:
            continue
        where = f"line {unknown.sourceline} of the ModelStructure"
        for text in (unknown.get(number), *(unknown.get("dependencies") or "").split()):
            if text not in names:
                yield f"{where} names {noun} {text}, which does not exist"
