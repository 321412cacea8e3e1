"""What of a component is a force, a position, a velocity: guessed from derivatives, units and names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from cosim.components.component import Description, Variable
from cosim.components.units import BASE, Measure, measure

_POSITION = re.compile(r"[qpxyzs]\d*|(?i:(pos|phi|theta|alpha|beta|angle)\w*|\w*(position|angle)\w*)")
_BESIDE_X = re.compile(r"(?P<before>|.*\.)[yz](?P<number>\d*)")
"""Coordinates; alone, `y` is what blocks of Modelica call whatever they give."""
_VELOCITY = re.compile(
    r"(?i)qd\d*|d[qx]\d*|[vw]\d*|xd\d*|(vel|omega)\w*|(phi|theta)d\d*|der\(.*\)|d_\w+|\w+_d(ot)?\d*|"
    r"\w*(velocity|speed)\w*"
)
_FORCE = re.compile(r"(?i)u\d*|f\d*|tau\w*|torque\w*|force\w*|\w*(torque|force)\w*")
_POSITION_UNITS, _VELOCITY_UNITS, _FORCE_UNITS = ("m", "rad"), ("m/s", "rad/s"), ("N", "N.m")


@dataclass(frozen=True)
class Guess:
    """What seems to be what; names of the FMU's own variables.

    Attributes:
        position, velocity: as many of each, pairwise, or none of velocity.
    """

    force: tuple[Variable, ...]
    position: tuple[Variable, ...]
    velocity: tuple[Variable, ...]


def guess(description: Description) -> Guess:
    """Which variables are forces, positions and velocities: by derivatives and units first, then by names."""
    variables = description.variables
    inputs = [v for v in variables.values() if v.causality == "input" and v.dtype in ("Float64", "Float32")]
    force = [v for v in inputs if _measures(v, _FORCE_UNITS)] or [
        v for v in inputs if v.measure is None and _FORCE.fullmatch(_last(v.name))
    ]
    for causalities in (("output",), ("output", "local")):
        readable = [v for v in variables.values() if v.causality in causalities and v.dtype.startswith("Float")]
        position, velocity = _motion(readable, variables)
        if "local" in causalities and not velocity:
            position = []  # among hundreds of variables, names alone say nothing
        if position:
            break
    return Guess(tuple(force), tuple(position), tuple(velocity))


def _motion(readable: Sequence[Variable], variables: Mapping[str, Variable]) -> tuple[list[Variable], list[Variable]]:
    """Positions and their velocities: those of which something says so, the others in the order of the file."""
    rates: dict[str, list[Variable]] = {}
    for variable in variables.values():
        if variable.derivative_of is not None:
            rates.setdefault(variable.derivative_of, []).append(variable)
    candidates = [v for v in readable if _is_position(v) and not _lacks_its_x(v, variables)]
    fast = [v for v in readable if _is_velocity(v) and v not in candidates]
    found: dict[str, Variable] = {}
    for position in candidates:
        free = [v for v in fast if v not in found.values()]
        if (rate := _rate_of(position, rates, readable, free)) is not None:
            found[position.name] = rate
    alone = [v for v in candidates if v.name not in found]
    alone = [v for v in alone if v.name in rates] or alone  # an output that is no state may be the same in other units
    free = [v for v in fast if v not in found.values()]
    if len(alone) == len(free) and all(map(_may_be_rate, free, alone)):
        found |= {position.name: rate for position, rate in zip(alone, free, strict=True)}
    for position in candidates:
        whole = [v for v in rates.get(position.name, ()) if v.shape == position.shape and v.causality == "local"]
        if whole:
            found.setdefault(position.name, whole[0])
    if not found:
        return candidates, []
    return [v for v in candidates if v.name in found], [found[v.name] for v in candidates if v.name in found]


def _is_position(variable: Variable) -> bool:
    by_name = bool(_POSITION.fullmatch(_last(variable.name))) and not _VELOCITY.fullmatch(_last(variable.name))
    return _measures(variable, _POSITION_UNITS) or (variable.measure is None and by_name)


def _lacks_its_x(variable: Variable, variables: Mapping[str, Variable]) -> bool:
    match = _BESIDE_X.fullmatch(variable.name) if variable.measure is None else None
    return match is not None and f"{match['before']}x{match['number']}" not in variables


def _is_velocity(variable: Variable) -> bool:
    by_name = bool(_VELOCITY.fullmatch(_last(variable.name)))
    return _measures(variable, _VELOCITY_UNITS) or (variable.measure is None and by_name)


def _rate_of(
    position: Variable,
    rates: Mapping[str, Sequence[Variable]],
    readable: Sequence[Variable],
    fast: Sequence[Variable],
) -> Variable | None:
    """Its derivative by declaration, one that shares that one's value reference, or one whose name says so."""
    declared = [*rates.get(position.name, ()), *(v for name in _elements(position) for v in rates.get(name, ()))]
    own = [v for v in readable if any(v is rate for rate in declared)]
    references = {reference for v in declared for reference in v.references}
    alias = [v for v in fast if set(v.references) <= references]
    alike = [v for v in fast if v.shape == position.shape and _named_alike(position.name, v.name)]
    found = [*own, *alias, *alike]
    return found[0] if found else None


def _may_be_rate(velocity: Variable, position: Variable) -> bool:
    """Whether shapes and units, where they are known, allow it."""
    if velocity.shape != position.shape:
        return False
    if velocity.measure is None or position.measure is None:
        return True
    exponents = zip(position.measure.exponents, BASE, strict=True)
    return velocity.measure.exponents == tuple(n - (base == "s") for n, base in exponents)


def _elements(variable: Variable) -> Iterator[str]:
    if variable.shape and len(variable.references) == variable.size:
        yield from (f"{variable.name}[{i + 1}]" for i in range(variable.size))


def _named_alike(position: str, velocity: str) -> bool:
    """`q1` and `qd1`, `dq1` or `q1_dot`; `x` and `v` alone do not say enough beside others."""
    stem, number = re.fullmatch(r"(.*?)(\d*)", position).groups()  # type: ignore[union-attr]
    forms = (
        *(f"{stem}d{number}", f"d{stem}{number}", f"d_{stem}{number}"),
        *(f"{stem}{number}_dot", f"{stem}_dot{number}", f"{stem}{number}d"),
    )
    pairs = (("p", "v"), ("x", "v"), ("s", "v"), ("phi", "w"), ("phi", "omega"), ("theta", "omega"), ("q", "v"))
    by_letter = any(stem.endswith(a) and velocity == stem[: -len(a)] + b + number for a, b in pairs)
    return velocity in forms or velocity == f"der({position})" or by_letter


def _measures(variable: Variable, units: Iterable[str]) -> bool:
    wanted = [measure(unit) for unit in units]
    exponents = variable.measure.exponents if isinstance(variable.measure, Measure) else None
    return any(unit is not None and unit.exponents == exponents for unit in wanted)


def _last(name: str) -> str:
    """The part of a name after its last dot."""
    return name.rsplit(".", 1)[-1]
