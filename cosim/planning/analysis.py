"""What the report and the checks call position, velocity, leader and so on, agent by agent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.components.component import Value, Variable
from cosim.errors import Location, suggest
from cosim.plan import AnalysisPlan, ComponentPlan, Port
from cosim.planning.ports import numbers
from cosim.planning.problems import Problems
from cosim.planning.starts import NUMERIC
from cosim.scenario.reading import Scenario


@dataclass(frozen=True)
class Member:
    """What the analysis needs to know of an agent.

    Attributes:
        name: of the agent.
        components: with their start values.
        record: as in `AgentPlan`.
    """

    name: str
    components: tuple[ComponentPlan, ...]
    record: tuple[tuple[str, Port], ...]


_SIGNALS = ("position", "velocity", "estimate", "parameters")


def plan_analysis(scenario: Scenario, agents: Sequence[Member], problems: Problems) -> AnalysisPlan:
    """The analysis of a scenario with these agents."""
    spec = scenario.spec.analysis
    for name in _SIGNALS:
        _check_recorded(getattr(spec, name), agents, scenario.root.locate("analysis", name), problems)
    reference = spec.reference_velocity
    if reference is not None:
        _check_reference(
            reference, spec.velocity, agents, scenario.root.locate("analysis", "reference_velocity"), problems
        )
    k_eta, lambda_ = (
        _numbers(text, agents, scenario.root.locate("analysis", key), problems)
        for key, text in (("k_eta", spec.k_eta), ("lambda", spec.lambda_))
    )
    return AnalysisPlan(
        spec.position,
        spec.velocity,
        spec.estimate,
        spec.parameters,
        tuple(reference) if reference is not None else None,
        _leaders(scenario, agents, problems),
        k_eta,
        lambda_,
    )


def _check_recorded(reference: str | None, agents: Sequence[Member], where: Location, problems: Problems) -> None:
    """At least one agent records what the analysis wants to see."""
    recorded = [name for agent in agents for name, _ in agent.record]
    if reference is None or reference in recorded:
        return
    if _variables(agents, reference):
        problems.error(f"{reference!r} is not recorded; add it to 'record'", where)
    else:
        problems.error(f"no agent has a variable {reference!r}{suggest(reference, dict.fromkeys(recorded))}", where)


def _check_reference(
    reference: Sequence[float], velocity: str | None, agents: Sequence[Member], where: Location, problems: Problems
) -> None:
    sizes = {variable.size for _, variable in _variables(agents, velocity)} if velocity else set()
    if sizes and len(reference) not in sizes:
        problems.error(f"{velocity!r} has {numbers(min(sizes))}, the reference velocity {len(reference)}", where)


def _variables(agents: Iterable[Member], reference: str) -> list[tuple[Member, Variable]]:
    """The variable of that name in every agent that has one."""
    component_name, _, name = reference.partition(".")
    return [
        (agent, component.description.variables[name])
        for agent in agents
        for component in agent.components
        if component.name == component_name and name in component.description.variables
    ]


def _start(agent: Member, reference: str, variable: Variable) -> tuple[Value, ...] | None:
    """Its start value in this agent: the scenario's, else the declared one."""
    component_name, _, name = reference.partition(".")
    component = next(component for component in agent.components if component.name == component_name)
    return component.start.get(name, variable.start)


def _leaders(scenario: Scenario, agents: Sequence[Member], problems: Problems) -> tuple[str, ...]:
    """The agents in which every start value under `leaders` is as given."""
    wanted = scenario.spec.analysis.leaders
    matching = {agent.name for agent in agents} if wanted else set()
    for reference, value in wanted.items():
        where = scenario.root.locate("analysis", "leaders", reference)
        holders = _variables(agents, reference)
        if not holders:
            at = scenario.root.locate("analysis", "leaders", reference, key=True)
            problems.error(f"no agent has a variable {reference!r}", at)
        items = {item for _, variable in holders for item in variable.items}
        if items and isinstance(value, str) and value not in items:
            problems.error(f"{reference!r} has no item {value!r}{suggest(value, items)}", where)
        matching &= {
            agent.name for agent, variable in holders if _is(_start(agent, reference, variable), value, variable)
        }
    return tuple(agent.name for agent in agents if agent.name in matching)


def _is(start: tuple[Value, ...] | None, value: Any, variable: Variable) -> bool:
    """Whether every element of a start value is `value`; enumeration items by name or number."""

    def number(one: Any) -> Any:
        return variable.items.get(one, one) if isinstance(one, str) else one

    return start is not None and all(number(element) == number(value) for element in start)


def _numbers(
    reference: str | None, agents: Sequence[Member], where: Location, problems: Problems
) -> Mapping[str, float] | None:
    """A scalar parameter's value by agent."""
    if reference is None:
        return None
    holders = _variables(agents, reference)
    if not holders:
        problems.error(f"no agent has a variable {reference!r}", where)
    found = {}
    for agent, variable in holders:
        start = _start(agent, reference, variable)
        if variable.dtype not in NUMERIC or variable.size != 1 or start is None:
            problems.error(f"{reference!r} is no single number with a start value", where)
            continue
        found[agent.name] = float(start[0])
    return found
