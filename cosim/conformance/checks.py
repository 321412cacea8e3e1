"""The checks: each tries out one thing that whoever runs a component counts on.

A check returns findings, or raises `ComponentError` or `ConfigError` where the component refuses what it should do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from cosim.components.component import Floats, Interface, Value, Variable
from cosim.components.limits import limits_of
from cosim.components.opening import describe
from cosim.conformance.driving import STEPS, Driver, Subject, difference, first_difference
from cosim.conformance.report import Verdict
from cosim.errors import ComponentError, ConfigError
from cosim.planning.starts import FLOATS, is_settable

Said = tuple[Verdict, str]
Check = Callable[[Subject], Iterator[Said]]

_ROUGH = 1e-3
"""From here on, two ways to the same point in time are no longer taken for the same, without convergence."""


def initialise(subject: Subject) -> Iterator[Said]:
    """Instantiate, initialise, read all outputs, terminate twice."""
    with subject.opened() as driver:
        bad = [name for name, values in driver.outputs().items() if not np.isfinite(values).all()]
        driver.component.terminate()
    if bad:
        yield Verdict.PROBLEM, f"not finite after initialisation: {', '.join(bad)}"
    else:
        yield Verdict.OK, "all outputs are finite"


def start_values(subject: Subject) -> Iterator[Said]:
    """Every variable takes the start value that is declared for it: all at once, or else each by itself."""
    refused = 0
    own = subject.plan.start
    settable = [v for v in subject.description.variables.values() if is_settable(v) and v.name not in own]
    settable = [v for v in settable if v.causality != "structuralParameter" and v.start is not None]
    if _refused(subject, {v.name: v.start or () for v in settable}) is not None:
        for variable in settable:
            error = _refused(subject, {variable.name: variable.start or ()})
            if error is not None:
                refused += 1
                yield Verdict.PROBLEM, f"{variable.name}: {_said(error)}"
    if not refused:
        yield Verdict.OK, f"{len(settable)} accepted as they are declared"


def _refused(subject: Subject, start: dict[str, tuple[Value, ...]]) -> ComponentError | None:
    """What the component says against start values."""
    plan = replace(subject.plan, start={**subject.plan.start, **start})
    try:
        with replace(subject, plan=plan).opened():
            return None
    except ComponentError as error:
        return error


def run(subject: Subject) -> Iterator[Said]:
    """A few steps."""
    with subject.opened() as driver:
        seen = driver.run(STEPS, subject.step)
    bad = [name for name in seen[-1] if not all(np.isfinite(outputs[name]).all() for outputs in seen)]
    if bad:
        yield Verdict.PROBLEM, f"not finite within {STEPS} steps of {subject.step:g} s: {', '.join(bad)}"
    else:
        yield Verdict.OK, f"{STEPS} steps of {subject.step:g} s"


def determinism(subject: Subject) -> Iterator[Said]:
    """The same twice."""
    yield _same(_alone(subject), _alone(subject), "two runs alike give the same bits", "two runs alike differ")


def independence(subject: Subject) -> Iterator[Said]:
    """One instance does not feel another one in the same process."""
    alone = _alone(subject)
    with subject.opened() as driver, subject.opened() as other:
        beside = []
        for _ in range(STEPS):
            beside += driver.run(1, subject.step)
            other.advance(subject.step, phase=2.0)
    good = "an instance beside another gives the same bits as alone"
    yield _same(alone, beside, good, "beside another instance, an instance gives something else than alone")


def reset(subject: Subject) -> Iterator[Said]:
    """An instance that is reset is as good as new."""
    from cosim.components.opening import set_start_values

    alone = _alone(subject)
    with subject.opened() as driver:
        driver.run(STEPS, subject.step, phase=2.0)
        driver.component.reset()
        driver.time = 0.0
        set_start_values(driver.component, subject.plan)
        driver.initialise()
        again = driver.run(STEPS, subject.step)
    yield _same(alone, again, "a reset instance gives the same bits as a new one", "after a reset it remembers")


def save_and_restore(subject: Subject) -> Iterator[Said]:
    """What follows from a saved state is the same each time."""
    if not subject.description.can_get_and_set_state:
        yield Verdict.SKIPPED, "it does not say that it can"
        return
    with subject.opened() as driver:
        driver.run(STEPS // 2, subject.step)
        saved, time = driver.component.save(), driver.time
        try:
            first, *others = (_from(driver, saved, time, subject.step, number) for number in range(3))
        finally:
            driver.component.forget(saved)
    said = [_same(first, again, _RESTORED, "what follows a restored state differs") for again in others]
    yield max(said, key=lambda one: one[0] is Verdict.PROBLEM)


_RESTORED = "what follows a restored state has the same bits"


def _from(driver: Driver, saved: object, time: float, step: float, number: int) -> list[dict[str, Floats]]:
    """What follows from there; the first time without going back."""
    if number:
        driver.component.restore(saved)
        driver.time = time
    return driver.run(STEPS, step)


def step_splitting(subject: Subject) -> Iterator[Said]:
    """One communication step, or two of half the length: the same point in time, nearly the same outputs."""
    if not subject.description.variable_step:
        yield Verdict.SKIPPED, "it takes communication steps of one length only"
        return
    coarse, where = _split(subject, subject.step)
    if coarse <= _ROUGH:
        said = f"outputs differ by {coarse:.1g} at most" if coarse else "the same outputs"
        yield Verdict.OK, f"a step of {subject.step:g} s or two halves: {said}"
        return
    fine, _ = _split(subject, subject.step / 8)
    text = f"{where} differs by {coarse:.1g} between a step of {subject.step:g} s and two halves"
    if fine < coarse / 2:
        yield Verdict.NOTE, f"{text}, by {fine:.1g} with an eighth of it"
    else:
        yield Verdict.PROBLEM, f"{text}, and no less ({fine:.1g}) with shorter ones"


def _split(subject: Subject, step: float) -> tuple[float, str]:
    with subject.opened() as driver, subject.opened() as other:
        driver.set_inputs()
        other.set_inputs()
        driver.component.step(0.0, step)
        other.component.step(0.0, step / 2)
        other.component.step(step / 2, step / 2)
        return difference(driver.outputs(), other.outputs())


def evaluation(subject: Subject) -> Iterator[Said]:
    """Derivatives are a function of time, states and inputs, whatever was asked before: integrators try steps out."""
    with subject.opened() as driver:
        if not driver.component.n_states:
            yield Verdict.SKIPPED, "it has no continuous states"
            return
        driver.run(STEPS // 4, subject.step)
        driver.set_inputs()
        states = driver.component.get_states()
        first = driver.derivatives_at(driver.time, states)
        driver.derivatives_at(driver.time + subject.step, states + subject.step * first)
        again = driver.derivatives_at(driver.time, states)
    if not np.isfinite(first).all():
        yield (
            Verdict.PROBLEM,
            f"the derivative of state {int(np.flatnonzero(~np.isfinite(first))[0]) + 1} is not finite",
        )
    elif first.tobytes() != again.tobytes():
        gap, _ = difference({"": first}, {"": again})
        yield Verdict.PROBLEM, f"derivatives at one point differ by {gap:.1g} after others were asked for"
    else:
        yield Verdict.OK, "derivatives depend on time, states and inputs alone"


def dependencies(subject: Subject) -> Iterator[Said]:
    """An output follows an input at once only where that is declared: `joint` orders its evaluations by it."""
    inputs, outputs = subject.inputs, subject.variables("output")
    if not inputs or not outputs:
        yield Verdict.SKIPPED, f"there is no {'output' if inputs else 'continuous input'}"
        return
    exchange = subject.interface is Interface.MODEL_EXCHANGE
    if not exchange and Interface.MODEL_EXCHANGE in subject.description.interfaces:
        yield Verdict.SKIPPED, "tried with Model Exchange"
        return
    undeclared = _undeclared(subject, inputs, outputs)
    for output, found in undeclared:
        at = "at once" if exchange else "during initialisation, perhaps through its start values"
        text = f"{output} follows {found} {at}, which is not declared among its dependencies"
        yield Verdict.PROBLEM if exchange else Verdict.NOTE, text
    silent = [v.name for v in outputs if v.dependencies is None]
    if silent:
        yield Verdict.NOTE, f"{', '.join(silent[:6])}: nothing is declared, so that every input is assumed"
    if not undeclared and len(silent) < len(outputs):
        yield Verdict.OK, "no output follows an input at once that is not declared"


def _undeclared(subject: Subject, inputs: list[Variable], outputs: list[Variable]) -> list[tuple[str, str]]:
    """(output, input) where the one changes with the other and nothing else, which is not declared."""
    found = []
    with subject.opened(started=False) as driver:
        driver.component.enter_initialization(0.0, 1e4)
        if subject.interface is Interface.MODEL_EXCHANGE:
            driver.leave_initialisation()
        for variable in inputs:
            driver.set_inputs()
            before = driver.outputs()
            driver.component.set(variable, subject.signal(variable, 0.7, 1.0) + 0.25)
            after = driver.outputs()
            for output in outputs:
                changes = before[output.name].tobytes() != after[output.name].tobytes()
                if changes and output.dependencies is not None and variable.name not in output.dependencies:
                    found.append((output.name, variable.name))
    return found


def bad_values(subject: Subject) -> Iterator[Said]:
    """NaN and infinity at an input: an error, or not finite outputs, but no crash and no hang."""
    if not subject.inputs:
        yield Verdict.SKIPPED, "there is no continuous input"
        return
    said: dict[str, list[str]] = {}
    for variable in subject.inputs:
        for value, name in ((np.nan, "NaN"), (np.inf, "infinity")):
            said.setdefault(_given(subject, variable, np.full(variable.size, value)), []).append(
                f"{name} at {variable.name}"
            )
    for outcome, cases in said.items():
        shown = ", ".join(cases[:4]) + (f" and {len(cases) - 4} more" if len(cases) > 4 else "")
        yield Verdict.NOTE if "finite" in outcome else Verdict.OK, f"{shown}: {outcome}"


def _given(subject: Subject, variable: Variable, values: Floats) -> str:
    """What comes of these values, and whether an instance that is opened afterwards still works."""
    try:
        with subject.opened() as driver:
            driver.run(1, subject.step)
            driver.component.set(variable, values)
            if subject.interface is Interface.CO_SIMULATION:
                driver.component.step(driver.time, subject.step)
            seen = list(driver.outputs().values())
            if subject.interface is Interface.MODEL_EXCHANGE:
                seen.append(driver.component.derivatives())
        finite = all(np.isfinite(values).all() for values in seen)
        outcome = "everything stays finite: it is not noticed" if finite else "what comes out is NaN or infinite"
    except ComponentError:
        outcome = "refused"
    with subject.opened() as driver:
        driver.run(1, subject.step)
    return outcome


def dimensions(subject: Subject) -> Iterator[Said]:
    """Arrays follow the structural parameters that size them."""
    structural = [v for v in subject.variables("structuralParameter") if v.dtype not in FLOATS]
    if not structural:
        yield Verdict.SKIPPED, "there is no structural parameter"
        return
    plan = subject.plan
    for parameter in structural:
        for value in _tried(parameter, plan.start.get(parameter.name)):
            described = describe(plan.path, plan.python, {**_sizes(subject), parameter.name: value})
            sizes = {v.name: v.size for v in described.variables.values()}
            start = {name: values for name, values in plan.start.items() if len(values) == sizes[name]}
            start[parameter.name] = (value,) * parameter.size
            try:
                with replace(subject, plan=replace(plan, description=described, start=start)).opened() as driver:
                    driver.set_inputs()
                    driver.run(2, subject.step)
            except ComponentError as error:
                yield Verdict.PROBLEM, f"{parameter.name} = {_shown(parameter, value)}: {_said(error)}"
                return
    yield Verdict.OK, f"{', '.join(v.name for v in structural)} can be changed"


def _tried(parameter: Variable, given: Sequence[Value] | None) -> list[int]:
    """Other values of a structural parameter, within its limits."""
    if parameter.dtype == "Boolean":
        return [True, False]
    if parameter.dtype == "Enumeration":
        return list(parameter.items.values())
    usual = int((given or parameter.start or (1,))[0])
    low, high = limits_of(parameter, 0)
    return sorted(value for value in {1, usual + 1, usual + 3} if low <= value <= high) or [usual]


def _shown(parameter: Variable, value: int) -> str:
    if parameter.dtype == "Boolean":
        return "true" if value else "false"
    return next((name for name, number in parameter.items.items() if number == value), str(value))


def _sizes(subject: Subject) -> dict[str, int]:
    known = ((v.name, subject.plan.start.get(v.name)) for v in subject.variables("structuralParameter"))
    return {name: value[0] for name, value in known if value and isinstance(value[0], int)}


FIRST = "initialise"
"""The check that all others begin with."""
CHECKS: dict[str, Check] = {
    FIRST: initialise,
    "start values": start_values,
    "run": run,
    "determinism": determinism,
    "independence": independence,
    "reset": reset,
    "save and restore": save_and_restore,
    "step splitting": step_splitting,
    "evaluation": evaluation,
    "dependencies": dependencies,
    "dimensions": dimensions,
    "bad values": bad_values,
}
"""In their order; what follows from one that failed is tried all the same, unless nothing can be without it."""
_ONLY = {"step splitting": Interface.CO_SIMULATION, "evaluation": Interface.MODEL_EXCHANGE}


def checks_of(interface: Interface) -> list[str]:
    """Those that say something of components that are stepped in this way."""
    return [name for name in CHECKS if _ONLY.get(name, interface) is interface]


def findings(name: str, subject: Subject) -> tuple[list[Said], bool]:
    """What a check finds, and whether the component let it come to its end; that it refuses is a finding, too."""
    found: list[Said] = []
    try:
        found.extend(CHECKS[name](subject))
    except ComponentError as error:
        found.append((Verdict.PROBLEM, _said(error)))
    except ConfigError as error:
        found.append((Verdict.PROBLEM, "; ".join(problem.message for problem in error.problems)))
    else:
        return found, True
    return found, False


def _alone(subject: Subject) -> list[dict[str, Floats]]:
    with subject.opened() as driver:
        return driver.run(STEPS, subject.step)


def _same(one: list[dict[str, Floats]], other: list[dict[str, Floats]], good: str, bad: str) -> Said:
    found = first_difference(one, other)
    if found is None:
        return Verdict.OK, good
    number, name, gap = found
    return Verdict.PROBLEM, f"{bad}: {name} by {gap:.1g} after step {number}"


def _said(error: ComponentError) -> str:
    return error.message + (f" (its last log line: {error.log})" if error.log else "")
