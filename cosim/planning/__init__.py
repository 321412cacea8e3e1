"""From a scenario as written to a plan: names to indices, distributions to numbers, every choice made and checked.

`load` is what the commands call. All problems of a scenario are found before anything is instantiated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cosim.agents.wiring import AlgebraicLoopError, wire
from cosim.components.component import Value, Variable
from cosim.components.presented import in_unit_of
from cosim.errors import ConfigError, Problem
from cosim.plan import AgentPlan, AnalysisPlan, ComponentPlan, CouplingPlan, MailboxPlan, Method, Plan, Port
from cosim.planning.analysis import Member, plan_analysis
from cosim.planning.blueprint import Blueprint, Part, draw_up
from cosim.planning.bridge import Bridged, missing_replay, plan_bridge
from cosim.planning.channels import try_channels
from cosim.planning.coupling import solving, warn_of_order, warn_unwatched
from cosim.planning.describing import Describer
from cosim.planning.division import plan_workers
from cosim.planning.graph import Edge, links_of, resolve_edges
from cosim.planning.limits import warn_of_limits
from cosim.planning.mailbox import mailbox_of, message_variables, published_as
from cosim.planning.mapping import in_words
from cosim.planning.problems import Problems
from cosim.planning.resolved import resolved_text
from cosim.planning.silence import warn_of_silence
from cosim.planning.starts import draw
from cosim.planning.warnings import add_warnings
from cosim.scenario import configs
from cosim.scenario.merging import Override
from cosim.scenario.reading import Scenario, read_scenario
from cosim.scenario.spec import MAILBOX_PORTS
from network.messages import MessageLayout
from network.units import format_duration


@dataclass(frozen=True)
class Planned:
    """A plan, and what is worth a word although it runs."""

    plan: Plan
    warnings: tuple[Problem, ...]


def load(config: str, settings: Sequence[str] = (), *, seed: int | None = None, until: str | None = None) -> Planned:
    """The plan of a scenario.

    Args:
        config: a file, or the name of a shipped scenario.
        settings: `KEY=VALUE`, each laid over the file.
        seed: instead of the file's.
        until: a duration instead of the file's.

    Raises:
        ConfigError: everything that is wrong with it.
    """
    overrides = [Override.from_setting(setting) for setting in settings]
    if seed is not None:
        overrides.append(Override("seed", str(seed), "--seed"))
    if until is not None:
        overrides.append(Override("duration", until, "--until"))
    scenario = read_scenario(configs.find(config), overrides=overrides)
    planned = plan(scenario)
    if (missing := missing_replay(scenario, planned.plan)) is not None:
        raise ConfigError([missing])
    return planned


def plan(scenario: Scenario, located: Mapping[str, Path] | None = None) -> Planned:
    """The plan of a scenario that has been read.

    Args:
        scenario: that has been read.
        located: where FMUs are to be found, by what the scenario calls them; others are where it says.

    Raises:
        ConfigError: everything that is wrong with it.
    """
    problems = Problems(scenario.problems, scenario.doubts)
    ticks = _ticks(scenario, problems)
    edges = resolve_edges(scenario, problems)
    workers = plan_workers(scenario, problems)
    blueprints = _blueprints(scenario, edges, Describer(scenario, problems, located))
    message = _message(scenario, blueprints, edges, problems)
    bridged = plan_bridge(scenario, blueprints, problems)
    names_of: dict[int, list[str]] = {}
    for name, blueprint in blueprints.items():
        names_of.setdefault(id(blueprint), []).append(name)
    mailboxes = {}
    for blueprint in _each_once(blueprints.values()):
        problems.next_view()
        mailboxes[id(blueprint)] = mailbox_of(blueprint, message, bridged.feeds(names_of[id(blueprint)]))
    components = _components(blueprints, names_of.values(), scenario.spec.seed)
    for names in names_of.values():
        warn_of_limits(blueprints[names[0]], names, [components[name] for name in names], problems)
    record = _records(blueprints, problems)
    members = [Member(name, components[name], record[id(blueprint)]) for name, blueprint in blueprints.items()]
    analysis = AnalysisPlan()
    whole = not any(part.mapped.broken for blueprint in blueprints.values() for part in blueprint.parts)
    if whole and len(members) == len(scenario.agents) and scenario.doubts.all_agents_known:
        analysis = plan_analysis(scenario, members, problems)
    problems.raise_if_any()
    add_warnings(scenario, edges, analysis.leaders, problems)
    layout = MessageLayout(tuple(message), tuple(variable.size for variable in message.values() if variable))
    warn_of_silence(scenario, edges, 8 * layout.width, analysis, problems)
    try_channels(scenario, edges, problems)
    agents = tuple(_agents(members, blueprints, mailboxes, bridged, edges, message))
    agents = _with_loops(agents, blueprints, layout, problems)
    problems.raise_if_any()
    used = {edge.channel for edge in edges}
    planned = Plan(
        name=scenario.name,
        title=scenario.spec.title,
        seed=scenario.spec.seed,
        period_ns=scenario.spec.period,
        ticks=ticks,
        layout=layout,
        links=links_of(edges, tuple(scenario.agents)),
        weights=tuple(edge.weight for edge in edges),
        channels={name: model for name, model in scenario.spec.channels.items() if name in used},
        link_channel=tuple(edge.channel for edge in edges),
        agents=agents,
        analysis=analysis,
        scenario=resolved_text(scenario, agents, [blueprints[agent.name] for agent in agents], edges, workers),
        workers=workers,
        bridge=bridged.plan,
        on_worker_loss=scenario.spec.on_worker_loss,
    )
    return Planned(planned, problems.warnings)


def _ticks(scenario: Scenario, problems: Problems) -> int:
    """The number of periods in the duration."""
    period, duration = scenario.spec.period, scenario.spec.duration
    ticks, rest = divmod(duration, period)
    if rest:
        nearest = max(1, ticks + (2 * rest >= period)) * period
        problems.error(
            f"the duration {format_duration(duration)} is no multiple of the period {format_duration(period)}; "
            f"{format_duration(nearest)} is",
            scenario.root.locate("duration"),
        )
    return ticks


def _blueprints(scenario: Scenario, edges: Sequence[Edge], describer: Describer) -> dict[str, Blueprint]:
    """The blueprint of every agent whose components could be described; agents alike share theirs."""
    in_degree = dict.fromkeys(scenario.agents, 0)
    for edge in edges:
        in_degree[edge.receiver] += 1
    known: dict[tuple[int, int], Blueprint | None] = {}
    for name, entry in scenario.agents.items():
        key = (id(entry), in_degree[name])
        if key not in known:
            describer.problems.next_view()
            known[key] = draw_up(entry, in_degree[name], describer, scenario.spec.period)
    found = {name: known[id(entry), in_degree[name]] for name, entry in scenario.agents.items()}
    return {name: blueprint for name, blueprint in found.items() if blueprint is not None}


def _each_once(blueprints: Iterable[Blueprint]) -> list[Blueprint]:
    return list({id(blueprint): blueprint for blueprint in blueprints}.values())


def _message(
    scenario: Scenario, blueprints: Mapping[str, Blueprint], edges: Sequence[Edge], problems: Problems
) -> Mapping[str, Variable | None]:
    """The variables of a message, None for those that have a problem; everyone who is heard publishes them."""
    silent: set[str] = set()
    for edge in edges:
        entry = scenario.agents[edge.sender]
        if not entry.spec.publish and edge.sender not in silent:
            silent.add(edge.sender)
            problems.error(
                f"agent {edge.receiver!r} hears {edge.sender!r}, which publishes nothing; give it 'publish'", edge.where
            )
    every = (name for entry in scenario.agents.values() for name in entry.spec.publish)
    written = [name for name in every if name not in MAILBOX_PORTS]
    publishers = [(name, blueprint) for name, blueprint in blueprints.items() if blueprint.entry.spec.publish]
    message: dict[str, Variable | None] = dict.fromkeys(written)
    if publishers:
        message.update(message_variables(publishers, problems))
    return message


def _agents(  # noqa: PLR0917
    members: Sequence[Member],
    blueprints: Mapping[str, Blueprint],
    mailboxes: Mapping[int, MailboxPlan],
    bridged: Bridged,
    edges: Sequence[Edge],
    message: Mapping[str, Variable | None],
) -> Iterable[AgentPlan]:
    index_of = {member.name: index for index, member in enumerate(members)}
    incoming: dict[str, list[Edge]] = {member.name: [] for member in members}
    for edge in edges:
        incoming[edge.receiver].append(edge)
    heard = {edge.sender for edge in edges}
    publish = {  # one for agents alike, by which `Wirings` knows them
        id(blueprint): tuple(_published(blueprint, message)) for blueprint in _each_once(blueprints.values())
    }
    for member in members:
        blueprint, edges_in = blueprints[member.name], incoming[member.name]
        if blueprint.coupling is None:
            raise AssertionError("an agent without a coupling, and no problem reported")
        yield AgentPlan(
            index=index_of[member.name],
            name=member.name,
            components=member.components,
            connections=blueprint.connections,
            publish=publish[id(blueprint)] if member.name in heard else (),
            mailbox=mailboxes[id(blueprint)],
            neighbours=tuple(index_of[edge.sender] for edge in edges_in),
            weights=tuple(edge.weight for edge in edges_in),
            coupling=blueprint.coupling,
            record=member.record,
            external=bridged.external.get(member.name, ()),
        )


def _records(blueprints: Mapping[str, Blueprint], problems: Problems) -> Mapping[int, tuple[tuple[str, Port], ...]]:
    """What is recorded, by blueprint; a column has the unit of the first agent that records it."""
    first: dict[str, tuple[str, Variable]] = {}
    records: dict[int, tuple[tuple[str, Port], ...]] = {}
    for agent, blueprint in blueprints.items():
        if id(blueprint) in records:
            continue
        recorded = []
        for name, port in blueprint.record:
            who, column = first.setdefault(name, (agent, port.variable))
            converted = in_unit_of(port.variable, column)
            if converted is None:
                here, there = in_words(port.variable), in_words(column)
                text = f"{name!r} is recorded in {here} here, but in {there} from agent {who!r}: one column, two units"
                problems.warning(text, blueprint.where("record"))
            recorded.append((name, port if converted is None else Port(port.component, converted)))
        records[id(blueprint)] = tuple(recorded)
    return records


def _published(blueprint: Blueprint, message: Mapping[str, Variable | None]) -> Iterable[Port]:
    """Where each variable of the message is read, in the message's unit."""
    for name, common in message.items():
        port = blueprint.publish.get(name)
        variable = published_as(port.variable, common) if port and common else None
        if port is not None and variable is not None:
            yield Port(port.component, variable)


