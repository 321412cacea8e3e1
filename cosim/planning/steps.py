"""The micro step of an agent: it divides the period, and is a multiple of the steps that its components make inside."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass

from cosim.components.component import Description
from cosim.plan import Method
from cosim.planning.problems import Problems
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import Node
from cosim.scenario.spec import CouplingSpec
from network.units import NANOSECONDS_PER_SECOND, format_duration

_DEFAULT_STEP_NS = {Method.JOINT: 5_000_000}
_OTHER_STEP_NS = 1_000_000
_MOST_STEPS_TO_TRY = 10_000


@dataclass(frozen=True)
class OwnStep:
    """What a Co-Simulation component asks of its steps, which must all have one length.

    Attributes:
        unit_ns: the micro step must be a multiple of it; 1 where any length will do.
        usual_ns: what the component is usually stepped with, or None.
        halved: it makes two half steps per micro step (`midpoint`).
    """

    unit_ns: int
    usual_ns: int | None
    halved: bool

    @property
    def parts(self) -> int:
        """How many steps it makes per micro step."""
        return 2 if self.halved else 1


def own_steps(descriptions: Mapping[str, Description], halved: Set[str]) -> dict[str, OwnStep]:
    """The components that accept steps of one length only, or make steps of a fixed one inside.

    Args:
        descriptions: of the components.
        halved: those that make two half steps per micro step.
    """
    found = {}
    for name, description in descriptions.items():
        if description.variable_step and description.internal_step is None:
            continue
        parts = 2 if name in halved else 1
        internal_ns, usual = _whole_ns(description.internal_step), description.usual_step
        usual_ns = None if usual is None else max(round(usual * NANOSECONDS_PER_SECOND), 1) * parts
        found[name] = OwnStep((internal_ns or 1) * parts, usual_ns, halved=parts > 1)
    return found


def _whole_ns(seconds: float | None) -> int | None:
    """Seconds in nanoseconds; None where they are no whole number of them, nearly."""
    if seconds is None:
        return None
    nanoseconds = round(seconds * NANOSECONDS_PER_SECOND)
    if nanoseconds < 1 or not math.isclose(nanoseconds / NANOSECONDS_PER_SECOND, seconds):
        return None
    return nanoseconds


def choose_step(  # noqa: PLR0917
    spec: CouplingSpec,
    method: Method,
    node: Node,
    demands: Mapping[str, OwnStep],
    period_ns: int,
    problems: Problems,
    slowest_ns: int = 0,
) -> int | None:
    """The micro step given, else the usual one; None, and a problem, where there is none that fits.

    Args:
        spec: the coupling as written.
        method: of the coupling.
        node: where the agents are written.
        demands: what components ask for.
        period_ns: T.
        problems: takes what is wrong.
        slowest_ns: the longest step that a component is given of its own.
    """
    where, period = node.locate("coupling", "step"), format_duration(period_ns)
    controlled = spec.tolerance is not None
    unit_ns = math.lcm(*(demand.unit_ns for demand in demands.values()))
    if period_ns % unit_ns:
        fitting = [format_duration(n * unit_ns) for n in (period_ns // unit_ns, period_ns // unit_ns + 1) if n]
        reason = _why(demands, unit_ns)
        problems.error(f"{reason}, and the period {period} is no multiple of that; {' or '.join(fitting)} is", where)
        return None
    if spec.step is None and controlled:
        return period_ns
    if spec.step is None:
        usual = max(_usual(method, demands), slowest_ns)
        fitting_ns = _fitting(period_ns, unit_ns, usual)
        if fitting_ns is None:
            problems.error(f"no usual step divides the period {period}; give 'step' under 'coupling'", node.where)
        elif fitting_ns != usual:
            _warn_of_other(demands, usual, fitting_ns, period, node, problems)
        return fitting_ns
    step = format_duration(spec.step)
    if spec.step > period_ns:
        problems.error(f"the step {step} is longer than the period {period}", where)
        return None
    adaptive = controlled or (method is Method.JOINT and spec.integrator == "dormand-prince")
    if period_ns % spec.step and not adaptive:
        problems.error(f"the step {step} does not divide the period {period}{_hint(period_ns, unit_ns, spec)}", where)
        return None
    if spec.step % unit_ns:
        hint = _hint(period_ns, unit_ns, spec)
        problems.error(f"{_why(demands, unit_ns)}, and the step {step} is no multiple of that{hint}", where)
        return None
    return spec.step


def plan_parts(  # noqa: PLR0917
    entry: AgentEntry,
    steps: Mapping[str, int],
    step_ns: int,
    method: Method,
    demands: Mapping[str, OwnStep],
    problems: Problems,
) -> tuple[int, ...]:
    """How many steps of its own each component makes in a micro step; empty where each makes one.

    Args:
        entry: how the agents are written.
        steps: in nanoseconds, those that components are given of their own.
        step_ns: the micro step.
        method: of the coupling.
        demands: what components ask for.
        problems: takes what is wrong.
    """
    for name, own_ns in steps.items():
        own, step = format_duration(own_ns), format_duration(step_ns)
        demand = demands.get(name)
        message = ""
        if method is Method.JOINT:
            message = "'joint' integrates all components with one step; leave 'step' out here, or use 'midpoint'"
        elif own_ns > step_ns and entry.spec.coupling.step is None:
            message = f"the step {own} of {name!r} does not divide the period; {step} does"
        elif own_ns > step_ns:
            message = (
                f"{name!r} cannot step every {own} where values are exchanged every {step}; "
                f"write `coupling: {{step: {own}}}`, and a 'step' for each faster component"
            )
        elif step_ns % own_ns:
            fitting = _fitting(step_ns, 1, own_ns)
            hint = f"; {format_duration(fitting)} does" if fitting else ""
            message = f"the step {own} of {name!r} does not divide the coupling's step {step}{hint}"
        elif demand is not None and (step_ns // demand.parts) % own_ns:
            message = f"{name!r} makes two half steps of {step}, and the step {own} does not divide one"
        elif demand is not None and own_ns % (demand.unit_ns // demand.parts):
            unit = format_duration(demand.unit_ns // demand.parts)
            message = f"{name!r} advances in steps of {unit}, and the step {own} is no multiple of that"
        if message:
            problems.error(message, entry.node.locate("components", name, "step"))
            return ()
    if not steps:
        return ()
    return tuple(step_ns // steps.get(name, step_ns) for name in entry.spec.components)


def _usual(method: Method, demands: Mapping[str, OwnStep]) -> int:
    """The default step: what a component that accepts one length only is usually stepped with, else the method's."""
    steps = [demand.usual_ns for demand in demands.values() if demand.usual_ns is not None]
    return min(steps) if steps else _DEFAULT_STEP_NS.get(method, _OTHER_STEP_NS)


