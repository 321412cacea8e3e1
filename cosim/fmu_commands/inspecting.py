"""`cosim fmu inspect`: what an FMU says of itself, and what is wrong with it, as a text that people read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.components.component import Interface, Value, Variable
from cosim.components.fmu import usable_step
from cosim.components.fmu.archive import refuse
from cosim.components.fmu.library import PLATFORM, File, findings, read, runs_in_python
from cosim.components.fmu.variables import variables_of
from cosim.components.limits import odd_limits

_KINDS = (
    ("inputs", ("input",)),
    ("outputs", ("output",)),
    ("structural parameters", ("structuralParameter",)),
    ("parameters", ("parameter",)),
    ("calculated parameters", ("calculatedParameter",)),
    ("local variables", ("local", "independent")),
)
_CAPABILITIES = (
    ("canHandleVariableCommunicationStepSize", "take communication steps of any length"),
    ("canGetAndSetFMUstate", "save and restore its state"),
    ("canSerializeFMUstate", "write its state to bytes"),
    ("providesDirectionalDerivative", "give directional derivatives"),
    ("providesDirectionalDerivatives", "give directional derivatives"),
    ("hasEventMode", "handle events between communication steps"),
    ("canReturnEarlyAfterIntermediateUpdate", "return early from a step"),
    ("canInterpolateInputs", "interpolate its inputs"),
)
_TOOL = "needs the tool that made it"
_LIMITS = (
    ("canBeInstantiatedOnlyOncePerProcess", "only one instance per process"),
    ("canNotUseMemoryManagementFunctions", "does not use the importer's memory functions"),
    ("needsExecutionTool", _TOOL),
)


def report(path: Path, *, everything: bool = False) -> str:
    """The text.

    Args:
        path: of the FMU; it need not have a binary for this platform.
        everything: local variables as well, of which there may be thousands.

    Raises:
        ConfigError: it is no FMU, or one of FMI 1.0.
    """
    file = read(path)
    try:
        variables = variables_of(file.model, {})
    except ValueError as error:
        raise refuse(path, f"has a broken modelDescription.xml: {error}") from error
    sections = [_head(file, path), _variables(variables, everything=everything), _problems(file, path, variables)]
    return "\n\n".join("\n".join(section) for section in sections if section)


# --- the file ---------------------------------------------------------------------------------------------------------


def _head(file: File, path: Path) -> list[str]:
    model = file.model
    tool = f", made by {model.generationTool}" if model.generationTool else ""
    lines = [f"{path.name}: {model.modelName}, FMI {model.fmiVersion}{tool}"]
    if model.description:
        lines.append(f"  {model.description}")
    lines.append(_line("file", f"{path.stat().st_size:,} bytes, SHA-256 {file.archive.sha256}"))
    lines += [_line("type", _interface(file, interface)) for interface in file.implementations]
    if model.scheduledExecution is not None:
        lines.append(_line("type", "Scheduled Execution, which is not used here"))
    lines.append(_line("platforms", ", ".join(_platforms(file)) or "none: it holds no library"))
    for implementation, where in _grouped(file):
        lines.append(_line("can", ", ".join(implementation) or "nothing beyond what every FMU can", where))
    lines += [_line("limits", text) for text in _limits(file)]
    if (experiment := _experiment(model.defaultExperiment)) is not None:
        lines.append(_line("experiment", experiment))
    return lines


def _line(label: str, text: str, where: str = "") -> str:
    return f"  {label:<12}{where}{text}"


def _interface(file: File, interface: Interface) -> str:
    if interface is Interface.CO_SIMULATION:
        step = getattr(file.implementations[interface], "fixedInternalStepSize", None)
        return f"Co-Simulation{f', steps of {step} s inside' if step else ''}"
    states, indicators = file.model.numberOfContinuousStates, file.model.numberOfEventIndicators
    return f"Model Exchange, {_count(states, 'continuous state')}, {_count(indicators, 'event indicator')}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _platforms(file: File) -> Iterator[str]:
    for platform in file.archive.platforms:
        yield f"{platform} (this one)" if platform == file.library_folder else platform


def _grouped(file: File) -> Iterator[tuple[list[str], str]]:
    """What each interface can do, once if it is the same for all."""
    said = {interface: _capabilities(implementation) for interface, implementation in file.implementations.items()}
    if len({tuple(texts) for texts in said.values()}) == 1:
        yield next(iter(said.values())), ""
        return
    for interface, texts in said.items():
        yield texts, "Co-Simulation: " if interface is Interface.CO_SIMULATION else "Model Exchange: "


def _capabilities(implementation: Any) -> list[str]:
    return [words for attribute, words in _CAPABILITIES if getattr(implementation, attribute, False)]


def _limits(file: File) -> list[str]:
    found = {
        words: None
        for implementation in file.implementations.values()
        for attribute, words in _LIMITS
        if getattr(implementation, attribute, False)
    }
    if runs_in_python(file.model):
        found = {words: None for words in found if words != _TOOL}
        found["needs Python, and the packages that its script imports"] = None
    co_simulation = file.implementations.get(Interface.CO_SIMULATION)
    if co_simulation is not None and not co_simulation.canHandleVariableCommunicationStepSize:
        found["communication steps of one length only"] = None
    return list(found)


def _experiment(experiment: Any) -> str | None:
    if experiment is None:
        return None
    parts = []
    if experiment.stopTime is not None:
        parts.append(f"{experiment.startTime or 0} s to {experiment.stopTime} s")
    if experiment.stepSize is not None:
        parts.append(f"steps of {experiment.stepSize} s")
    if experiment.tolerance is not None:
        parts.append(f"tolerance {experiment.tolerance}")
    return ", ".join(parts) or None


# --- variables --------------------------------------------------------------------------------------------------------


def _variables(variables: Mapping[str, Variable], *, everything: bool) -> list[str]:
    groups: list[tuple[str, list[Variable]]] = []
    hidden = 0
    for title, causalities in _KINDS:
        found = [variable for variable in variables.values() if variable.causality in causalities]
        if title == "local variables" and not everything:
            hidden = len(found)
        elif found:
            groups.append((title, found))
    rows = [(title, [_row(variable) for variable in found]) for title, found in groups]
    widths = [min(40, max((len(row[column]) for _, block in rows for row in block), default=0)) for column in range(5)]
    lines: list[str] = []
    for title, block in rows:
        lines += ["", title] if lines else [title]
        lines += [_aligned(row, widths) for row in block]
    if hidden:
        lines += ["", f"{_count(hidden, 'local variable')} more: --all"]
    return lines


def _row(variable: Variable) -> tuple[str, ...]:
    shape = "".join(f"[{n}]" for n in variable.shape)
    variability = "" if variable.variability == _usual(variable) else variable.variability or ""
    notes = [variable.description]
    if variable.derivative_of:
        notes.insert(0, f"derivative of {variable.derivative_of}")
    if variable.items:
        notes.append(f"one of {', '.join(variable.items)}")
    kind = f"{variable.dtype} {variability}".strip()
    return variable.name + shape, kind, variable.unit or "-", _start(variable), "; ".join(filter(None, notes))


def _usual(variable: Variable) -> str:
    if variable.causality in ("parameter", "structuralParameter", "calculatedParameter"):
        return "fixed"
    return "continuous" if variable.dtype.startswith("Float") else "discrete"


def _start(variable: Variable) -> str:
    """The start value; of an array whose elements are all alike, one."""
    if variable.start is None:
        return "-"
    names: dict[Value, str] = {number: name for name, number in variable.items.items()}
    texts = [f"{x:.6g}" if isinstance(x, float) else names.get(x, str(x)) for x in variable.start]
    if len(set(texts)) == 1:
        return texts[0]
    return ", ".join(texts if len(texts) <= 4 else [*texts[:3], "…"])


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    columns = [f"{text:<{width}}" for text, width in zip(row[:-1], widths, strict=False)]
    return f"  {'  '.join([*columns, row[-1]])}".rstrip()


# --- problems ---------------------------------------------------------------------------------------------------------


def _problems(file: File, path: Path, variables: Mapping[str, Variable]) -> list[str]:
    found = [*_unusable(file), *findings(path), *odd_limits(variables), *_doubtful(variables)]
    if not found:
        return ["no problems found"]
    return [_count(len(found), "problem"), *(f"  {text}" for text in found)]


def _unusable(file: File) -> Iterator[str]:
    if file.library_folder is None and file.archive.whole:
        yield f"no library for this platform ({PLATFORM}): it cannot be run here"
    for identifier, library in file.libraries.items() if file.library_folder is not None else ():
        if Path(library).stem != identifier:
            yield f"its library is called {library} and its model identifier {identifier}: other tools may not load it"
    co_simulation = file.implementations.get(Interface.CO_SIMULATION)
    for what, step in (
        ("a fixedInternalStepSize", getattr(co_simulation, "fixedInternalStepSize", None)),
        ("a default experiment with steps", getattr(file.model.defaultExperiment, "stepSize", None)),
    ):
        if step is not None and not _is_step(step):
            yield f"{what} of {step} s, which is ignored"
    if not file.archive.whole:
        yield f"only the description of {file.archive.original_name}: it can be planned with, but not run"


def _is_step(written: str | float) -> bool:
    try:
        return usable_step(written) is not None
    except ValueError:
        return False


def _doubtful(variables: Mapping[str, Variable]) -> Iterator[str]:
    unknown = {v.unit: None for v in variables.values() if v.unit is not None and v.measure is None}
    if unknown:
        yield f"units that nothing defines, so that they do not convert: {', '.join(map(str, unknown))}"
    silent = [v.name for v in variables.values() if v.causality == "output" and v.dependencies is None]
    has_inputs = any(v.causality == "input" for v in variables.values())
    if silent and has_inputs:
        shown = ", ".join(silent[:6]) + (", …" if len(silent) > 6 else "")
        yield f"outputs that may depend directly on every input, as nothing else is declared: {shown}"
