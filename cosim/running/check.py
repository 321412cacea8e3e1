"""`cosim check`: everything that can be said of a scenario before it runs, as a text that people read.

It instantiates and initialises every component, so that a start value which an FMU refuses is found here.
"""

from __future__ import annotations

import math
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from cosim.agents.group import Agents
from cosim.errors import CosimError, Location, Problem, Severity
from cosim.native_output import captured
from cosim.plan import AgentPlan, ComponentPlan, CouplingPlan, Loop, Method, Plan
from cosim.running.stopping import StopRequest
from cosim.running.watching import Watch
from cosim.scenario.names import in_short
from cosim.scenario.source import dump_on_one_line
from cosim.theory import mu, published_bound
from cosim.topology import kappa, reached_by, roots
from network.units import format_duration, to_seconds

Item = TypeVar("Item")
_PRINTED_CHUNKS = 4
"""How much is kept of what FMUs print, in pieces of up to 64 KiB."""


def open_all(plan: Plan, deadline: float) -> list[Problem]:
    """Instantiate and initialise every agent, as a run does, but those of which only the description is here.

    What FMUs print meanwhile is shown if one refuses: it may be all that they say.

    Args:
        plan: whose agents.
        deadline: seconds that an FMU may take for it.

    Returns:
        What could not be opened.

    Raises:
        ConfigError: a component cannot be opened.
        RunError: a component refuses a start value or its initialisation.
    """
    missing = absent(plan)
    here = [agent for agent in plan.agents if all(component.description.whole for component in agent.components)]
    printed = _Printed()
    try:
        with captured(printed.take):
            _open(plan, here, deadline, printed)
    except CosimError:
        printed.show()
        raise
    return [replace(problem, severity=Severity.WARNING) for problem in missing]


def _open(plan: Plan, agents: Sequence[AgentPlan], deadline: float, printed: _Printed) -> None:
    stop = StopRequest()
    with stop.listening(), Watch(agents, plan.period_ns, deadline, stop, printed) as watch, watch.at_components:
        opened = watch.agents = Agents(plan, agents, watch.attended)
        try:
            opened.initialise()
        finally:
            opened.terminate()
    if stop():
        raise KeyboardInterrupt


class _Printed:
    """What FMUs print, and all that is kept if they crash or hang."""

    def __init__(self) -> None:
        self._chunks: deque[bytes] = deque(maxlen=_PRINTED_CHUNKS)

    def take(self, data: bytes) -> None:
        """Another piece."""
        self._chunks.append(data)

    def show(self) -> None:
        """On the screen."""
        if text := b"".join(self._chunks).decode(errors="replace").strip():
            print(text, file=sys.stderr)

    def keep(self, error: CosimError, *, in_order: bool) -> None:  # noqa: ARG002 - as of `cosim.running.watching.Record`
        self.show()


def absent(plan: Plan) -> list[Problem]:
    """Every FMU of which only the description is here."""
    files = [
        (component.path, agent.name)
        for agent in plan.agents
        for component in agent.components
        if component.path is not None and not component.description.whole
    ]
    return [
        Problem(f"holds only the description of an FMU, which agents {names} need", Location(str(path)))
        for path, names in _grouped((name, path) for path, name in files)
    ]


def describe(plan: Plan) -> str:
    """The report: what runs, what the graph and the channels allow, and the paper's published condition."""
    sections = (_summary(plan), _agents(plan), _graph(plan), _channels(plan), _bridge(plan), _condition(plan))
    return "\n\n".join("\n".join(section) for section in sections if section)


def _grouped(values: Iterable[tuple[str, Item]]) -> Iterator[tuple[Item, str]]:
    """Equal values together, with the agents that have them, in the order of first appearance."""
    groups: dict[Item, list[str]] = {}
    for name, value in values:
        groups.setdefault(value, []).append(name)
    for value, names in groups.items():
        yield value, in_short(names)


def _lines(label: str, plan: Plan, value: Callable[[AgentPlan], str]) -> Iterator[str]:
    """One line per distinct value; the agents are named if there are several."""
    groups = list(_grouped((agent.name, value(agent)) for agent in plan.agents))
    for text, names in groups:
        yield _line(label, text if len(groups) == 1 else f"{text}: {names}")
        label = ""