def _warn_of_other(  # noqa: PLR0917
    demands: Mapping[str, OwnStep], usual_ns: int, chosen_ns: int, period: str, node: Node, problems: Problems
) -> None:
    """A component is not stepped as in its default experiment, as that step does not fit the period."""
    for name, demand in demands.items():
        if demand.usual_ns == usual_ns:
            usual, chosen = (format_duration(ns // demand.parts) for ns in (usual_ns, chosen_ns))
            problems.warning(
                f"{name!r} takes steps of one length, and {usual} (its default experiment) do not fit the period "
                f"{period}: it gets {chosen}; 'step' under 'coupling' chooses another",
                node.locate("components", name, key=True),
            )


def _hint(period_ns: int, unit_ns: int, spec: CouplingSpec) -> str:
    fitting = _fitting(period_ns, unit_ns, spec.step or period_ns)
    return f"; {format_duration(fitting)} does" if fitting else ""


def _fitting(period_ns: int, unit_ns: int, largest_ns: int) -> int | None:
    """The largest step that divides the period, is a multiple of `unit_ns` and at most `largest_ns`, unless it is much
    smaller; where even the unit is larger, the smallest one.
    """
    units = period_ns // unit_ns
    most = max(largest_ns // unit_ns, 1)
    return next((period_ns // steps for steps in _counts(units, most) if units % steps == 0), None)


def _counts(units: int, most: int) -> Iterator[int]:
    """Numbers of steps to try, from the fewest on."""
    fewest = -(-units // most)
    return iter(range(fewest, min(fewest + _MOST_STEPS_TO_TRY, units + 1)))


def _why(demands: Mapping[str, OwnStep], unit_ns: int) -> str:
    """`'plant' advances in steps of 3 ms`, naming all that have a part in it."""
    steps = []
    for name, demand in demands.items():
        if demand.unit_ns > 1:
            own = demand.unit_ns // 2 if demand.halved else demand.unit_ns
            twice = " and makes two of them per micro step" if demand.halved else ""
            steps.append(f"{name!r} advances in steps of {format_duration(own)}{twice}")
    together = f", together in {format_duration(unit_ns)}" if len(steps) > 1 else ""
    return f"{' and '.join(steps)} (fixedInternalStepSize){together}"
