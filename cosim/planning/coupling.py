"""Which coupling an agent gets: the choice that `auto` makes, and what each method asks of the components."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace

from cosim.agents.watched import unwatched_readers
from cosim.agents.wiring import AlgebraicLoop, Wiring
from cosim.components.component import Description, Interface
from cosim.errors import Location
from cosim.plan import AgentPlan, ControlPlan, CouplingPlan, Integrator, Loop, Method
from cosim.planning.problems import Problems
from cosim.planning.steps import OwnStep, choose_step, own_steps, plan_parts
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import Node
from cosim.scenario.spec import CouplingSpec
from network.units import format_duration

_ABSOLUTE_TOLERANCE = 1e-10
_LEAST_STEP_NS = 1_000


def choose_coupling(
    entry: AgentEntry,
    descriptions: Mapping[str, Description],
    readers: Set[str],
    period_ns: int,
    problems: Problems,
) -> CouplingPlan | None:
    """The coupling of agents; None, and problems, where there is none.

    Args:
        entry: how they are written.
        descriptions: of their components.
        readers: components that read one that is listed before them.
        period_ns: T.
        problems: takes what is wrong.
    """
    spec = entry.spec.coupling
    method = _auto(descriptions) if spec.method == "auto" else Method(spec.method)
    possible = _check_interfaces(entry, descriptions, method, problems)
    _check_own_tolerances(entry, method, problems)
    control = _control(entry, descriptions, method, period_ns, problems)
    retries = 0 if method is Method.JOINT else _retries(entry, descriptions, problems)
    loop = _loop(spec, entry.node, _in_python(entry, descriptions, method, retries, control), problems)
    demands: dict[str, OwnStep] = {}
    if method is not Method.JOINT:
        demands = own_steps(descriptions, readers if method is Method.MIDPOINT else frozenset())
    steps = {name: component.step for name, component in entry.spec.components.items() if component.step is not None}
    if control is not None:
        possible = _check_lengths(entry, demands, steps, problems) and possible
    if not possible:
        return None
    slowest_ns = max(steps.values(), default=0)
    step_ns = choose_step(spec, method, entry.node, demands, period_ns, problems, slowest_ns)
    if step_ns is None:
        return None
    if control is not None:
        _check_least_step(entry, step_ns, problems)
    tolerances = spec.relative_tolerance, spec.absolute_tolerance or _ABSOLUTE_TOLERANCE
    parts = plan_parts(entry, steps, step_ns, method, demands, problems)
    integrator = Integrator(spec.integrator)
    return CouplingPlan(method, step_ns, integrator, *tolerances, loop, bool(demands), retries, parts, control)


def _check_interfaces(
    entry: AgentEntry, descriptions: Mapping[str, Description], method: Method, problems: Problems
) -> bool:
    """Whether all components offer what the method needs."""
    wanted = Interface.MODEL_EXCHANGE if method is Method.JOINT else Interface.CO_SIMULATION
    lacking = [name for name, description in descriptions.items() if wanted not in description.interfaces]
    if lacking:
        auto = entry.spec.coupling.method == "auto"
        why = "no method fits all components" if auto else f"{method} needs {_words(wanted)}"
        problems.error(
            f"{why}: {_quoted(lacking)} {'does' if len(lacking) == 1 else 'do'} not offer {_words(wanted)}",
            entry.node.locate("coupling", "method"),
        )
    return not lacking


def _retries(entry: AgentEntry, descriptions: Mapping[str, Description], problems: Problems) -> int:
    """How often a step may be tried again, for which components go back to where it began."""
    retries = entry.spec.coupling.retries
    unsaved = [name for name, description in descriptions.items() if not description.can_get_and_set_state]
    if retries and unsaved:
        problems.error(
            f"'retries' takes components that can save their state, and {_quoted(unsaved)} cannot (an FMU: "
            "canGetAndSetFMUState; a Python class: save = None); "
            "leave it out, or take a shorter step",
            entry.node.locate("coupling", "retries"),
        )
    return retries


def _check_lengths(
    entry: AgentEntry, demands: Mapping[str, OwnStep], steps: Mapping[str, int], problems: Problems
) -> bool:
    """Whether steps may have any length, as those that 'tolerance' chooses have."""
    if demands:
        problems.error(
            f"'tolerance' chooses steps of any length, and {_quoted(demands)} "
            f"{'takes' if len(demands) == 1 else 'take'} those of one length only (fixedInternalStepSize, or no "
            "canHandleVariableCommunicationStepSize); leave 'tolerance' out, and try `cosim run --estimate-error`",
            entry.node.locate("coupling", "tolerance"),
        )
    if steps:
        problems.error(
            f"'tolerance' chooses the steps of all components together; leave 'step' out of {_quoted(steps)}",
            entry.node.locate("components", next(iter(steps)), "step"),
        )
    return not demands and not steps


def _check_least_step(entry: AgentEntry, step_ns: int, problems: Problems) -> None:
    least_ns = entry.spec.coupling.least_step
    if least_ns is not None and least_ns > step_ns:
        problems.error(
            f"'least_step' is {format_duration(least_ns)}, longer than the largest step, "
            f"{format_duration(step_ns)}; write a shorter one",
            entry.node.locate("coupling", "least_step"),
        )


def _control(
    entry: AgentEntry, descriptions: Mapping[str, Description], method: Method, period_ns: int, problems: Problems
) -> ControlPlan | None:
    """What the steps keep to, where they are controlled."""
    spec, node = entry.spec.coupling, entry.node
    if spec.tolerance is None:
        if spec.least_step is not None:
            problems.error(
                "'least_step' bounds the steps that 'tolerance' chooses; give that too, or leave it out",
                node.locate("coupling", "least_step"),
            )
        return None
    if method is Method.JOINT:
        problems.error(
            "'tolerance' is for the couplings of Co-Simulation, and this is joint; write `method: midpoint`, or "
            f"`integrator: dormand-prince, relative_tolerance: {spec.tolerance:g}` instead of it",
            node.locate("coupling", "tolerance"),
        )
        return None
    components = entry.spec.components.values()
    rollback = all(x.can_get_and_set_state and not x.asynchronous for x in descriptions.values()) and all(
        component.solver is None for component in components
    )
    return ControlPlan(
        relative_tolerance=spec.tolerance,
        absolute_tolerance=spec.absolute_tolerance or spec.tolerance,
        least_ns=spec.least_step or _LEAST_STEP_NS,
        period_ns=period_ns,
        rollback=rollback,
    )


def _check_own_tolerances(entry: AgentEntry, method: Method, problems: Problems) -> None:
    """Tolerances that nobody would read."""
    for name, component in entry.spec.components.items():
        if component.tolerance is None or component.solver is not None:
            continue
        message = ""
        if component.python is not None:
            message = "'tolerance' is for FMUs and for 'solver: cvode'; leave it out here"
        elif method is Method.JOINT:
            message = (
                f"'joint' does not use the solver of {name!r}; leave 'tolerance' out here, and write `coupling: "
                f"{{integrator: dormand-prince, relative_tolerance: {component.tolerance:g}}}`"
            )
        if message:
            problems.error(message, entry.node.locate("components", name, "tolerance"))


def _auto(descriptions: Mapping[str, Description]) -> Method:
    """`joint` where all components allow it, else `midpoint`."""
    exchange = all(Interface.MODEL_EXCHANGE in description.interfaces for description in descriptions.values())
    return Method.JOINT if exchange else Method.MIDPOINT


def warn_unwatched(agent: AgentPlan, wiring: Wiring, where: Location, problems: Problems) -> None:
    """A tolerance keeps to what it sees, which may be nothing."""
    if readers := unwatched_readers(wiring, agent.components, agent.coupling):
        one = len(readers) == 1
        problems.warning(
            f"'tolerance' sees no error here: {_quoted(readers)}, which {'reads' if one else 'read'} others, "
            f"{'has' if one else 'have'} no output that changes continuously; steps will be as long as 'step' allows",
            where,
        )


def warn_of_order(agent: AgentPlan, where: Location, problems: Problems) -> None:
    """`midpoint` is of order 2 if what feeds straight through a component steps before it, in the order of the file."""
    for feed in agent.connections:
        reader = feed.target.component
        if feed.source.component <= reader:
            continue
        outputs = {x.source.variable.name: x.source for x in agent.connections if x.source.component == reader}
        for output in outputs.values():
            if feed.target.variable.name in (output.variable.dependencies or ()):
                first, second = agent.components[feed.source.component].name, agent.components[reader].name
                problems.warning(
                    f"'midpoint' falls to order 1 here: '{second}.{output.variable.name}' depends directly on "
                    f"'{first}.{feed.source.variable.name}', and {first!r} steps later; "
                    f"list {first!r} before {second!r}",
                    where,
                )


def solving(
    entry: AgentEntry, coupling: CouplingPlan, loops: Sequence[AlgebraicLoop], where: Location, problems: Problems
) -> CouplingPlan:
    """The coupling of an agent with these algebraic loops: the Python loop solves them."""
    if not loops:
        return coupling
    names = "; ".join(loop.names for loop in loops)
    if entry.spec.coupling.loop == "native":
        message = f"the native loop solves no algebraic loop: {names}; leave 'loop' out"
        problems.error(message, entry.node.locate("coupling", "loop"))
    problems.warning(
        f"an algebraic loop: {names}; each of these outputs depends directly on the one before it. Newton's method "
        "solves it at every evaluation, in Python; a component with a state breaks it, or the coupling 'midpoint'",
        where,
    )
    return replace(coupling, loop=Loop.PYTHON)


def _in_python(
    entry: AgentEntry,
    descriptions: Mapping[str, Description],
    method: Method,
    retries: int,
    control: ControlPlan | None,
) -> dict[str, str]:
    """The components that the native loop cannot run, and why: `'plant' is Python`."""
    found = {name: f"{name!r} is Python" for name, description in descriptions.items() if description.fmi == "python"}
    for name, component in entry.spec.components.items():
        if component.isolate is not None:
            found.setdefault(name, f"{name!r} is isolated")
        if component.solver is not None:
            found.setdefault(name, f"{name!r} is stepped by {component.solver}")
    for name, description in descriptions.items():
        if name in found or method is Method.JOINT:
            continue
        if description.asynchronous:
            found[name] = f"{name!r} steps asynchronously (canRunAsynchronuously)"
        elif retries:
            found[name] = f"{name!r} is to be saved before every step ('retries')"
        elif control is not None:
            found[name] = f"{name!r} steps as long as the errors allow ('tolerance')"
    return found


def _loop(spec: CouplingSpec, node: Node, in_python: Mapping[str, str], problems: Problems) -> Loop:
    if spec.loop == "native" and in_python:
        problems.error(
            f"the native loop cannot be had: {', '.join(in_python.values())}; leave 'loop' out",
            node.locate("coupling", "loop"),
        )
    if spec.loop is not None:
        return Loop(spec.loop)
    return Loop.PYTHON if in_python else Loop.NATIVE


def _words(interface: Interface) -> str:
    return "Model Exchange" if interface is Interface.MODEL_EXCHANGE else "Co-Simulation"


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(repr(name) for name in names)