def _line(label: str, text: str) -> str:
    return f"  {label:<18}{text}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


# --- what runs --------------------------------------------------------------------------------------------------------


def _summary(plan: Plan) -> list[str]:
    end = format_duration(plan.ticks * plan.period_ns)
    return [
        f"{plan.name}{f': {plan.title}' if plan.title else ''}",
        _line("time", f"{end} in {_count(plan.ticks, 'period')} of {format_duration(plan.period_ns)}"),
        _line("seed", str(plan.seed)),
    ]


def _agents(plan: Plan) -> list[str]:
    sizes = ", ".join(f"{name}[{size}]" for name, size in zip(plan.layout.names, plan.layout.sizes, strict=True))
    return [
        _count(len(plan.agents), "agent"),
        *_lines("components", plan, lambda agent: ", ".join(map(_component, agent.components))),
        *_lines("coupling", plan, lambda agent: _coupling(agent.coupling)),
        _line("message", sizes or "none"),
    ]


def _component(component: ComponentPlan) -> str:
    description = component.description
    kind = "Python" if description.fmi == "python" else f"FMI {description.fmi}"
    return f"{component.name} = {description.model} ({kind})"


def _coupling(coupling: CouplingPlan) -> str:
    integrator = f", {coupling.integrator}" if coupling.method is Method.JOINT else ""
    loop = "native loop" if coupling.loop is Loop.NATIVE else "Python loop"
    if (control := coupling.control) is not None:
        how = "step doubling" if control.rollback else "by the change of the inputs: not all can save their state"
        least, largest = format_duration(control.least_ns), format_duration(coupling.step_ns)
        return f"{coupling.method}, {least} to {largest} for {control.relative_tolerance:g} ({how}), {loop}"
    grid = ", arrivals wait for the end of a step" if coupling.grid else ""
    return f"{coupling.method}{integrator}, {format_duration(coupling.step_ns)}, {loop}{grid}"


# --- who hears whom ---------------------------------------------------------------------------------------------------


def _graph(plan: Plan) -> list[str]:
    names = plan.links.agents
    found = roots(plan.links)
    lines = [
        f"Graph: {_count(len(plan.links), 'edge')}",
        _line("roots", in_short(names[i] for i in found) or "none: the graph is not rooted"),
    ]
    if plan.analysis.leaders:
        lines += _leaders(plan, found)
    lines += _lines("in-neighbours", plan, lambda agent: str(len(agent.neighbours)))
    sums = kappa(plan.links, plan.weights).tolist()
    lines += _lines("kappa", plan, lambda agent: f"{sums[agent.index]:.6g}")
    return lines


def _leaders(plan: Plan, found: Sequence[int]) -> list[str]:
    names, leaders = plan.links.agents, plan.analysis.leaders
    everywhere = {names[i] for i in found}
    reach = [(leader, "" if leader in everywhere else _unreached(plan, leader)) for leader in leaders]
    lines = [_line("leaders", in_short(leaders))]
    for unreached, who in _grouped(reach):
        lines.append(_line("", f"{who}: {f'not reached: {unreached}' if unreached else 'every agent is reached'}"))
    return lines


def _unreached(plan: Plan, start: str) -> str:
    names = plan.links.agents
    return in_short(names[i] for i in np.flatnonzero(~reached_by(plan.links, names.index(start))))


# --- what the network does --------------------------------------------------------------------------------------------


def _channels(plan: Plan) -> list[str]:
    if not plan.channels:
        return []
    used = Counter(plan.link_channel)
    lines = ["Channels"]
    for name, model in plan.channels.items():
        parameters = model.as_written()
        kind = parameters.pop("model")
        shown = ", ".join(f"{key} {_plain(value)}" for key, value in parameters.items())
        lines.append(_line(name, f"{kind}{f' ({shown})' if shown else ''}, {_count(used[name], 'edge')}"))
        bound = model.age_bound_ns(plan.period_ns)
        age = f"{to_seconds(bound):.6g} s" if bound is not None else "no bound"
        lines.append(_line("", f"least delay {format_duration(model.min_delay_ns())}; age at ticks at most: {age}"))
    return lines


