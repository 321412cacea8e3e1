"""Which coupling an agent gets: the choice that `auto` makes, and what each method asks of the components."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from cosim.components.component import Description, Interface
from cosim.errors import Location
from cosim.plan import AgentPlan, CouplingPlan, Integrator, Loop, Method
from cosim.planning.problems import Problems
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import Node
from cosim.scenario.spec import CouplingSpec
from network.units import format_duration

_DEFAULT_STEP_NS = {Method.JOINT: 5_000_000}
_OTHER_STEP_NS = 1_000_000
_MOST_STEPS_TO_TRY = 10_000


def choose_coupling(
    entry: AgentEntry,
    descriptions: Mapping[str, Description],
    n_neighbours: int,
    period_ns: int,
    problems: Problems,
) -> CouplingPlan | None:
    """The coupling of agents whose components are `descriptions`; None, and problems, where there is none."""
    spec, node = entry.spec.coupling, entry.node
    where = node.locate("coupling", "method")
    method = _auto(descriptions) if spec.method == "auto" else Method(spec.method)
    wanted = Interface.MODEL_EXCHANGE if method is Method.JOINT else Interface.CO_SIMULATION
    lacking = [name for name, description in descriptions.items() if wanted not in description.interfaces]
    if lacking:
        why = "no method fits all components" if spec.method == "auto" else f"{method} needs {_words(wanted)}"
        problems.error(
            f"{why}: {_quoted(lacking)} {'does' if len(lacking) == 1 else 'do'} not offer {_words(wanted)}", where
        )
    _warn(method, descriptions, n_neighbours, where, problems)
    loop = _loop(spec, node, descriptions, problems)
    step_ns = _step(spec, method, node, period_ns, problems)
    if lacking or step_ns is None:
        return None
    return CouplingPlan(
        method, step_ns, Integrator(spec.integrator), spec.relative_tolerance, spec.absolute_tolerance, loop
    )


def _auto(descriptions: Mapping[str, Description]) -> Method:
    """`joint` where all components allow it, else `midpoint`."""
    exchange = all(Interface.MODEL_EXCHANGE in description.interfaces for description in descriptions.values())
    return Method.JOINT if exchange else Method.MIDPOINT


def _warn(
    method: Method,
    descriptions: Mapping[str, Description],
    n_neighbours: int,
    where: Location,
    problems: Problems,
) -> None:
    """What a component does not promise, though it may work."""
    for name, description in descriptions.items():
        if method is not Method.JOINT and n_neighbours and not description.variable_step:
            problems.warning(
                f"{name!r} accepts steps of one length only; it may refuse one that an arrival between ticks cuts",
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


def _loop(spec: CouplingSpec, node: Node, descriptions: Mapping[str, Description], problems: Problems) -> Loop:
    python = [name for name, description in descriptions.items() if description.fmi == "python"]
    if spec.loop == "native" and python:
        problems.error(
            f"the native loop runs FMUs only, and {_quoted(python)} {'is' if len(python) == 1 else 'are'} Python; "
            "leave 'loop' out",
            node.locate("coupling", "loop"),
        )
    if spec.loop is not None:
        return Loop(spec.loop)
    return Loop.PYTHON if python else Loop.NATIVE


def _step(spec: CouplingSpec, method: Method, node: Node, period_ns: int, problems: Problems) -> int | None:
    """The micro step given, else the largest that divides the period and is no larger than the usual one."""
    where, period = node.locate("coupling", "step"), format_duration(period_ns)
    if spec.step is None:
        usual = _DEFAULT_STEP_NS.get(method, _OTHER_STEP_NS)
        fitting = _dividing(period_ns, usual)
        if fitting is None:
            problems.error(f"no usual step divides the period {period}; give 'step' under 'coupling'", node.where)
        return fitting
    step = format_duration(spec.step)
    if spec.step > period_ns:
        problems.error(f"the step {step} is longer than the period {period}", where)
        return None
    if period_ns % spec.step and not (method is Method.JOINT and spec.integrator == "dormand-prince"):
        fitting = _dividing(period_ns, spec.step)
        hint = f"; {format_duration(fitting)} does" if fitting else ""
        problems.error(f"the step {step} does not divide the period {period}{hint}", where)
        return None
    return spec.step


def _dividing(period_ns: int, largest_ns: int) -> int | None:
    """The largest step that divides the period and is at most `largest_ns`, unless it is much smaller."""
    fewest = -(-period_ns // largest_ns)
    candidates = range(fewest, fewest + _MOST_STEPS_TO_TRY)
    return next((period_ns // steps for steps in candidates if period_ns % steps == 0), None)


def _words(interface: Interface) -> str:
    return "Model Exchange" if interface is Interface.MODEL_EXCHANGE else "Co-Simulation"


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(repr(name) for name in names)
