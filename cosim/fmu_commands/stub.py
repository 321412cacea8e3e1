"""`cosim fmu wire`: a scenario of one agent around an FMU, its mapping guessed from names, units and derivatives."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.components.component import Description, Interface, Variable
from cosim.components.fmu import describe
from cosim.components.units import Measure, measure
from cosim.fmu_commands import find
from cosim.planning.describing import is_file
from cosim.planning.starts import is_settable
from cosim.scenario.source import dump_on_one_line

_POSITION = re.compile(r"(?i)[qpxyzs]\d*|(pos|phi|theta|alpha|beta|angle)\w*|\w*(position|angle)\w*")
_VELOCITY = re.compile(
    r"(?i)qd\d*|d[qx]\d*|[vw]\d*|xd\d*|(vel|omega)\w*|(phi|theta)d\d*|der\(.*\)|\w+_d(ot)?\d*|\w*(velocity|speed)\w*"
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
        if position:
            break
    return Guess(tuple(force), tuple(position), tuple(velocity))


def _motion(readable: Sequence[Variable], variables: Mapping[str, Variable]) -> tuple[list[Variable], list[Variable]]:
    """Positions and their velocities."""
    rates: dict[str, list[Variable]] = {}
    for variable in variables.values():
        if variable.derivative_of is not None:
            rates.setdefault(variable.derivative_of, []).append(variable)
    candidates = [v for v in readable if _is_position(v)]
    fast = [v for v in readable if _is_velocity(v) and v not in candidates]
    pairs = [(position, _rate_of(position, rates, readable, fast)) for position in candidates]
    known = [(position, rate) for position, rate in pairs if rate is not None]
    if known:
        return [position for position, _ in known], [rate for _, rate in known]
    return candidates, fast if len(candidates) == len(fast) else []


def _is_position(variable: Variable) -> bool:
    by_name = bool(_POSITION.fullmatch(_last(variable.name))) and not _VELOCITY.fullmatch(_last(variable.name))
    return _measures(variable, _POSITION_UNITS) or (variable.measure is None and by_name)


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
    whole = [v for v in declared if v.shape == position.shape and v.causality == "local"]
    found = [*own, *alias, *alike, *whole]
    return found[0] if found else None


def _elements(variable: Variable) -> Iterator[str]:
    if variable.shape and len(variable.references) == variable.size:
        yield from (f"{variable.name}[{i + 1}]" for i in range(variable.size))


def _named_alike(position: str, velocity: str) -> bool:
    """`q1` and `qd1`, `dq1` or `q1_dot`; `x` and `v` alone do not say enough beside others."""
    stem, number = re.fullmatch(r"(.*?)(\d*)", position).groups()  # type: ignore[union-attr]
    forms = (f"{stem}d{number}", f"d{stem}{number}", f"{stem}{number}_dot", f"{stem}_dot{number}", f"{stem}{number}d")
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


# --- the text ---------------------------------------------------------------------------------------------------------


def scenario(fmu: str, role: str, folder: Path) -> str:
    """A scenario of one agent, which `cosim check` accepts as it is.

    Args:
        fmu: a file with a binary for this platform, or the name of a shipped FMU.
        role: what the component is called; nothing is guessed for a `controller`.
        folder: that the scenario will lie in; the file is named relative to it.

    Raises:
        ConfigError: the FMU cannot be used.
    """
    path = find(fmu)
    description = describe(path)
    found = Guess((), (), ()) if role == "controller" else guess(description)
    name = re.sub(r"\W+", "_", path.stem).strip("_") or "agent"
    outputs = {key: list(own) for key, own in (("p", found.position), ("v", found.velocity)) if own}
    inputs = {"u": list(found.force)} if found.force else {}
    relative = Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    return "\n".join([
        *_preface(path.name, role, found),
        f"name: {name}",
        f"period: {_period(description)}",
        "duration: 10 s",
        "agents:",
        f"  {name}:",
        "    components:",
        f"      {role}:",
        f"        fmu: {dump_on_one_line(relative if is_file(fmu) else fmu)}",
        *_mapping("inputs", inputs, description),
        *_mapping("outputs", outputs, description),
        *_starts(description, inputs, outputs),
        *_parameters(description),
        *_uses(role, inputs, outputs, description),
        "",
    ])  # fmt: skip


def _preface(name: str, role: str, found: Guess) -> Iterator[str]:
    yield f"# {name} as an agent of its own: `cosim check` accepts this file, `cosim run` plays it."
    if found == Guess((), (), ()):
        yield f"# In a scenario of yours, put what is under '{role}' in the place of your {role}. Nothing is guessed."
        return
    yield f"# In a scenario of yours, put what is under '{role}' in the place of your {role}, and mind what is guessed:"
    for words, variables in (
        ("forces or torques", found.force),
        ("positions", found.position),
        ("velocities", found.velocity),
    ):
        names = ", ".join(variable.name for variable in variables)
        yield f"#   {words}: {names or 'none found'}"


def _period(description: Description) -> str:
    step = description.usual_step
    return f"{step * 1e9:.0f} ns" if step is not None and not description.variable_step and step > 0.1 else "100 ms"


def _mapping(kind: str, named: Mapping[str, Sequence[Variable]], description: Description) -> Iterator[str]:
    """One of `inputs` and `outputs`; what would be called as it is already is left out."""
    as_it_is = [key for key, own in named.items() if [v.name for v in own] == [key] and own[0].causality != "local"]
    written = {key: [v.name for v in own] for key, own in named.items() if key not in as_it_is}
    if not written:
        return
    yield f"        {kind}:"
    for key, names in written.items():
        value = names[0] if len(names) == 1 else names
        units = {description.variables[name].unit for name in names} - {None}
        yield f"          {_entry(key, value)}" + _remark(", ".join(sorted(map(str, units))))


def _starts(
    description: Description, inputs: Mapping[str, Sequence[Variable]], outputs: Mapping[str, Sequence[Variable]]
) -> Iterator[str]:
    """Of inputs, which are not connected yet, and of states."""
    lines = []
    mapped = {v.name for named in (inputs, outputs) for own in named.values() for v in own}
    for name, own in inputs.items():
        values = [x for v in own for x in _flat(v)]
        lines.append((name, values if len(values) > 1 or own[0].shape else values[0], "until something feeds it"))
    for variable in description.variables.values():
        if variable.causality == "input" and variable.name not in mapped and variable.dtype != "Binary":
            values = list(_flat(variable))
            lines.append((variable.name, values if variable.shape else values[0], "until something feeds it"))
    for name, own in outputs.items():
        if all(is_settable(variable) for variable in own):
            values = [x for v in own for x in _flat(v)]
            lines.append((name, values if len(values) > 1 or own[0].shape else values[0], "at the start"))
    if lines:
        yield "        start:"
        yield from (f"          {_entry(name, value)}  # {remark}" for name, value, remark in lines)


def _parameters(description: Description) -> Iterator[str]:
    """What may be set under `start`, with the values that hold if it is not."""
    own = [v for v in description.variables.values() if v.causality in ("parameter", "structuralParameter")]
    settable = [v for v in own if is_settable(v) and v.start is not None]
    if settable:
        yield "        # Also under 'start', with the FMU's own values:"
    for variable in settable:
        values = list(variable.start or ())
        names = {number: name for name, number in variable.items.items()}
        values = [names.get(x, x) if isinstance(x, int) else x for x in values]
        remark = "; ".join(filter(None, (variable.unit, variable.description)))
        entry = _entry(variable.name, values if variable.shape else values[0])
        yield f"        #   {entry}" + _remark(remark)


def _uses(
    role: str,
    inputs: Mapping[str, Sequence[Variable]],
    outputs: Mapping[str, Sequence[Variable]],
    description: Description,
) -> Iterator[str]:
    """What others of the agent, and other agents, can do with it."""
    if inputs or outputs:
        yield "    # Once there is a controller:"
        yield "    # connections:"
        yield from (f"    #   - {role}.{name} -> controller.{name}" for name in outputs)
        yield from (f"    #   - controller.{name} -> {role}.{name}" for name in inputs)
    if outputs:
        yield f"    publish: {{{', '.join(f'{name}: {role}.{name}' for name in outputs)}}}"
        yield f"    record: [{', '.join(f'{role}.{name}' for name in outputs)}]"
    if Interface.MODEL_EXCHANGE not in description.interfaces and not description.variable_step:
        yield "    # It takes communication steps of one length only: see `coupling` in docs/components.md."


def _flat(variable: Variable) -> list[float | int | bool | str]:
    if variable.start is not None:
        names = {number: name for name, number in variable.items.items()}
        return [names.get(x, x) if isinstance(x, int) and variable.items else x for x in variable.start]
    nothing: float | int | bool | str = "" if variable.dtype == "String" else False
    return [nothing if variable.dtype in ("String", "Boolean") else 0.0] * variable.size


def _entry(key: str, value: object) -> str:
    return f"{dump_on_one_line(key)}: {dump_on_one_line(value)}"


def _remark(text: str) -> str:
    return f"  # {' '.join(text.split())}" if text else ""