def _plain(value: object) -> str:
    return " to ".join(map(str, value)) if isinstance(value, list) else dump_on_one_line(value)


# --- who is outside ---------------------------------------------------------------------------------------------------


def _bridge(plan: Plan) -> list[str]:
    """What others find on which keys, and what they are to send."""
    bridge, names = plan.bridge, [agent.name for agent in plan.agents]
    published, taken = [], []
    for publication in bridge.publish:
        name, size = names[publication.agent], publication.part.stop - publication.part.start
        variable = f"{publication.variable}[{size}]"
        published.append((name, f"{_template(publication.key, name)}: {variable} as {publication.encoding}"))
    for agent in plan.agents:
        for external in agent.external:
            subscription = bridge.subscribe[external.subscription]
            port = external.port
            variable = f"{agent.components[port.component].name}.{port.variable.name}[{subscription.size}]"
            start = [f"{number:.6g}" for number in external.start]
            first = ", ".join([*start[:4], *(["…"] if start[4:] else [])])
            said = f"{variable} as {subscription.encoding}, at first {first}"
            taken.append((agent.name, f"{_template(subscription.key, agent.name)}: {said}"))
    lines = [f"Bridge: {bridge.where}"] if bridge else []
    for label, values in (("publishes", published), ("takes", taken)):
        lines += [_line(label, f"{what}; agents {who}") for what, who in _grouped(values)]
    return lines


def _template(key: str, agent: str) -> str:
    return "/".join("{agent}" if chunk == agent else chunk for chunk in key.split("/"))


# --- the paper's condition --------------------------------------------------------------------------------------------


def _condition(plan: Plan) -> list[str]:
    """μ_i > 1 + 2h*, as published; only where the scenario says which parameters are k_eta and lambda."""
    k_eta, lambda_ = plan.analysis.k_eta, plan.analysis.lambda_
    if k_eta is None or lambda_ is None:
        return []
    listening = [a for a in plan.agents if a.neighbours and a.name in k_eta and a.name in lambda_]
    mus = {agent.name: mu(k_eta[agent.name], lambda_[agent.name]) for agent in listening}
    ages = _ages(plan)
    lines = [
        "The paper's published condition: mu_i > 1 + 2 h*, that is h* < (mu_i - 1)/2",
        *(_line(*pair) for pair in _labelled("mu_i", [(a.name, f"{mus[a.name]:.6g}") for a in listening])),
        *(_line(*pair) for pair in _labelled("h*", [(a.name, _seconds(ages[a.index])) for a in listening])),
        *(_line(*pair) for pair in _labelled("", [(a.name, _verdict(mus[a.name], ages[a.index])) for a in listening])),
        "  h* is the largest age of information read at a tick. The condition is shown as published and guarantees",
        "  nothing: its proof has a gap, and runs that violate it often still converge.",
    ]
    return lines if listening else []


def _labelled(label: str, values: Sequence[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    groups = list(_grouped(values))
    for text, names in groups:
        yield label, text if len(groups) == 1 else f"{text}: {names}"
        label = ""


def _ages(plan: Plan) -> list[float]:
    """Per agent, the largest age at ticks over its incoming edges in seconds; infinite if a channel has no bound."""
    ages = [0.0] * len(plan.agents)
    for receiver, name in zip(plan.links.receiver.tolist(), plan.link_channel, strict=True):
        bound = plan.channels[name].age_bound_ns(plan.period_ns)
        ages[receiver] = max(ages[receiver], math.inf if bound is None else to_seconds(bound))
    return ages


def _seconds(age: float) -> str:
    return "no bound: a channel may lose any number of messages in a row" if math.isinf(age) else f"{age:.6g} s"


def _verdict(mu_i: float, age: float) -> str:
    bound = published_bound(mu_i)
    if math.isinf(age):
        return f"cannot be evaluated; it would ask for h* < {bound:.6g} s"
    word = "holds" if age < bound else "does not hold"
    return f"{word}: h* = {age:.6g} s, (mu_i - 1)/2 = {bound:.6g} s, margin {bound - age:.2g} s"
