"""`cosim fmu wire`: a scenario of one agent around an FMU, its variables mapped as far as one can guess."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.components.component import Description, Interface, Value, Variable
from cosim.components.fmu import describe
from cosim.fmu_commands import find
from cosim.fmu_commands.guessing import Guess, guess
from cosim.planning.describing import is_file
from cosim.planning.starts import FLOATS, INTEGERS, NUMERIC, is_settable
from cosim.scenario.source import dump_on_one_line
from network.units import NANOSECONDS_PER_SECOND, format_duration

_PERIOD_NS, _DURATION_NS, _FEWEST_TICKS = 100_000_000, 10_000_000_000, 10
_MOST_LOCALS = 12
_NOTHING: Mapping[str, Value] = {
    **dict.fromkeys(FLOATS, 0.0),
    **dict.fromkeys(INTEGERS, 0),
    "Boolean": False,
    "String": "",
}
_REACHED = ("input", "output", "parameter", "structuralParameter")
"""What a scenario should still be able to name."""


@dataclass(frozen=True)
class _Names:
    """What the stub calls the FMU's variables.

    Attributes:
        inputs, outputs: names of the stub to variables.
        aside: those of them that only make room for other names.
    """

    inputs: Mapping[str, Sequence[Variable]]
    outputs: Mapping[str, Sequence[Variable]]
    aside: frozenset[str]


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
    names = _names(description, found)
    agent = re.sub(r"\W+", "_", path.stem).strip("_") or "agent"
    period_ns = _period_ns(description)
    return "\n".join([
        *_preface(path.name, role, found),
        f"name: {dump_on_one_line(agent)}",
        f"period: {format_duration(period_ns)}",
        f"duration: {format_duration(period_ns * max(math.ceil(_DURATION_NS / period_ns), _FEWEST_TICKS))}",
        "agents:",
        f"  {agent}:",
        "    components:",
        f"      {role}:",
        f"        fmu: {dump_on_one_line(_relative(path, folder) if Path(fmu).is_file() else fmu)}",
        *_mapping("inputs", names.inputs),
        *_mapping("outputs", names.outputs),
        *_starts(description, names),
        *_parameters(description),
        *_uses(role, names),
        *_records(role, description, names),
        *_limits(description),
        "",
    ])  # fmt: skip


def _relative(path: Path, folder: Path) -> str:
    relative = Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    return relative if is_file(relative) else f"./{relative}"


def _names(description: Description, found: Guess) -> _Names:
    """The usual names for what is guessed. A name that hides an input or output of the FMU's own takes that along under
    another name; where it would hide what cannot be mapped, something longer is used.
    """
    own = description.variables
    guessed = {v.name for variables in (found.force, found.position, found.velocity) for v in variables}
    inputs: dict[str, Sequence[Variable]] = {}
    outputs: dict[str, Sequence[Variable]] = {}
    aside: set[str] = set()

    def free(name: str) -> str:
        return free(f"{name}_") if name in own or name in inputs or name in outputs else name

    for usual, longer, variables, named in (
        ("u", "force", found.force, inputs),
        ("p", "position", found.position, outputs),
        ("v", "velocity", found.velocity, outputs),
    ):
        hidden = own.get(usual)
        if not variables:
            continue
        if hidden is None or hidden.name in guessed or hidden.causality not in _REACHED:
            named[usual] = variables
        elif hidden.causality in ("input", "output") and hidden.dtype in NUMERIC:
            named[usual] = variables
            name = free(f"own_{usual}")
            aside.add(name)
            (inputs if hidden.causality == "input" else outputs)[name] = (hidden,)
        else:
            named[free(longer)] = variables
    return _Names(inputs, outputs, frozenset(aside))


# --- the text ---------------------------------------------------------------------------------------------------------


def _preface(name: str, role: str, found: Guess) -> Iterator[str]:
    yield f"# {_plain(name)} as an agent of its own: `cosim check` accepts this file, `cosim run` plays it."
    if found == Guess((), (), ()):
        yield f"# In a scenario of yours, put what is under '{role}' in the place of your {role}. Nothing is guessed."
        return
    yield f"# In a scenario of yours, put what is under '{role}' in the place of your {role}, and mind what is guessed:"
    for words, variables in (
        ("forces or torques", found.force),
        ("positions", found.position),
        ("velocities", found.velocity),
    ):
        names = ", ".join(_plain(variable.name) for variable in variables)
        yield f"#   {words}: {names or 'none found'}"


def _period_ns(description: Description) -> int:
    """The usual one, or the next that consists of whole steps where the FMU takes steps of one length only."""
    step = description.internal_step
    if step is None and not description.variable_step:
        step = description.usual_step
    if step is None or Interface.MODEL_EXCHANGE in description.interfaces:
        return _PERIOD_NS
    step_ns = max(round(step * NANOSECONDS_PER_SECOND), 1)
    return math.ceil(_PERIOD_NS / step_ns) * step_ns


def _mapping(kind: str, named: Mapping[str, Sequence[Variable]]) -> Iterator[str]:
    """One of `inputs` and `outputs`; what would be called as it is already is left out."""
    as_it_is = [key for key, own in named.items() if [v.name for v in own] == [key] and own[0].causality != "local"]
    written = {key: own for key, own in named.items() if key not in as_it_is}
    if not written:
        return
    yield f"        {kind}:"
    for key, own in written.items():
        names = [v.name for v in own]
        units = sorted({v.unit for v in own if v.unit is not None})
        yield f"          {_entry(key, names[0] if len(names) == 1 else names)}" + _remark(", ".join(units))


def _starts(description: Description, names: _Names) -> Iterator[str]:
    """Of inputs, which are not connected yet, and of states."""
    mapped = {v.name for named in (names.inputs, names.outputs) for own in named.values() for v in own}
    inputs: dict[str, Sequence[Variable]] = {
        v.name: (v,) for v in description.variables.values() if v.causality == "input" and v.name not in mapped
    }
    states = {
        name: own for name, own in names.outputs.items() if name not in names.aside and all(map(is_settable, own))
    }
    lines = []
    for named, remark in (({**names.inputs, **inputs}, "until something feeds it"), (states, "at the start")):
        for name, own in named.items():
            values = [x for v in own for x in _flat(v)]
            if values and len(values) == sum(v.size for v in own):
                value = values if len(own) > 1 or own[0].shape else values[0]
                lines.append(f"          {_entry(name, value)}  # {remark}")
    if lines:
        yield "        start:"
        yield from lines


def _parameters(description: Description) -> Iterator[str]:
    """What may be set under `start`, with the values that hold if it is not."""
    own = [v for v in description.variables.values() if v.causality in ("parameter", "structuralParameter")]
    settable = [v for v in own if is_settable(v) and v.start]
    if settable:
        yield "        # Also under 'start', with the FMU's own values:"
    for variable in settable:
        values = _flat(variable) or list(variable.start or ())
        remark = "; ".join(filter(None, (variable.unit, variable.description)))
        yield f"        #   {_entry(variable.name, values if variable.shape else values[0])}" + _remark(remark)


def _uses(role: str, names: _Names) -> Iterator[str]:
    """What others of the agent, and other agents, can do with it."""
    inputs = [name for name in names.inputs if name not in names.aside]
    outputs = [name for name in names.outputs if name not in names.aside]
    if inputs or outputs:
        yield "    # Once there is a controller:"
        yield "    # connections:"
        yield from (f"    #   - {role}.{name} -> controller.{name}" for name in outputs)
        yield from (f"    #   - controller.{name} -> {role}.{name}" for name in inputs)
    if outputs:
        yield f"    publish: {{{', '.join(f'{name}: {role}.{name}' for name in outputs)}}}"


def _records(role: str, description: Description, names: _Names) -> Iterator[str]:
    """Outputs are recorded without a word; of an FMU that has none, local variables."""
    own = [v for v in description.variables.values() if v.dtype in NUMERIC and v.size]
    if names.outputs or any(v.causality == "output" for v in own):
        yield "    # Every output is recorded; a list under 'record' chooses."
        return
    local = [v for v in own if v.causality == "local" and v.variability != "constant" and v.derivative_of is None]
    if local:
        yield "    record:  # there are no outputs; these are the first local variables"
        yield from (f"      - {dump_on_one_line(f'{role}.{v.name}')}" for v in local[:_MOST_LOCALS])


def _limits(description: Description) -> Iterator[str]:
    if Interface.MODEL_EXCHANGE not in description.interfaces and not description.variable_step:
        yield "    # It takes communication steps of one length only: see `coupling` in docs/components.md."


def _flat(variable: Variable) -> list[Value]:
    """The start values as a scenario writes them; where none is declared, some of that type; empty if there is none."""
    items = {number: name for name, number in variable.items.items()}
    if variable.start is None:
        usual = next(iter(items.values()), None) if variable.dtype == "Enumeration" else _NOTHING.get(variable.dtype)
        return [] if usual is None else [usual] * variable.size
    if variable.dtype == "Enumeration":
        return [items[x] for x in variable.start if isinstance(x, int) and x in items]
    return [x for x in variable.start if not (isinstance(x, float) and math.isnan(x))]


def _entry(key: str, value: object) -> str:
    return f"{dump_on_one_line(key)}: {dump_on_one_line(value)}"


def _remark(text: str) -> str:
    return f"  # {_plain(text)}" if text else ""


def _plain(text: str) -> str:
    """On one line, without what YAML does not allow in a comment."""
    return "".join(c for c in " ".join(text.split()) if c.isprintable())
