"""A plan as a scenario again: every choice made, every draw a number. Running it gives the same plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from cosim.components.component import Value, Variable
from cosim.components.presented import find
from cosim.plan import EXTERNAL, AgentPlan, CouplingPlan, Loop, Workers
from cosim.planning.blueprint import Blueprint, Part
from cosim.planning.describing import is_file
from cosim.planning.graph import Edge
from cosim.planning.starts import INTEGERS
from cosim.scenario.names import agent_names, in_short
from cosim.scenario.reading import Scenario
from cosim.scenario.source import Lines, dump
from cosim.scenario.spec import BridgeSpec, ComponentSpec, SubscriptionSpec
from network.units import format_duration

Tree = dict[str, Any]


def resolved_text(
    scenario: Scenario,
    agents: Sequence[AgentPlan],
    blueprints: Sequence[Blueprint],
    edges: Sequence[Edge],
    workers: Workers,
) -> str:
    """The resolved scenario as YAML.

    Args:
        scenario: as it was read.
        agents: as planned.
        blueprints: of each agent.
        edges: of the graph.
        workers: who carries which agents.
    """
    spec = scenario.spec
    templates, members = _group(agents, blueprints)
    used = {edge.channel for edge in edges}
    tree: Tree = {
        "name": scenario.name,
        "title": spec.title,
        "seed": spec.seed,
        "period": format_duration(spec.period),
        "duration": format_duration(spec.duration),
        "templates": templates,
        "agents": members,
        "graph": _graph(spec.graph.weights, edges),
        "channels": {n: m.as_written() for n, m in spec.channels.items() if n in used},
        "analysis": spec.analysis.model_dump(mode="json", by_alias=True, exclude_unset=True),
        "workers": _workers(agents, workers),
        "bridge": _bridge(spec.bridge, agents),
        "on_worker_loss": "" if spec.on_worker_loss == "abort" else spec.on_worker_loss,
    }
    return dump({key: value for key, value in tree.items() if value not in ({}, "", None)})


def _workers(agents: Sequence[AgentPlan], workers: Workers) -> int | str | Tree | None:
    if not isinstance(workers, Mapping):
        return workers
    names = {worker: [agents[index].name for index in indices] for worker, indices in workers.items()}
    return {worker: _agents(carried) for worker, carried in names.items()}


def _agents(names: Sequence[str]) -> str:
    """A list that reads as these names again."""
    short = in_short(names)
    with suppress(ValueError):  # of names that look like ranges in part
        if list(agent_names(short)) == list(names):
            return short
    return ", ".join(names)


def _group(agents: Sequence[AgentPlan], blueprints: Sequence[Blueprint]) -> tuple[Tree, Tree]:
    """Templates of what agents have in common, and what is each agent's own.

    Agents share a template if they differ in numbers only; start values that they all share are the template's.
    """
    groups: list[tuple[Tree, list[int]]] = []
    for index, (agent, blueprint) in enumerate(zip(agents, blueprints, strict=True)):
        common = _common(agent, blueprint)
        for other, indices in groups:
            if other == common:
                indices.append(index)
                break
        else:
            groups.append((common, [index]))
    templates: Tree = {}
    own: dict[str, Tree] = {}
    for common, indices in groups:
        starts = {index: _starts(agents[index], blueprints[index]) for index in indices}
        shared = _shared(list(starts.values()))
        for component, values in shared.items():
            if values:
                common["components"][component]["start"] = values
        name = _free_name(blueprints[indices[0]].entry.template or "agent", templates)
        templates[name] = common
        for index in indices:
            components = {
                component: {"start": rest}
                for component, values in starts[index].items()
                if (rest := {key: value for key, value in values.items() if key not in shared[component]})
            }
            own[agents[index].name] = {"template": name} | ({"components": components} if components else {})
    return templates, {agent.name: own[agent.name] for agent in agents}


def _common(agent: AgentPlan, blueprint: Blueprint) -> Tree:
    """All of an agent but its start values."""
    spec = blueprint.entry.spec
    components = {part.name: _component(part, spec.components[part.name]) for part in blueprint.parts}
    coupling = agent.coupling
    tree: Tree = {
        "components": components,
        "connections": Lines(f"{source} -> {target}" for source, target in spec.connections),
        "publish": dict(spec.publish),
        "receive": dict(spec.receive),
        "record": [name for name, _ in agent.record],
        "coupling": {
            "method": str(coupling.method),
            "step": format_duration(coupling.step_ns),
            "integrator": str(coupling.integrator),
            "relative_tolerance": coupling.relative_tolerance,
            "absolute_tolerance": coupling.absolute_tolerance,
        }
        | _controlled(coupling)
        | ({"retries": coupling.retries} if coupling.retries else {})
        | ({"loop": str(coupling.loop)} if spec.coupling.loop or coupling.loop is Loop.PYTHON else {}),
    }
    return {key: value for key, value in tree.items() if value or key == "record"}


def _controlled(coupling: CouplingPlan) -> Tree:
    """What the steps keep to, where they adapt."""
    control = coupling.control
    if control is None:
        return {}
    return {
        "tolerance": control.relative_tolerance,
        "absolute_tolerance": control.absolute_tolerance,
        "least_step": format_duration(control.least_ns),
    }


def _component(part: Part, spec: ComponentSpec) -> Tree:
    """A component without its start values."""
    python = part.origin.python
    origin = {"fmu": _fmu_text(spec.fmu or "", str(part.origin.path))} if python is None else {"python": python}
    kept = {"sha256", "inputs", "outputs", "solver"}
    written = spec.model_dump(mode="json", by_alias=True, exclude_unset=True, include=kept)
    if spec.step is not None:
        written["step"] = format_duration(spec.step)
    if part.isolation is not None:
        written["isolate"] = {"deadline": format_duration(part.isolation.deadline_ns)}
    if part.cvode is not None or spec.tolerance is not None:
        written["tolerance"] = part.cvode or spec.tolerance
    return origin | {key: value for key, value in written.items() if value}


def _fmu_text(written: str, path: str) -> str:
    """A shipped FMU by name, a file by its absolute path."""
    return path if is_file(written) else written


def _starts(agent: AgentPlan, blueprint: Blueprint) -> dict[str, Tree]:
    """Start values by component, without those that the framework sets."""
    return {
        component.name: {
            name: _start(values, find(component.description.variables, name))
            for name, values in component.start.items()
            if f"{component.name}.{name}" not in blueprint.assigned
        }
        for component in agent.components
    }


def _start(values: tuple[Value, ...], variable: Variable | None) -> Value | list[Value]:
    return list(values) if variable is not None and variable.shape else values[0]


def _shared(starts: Sequence[Mapping[str, Tree]]) -> dict[str, Tree]:
    """The start values that all have alike, bit by bit."""
    first = starts[0]
    return {
        component: {
            name: value
            for name, value in values.items()
            if all(_same(other[component], name, value) for other in starts)
        }
        for component, values in first.items()
    }


def _same(values: Tree, name: str, value: Any) -> bool:
    return name in values and repr(values[name]) == repr(value)


def _free_name(wanted: str, taken: Mapping[str, Any]) -> str:
    name, number = wanted, 1
    while name in taken:
        number += 1
        name = f"{wanted}-{number}"
    return name


def _graph(weights: str, edges: Sequence[Edge]) -> Tree:
    """Edges as text where all share a channel, as mappings where they do not or have weights."""
    if not edges:
        return {}
    channels = {edge.channel for edge in edges}
    tree: Tree = {"weights": weights}
    if len(channels) == 1:
        tree["channel"] = edges[0].channel
    tree["edges"] = Lines(_edge(edge, weighted=weights == "given", named=len(channels) > 1) for edge in edges)
    return tree


def _edge(edge: Edge, *, weighted: bool, named: bool) -> str | Tree:
    if not weighted and not named:
        return f"{edge.sender} -> {edge.receiver}"
    tree: Tree = {"from": edge.sender, "to": edge.receiver}
    if weighted:
        tree["weight"] = edge.weight
    if named:
        tree["channel"] = edge.channel
    return tree


def _bridge(spec: BridgeSpec, agents: Sequence[AgentPlan]) -> Tree:
    """The bridge, its start values as numbers; what was taken from outside is replayed."""
    tree: Tree = {
        "listen": spec.listen,
        "connect": spec.connect,
        "insecure": spec.insecure,
        "publish": [entry.model_dump(mode="json", exclude_unset=True) for entry in spec.publish],
        "subscribe": [tree for entry in spec.subscribe for tree in _subscriptions(entry, agents)],
        "replay": EXTERNAL if spec.subscribe else None,
    }
    return {key: value for key, value in tree.items() if value}


def _subscriptions(entry: SubscriptionSpec, agents: Sequence[AgentPlan]) -> Iterator[Tree]:
    """One entry for all agents that have the same start value."""
    wanted = None if entry.agents is None else frozenset(agent_names(entry.agents))
    starts: dict[tuple[Value, ...], list[str]] = {}
    shape: tuple[int, ...] = ()
    for agent in agents:
        if wanted is not None and agent.name not in wanted:
            continue
        for external in agent.external:
            variable = external.port.variable
            if f"{agent.components[external.port.component].name}.{variable.name}" == entry.variable:
                kind = bool if variable.dtype == "Boolean" else int if variable.dtype in INTEGERS else float
                starts.setdefault(tuple(map(kind, external.start)), []).append(agent.name)
                shape = variable.shape
    for start, names in starts.items():
        tree = {"key": entry.key, "agents": in_short(names), "variable": entry.variable}
        yield {**tree, "start": list(start) if shape else start[0], "encoding": entry.encoding}
