"""Which coupling an agent gets: the choice that `auto` makes, and what each method asks of the components."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace

from cosim.components.component import Description, Interface
from cosim.errors import Location
from cosim.plan import AgentPlan, CouplingPlan, Integrator, Loop, Method
from cosim.planning.problems import Problems
from cosim.planning.steps import choose_step, own_steps, plan_parts
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import Node
from cosim.scenario.spec import CouplingSpec
from cosim.wiring import AlgebraicLoop


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
    retries = 0 if method is Method.JOINT else spec.retries
    loop = _loop(spec, node, _in_python(entry, descriptions, method, retries), problems)
    unsaved = [name for name, description in descriptions.items() if not description.can_get_and_set_state]
    if retries and unsaved:
        problems.error(
            f"'retries' takes FMUs that can save their state, and {_quoted(unsaved)} cannot (canGetAndSetFMUState); "
            "leave it out, or take a shorter step",
            node.locate("coupling", "retries"),
        )
    demands = own_steps(descriptions, readers if method is Method.MIDPOINT else frozenset())
    if method is Method.JOINT:
        demands = {}
    steps = {name: component.step for name, component in entry.spec.components.items() if component.step is not None}
    slowest_ns = max(steps.values(), default=0)
    step_ns = None if lacking else choose_step(spec, method, node, demands, period_ns, problems, slowest_ns)
    if step_ns is None:
        return None
    tolerances = spec.relative_tolerance, spec.absolute_tolerance
    parts = plan_parts(entry, steps, step_ns, method, demands, problems)
    return CouplingPlan(method, step_ns, Integrator(spec.integrator), *tolerances, loop, bool(demands), retries, parts)


def _auto(descriptions: Mapping[str, Description]) -> Method:
    """`joint` where all components allow it, else `midpoint`."""
    exchange = all(Interface.MODEL_EXCHANGE in description.interfaces for description in descriptions.values())
    return Method.JOINT if exchange else Method.MIDPOINT


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
    entry: AgentEntry, descriptions: Mapping[str, Description], method: Method, retries: int
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