def _components(
    blueprints: Mapping[str, Blueprint], alike: Iterable[Sequence[str]], seed: int
) -> Mapping[str, tuple[ComponentPlan, ...]]:
    """The components of every agent; numbers are drawn for all agents alike at once."""
    found: dict[str, tuple[ComponentPlan, ...]] = {}
    for names in alike:
        parts = blueprints[names[0]].parts
        of_part = [_starts(part, names, seed) for part in parts]
        for name, starts in zip(names, zip(*of_part, strict=True), strict=True):
            found[name] = tuple(
                ComponentPlan(
                    part.name,
                    part.origin.path,
                    part.origin.python,
                    part.description,
                    start,
                    part.isolation,
                    part.cvode,
                )
                for part, start in zip(parts, starts, strict=True)
            )
    return found


def _starts(part: Part, agents: Sequence[str], seed: int) -> list[dict[str, tuple[Value, ...]]]:
    """The start values of a component, per agent."""
    drawn = {
        name: draw(value, seed, [f"{agent}.{part.name}.{name}" for agent in agents])
        for name, value in part.start.items()
    }
    return [{name: values[i] for name, values in drawn.items()} for i in range(len(agents))]


def _with_loops(
    agents: Iterable[AgentPlan], blueprints: Mapping[str, Blueprint], layout: MessageLayout, problems: Problems
) -> tuple[AgentPlan, ...]:
    """The agents, those with outputs that feed each other directly in the loop that can solve them.

    `joint` solves such loops, and says so; `midpoint` wants outputs in the order in which they feed through.
    """
    known: dict[int, CouplingPlan] = {}
    found = []
    for agent in agents:
        blueprint = blueprints[agent.name]
        if id(blueprint) not in known:
            where = blueprint.where("connections")
            known[id(blueprint)] = agent.coupling
            if agent.coupling.control is not None:
                warn_unwatched(agent, wire(agent, layout), blueprint.where("coupling", "tolerance"), problems)
            if agent.coupling.method is Method.MIDPOINT:
                warn_of_order(agent, where, problems)
            elif agent.coupling.method is Method.JOINT:
                try:
                    loops = wire(agent, layout).loops
                except AlgebraicLoopError as error:
                    problems.error(str(error), where)
                else:
                    known[id(blueprint)] = solving(blueprint.entry, agent.coupling, loops, where, problems)
        coupling = known[id(blueprint)]
        found.append(agent if coupling is agent.coupling else replace(agent, coupling=coupling))
    return tuple(found)
