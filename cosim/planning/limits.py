"""Start values that lie outside of what a component declares for them (`min`, `max`): it may refuse them, or not."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.components.component import Value, Variable
from cosim.components.limits import outside
from cosim.components.presented import elements_of, find, own_value
from cosim.plan import ComponentPlan
from cosim.planning.blueprint import Blueprint
from cosim.planning.problems import Problems
from cosim.planning.starts import is_drawn
from cosim.recording.columns import scalar_names


def warn_of_limits(
    blueprint: Blueprint, agents: Sequence[str], components: Sequence[Sequence[ComponentPlan]], problems: Problems
) -> None:
    """One warning for every start value that is written, and breaks limits in one of the agents.

    Args:
        blueprint: of agents alike.
        agents: their names.
        components: of each, with its start values.
        problems: where warnings go.
    """
    for place, part in enumerate(blueprint.parts):
        for name, written in part.start.items():
            variable = find(part.description.variables, name)
            if variable is None or not any(element.variable.limits for element in elements_of(variable)):
                continue
            drawn = any(map(is_drawn, written))
            for agent, of_agent in zip(agents if drawn else agents[:1], components, strict=False):
                if said := _outside(variable, of_agent[place].start[name]):
                    who = f" in agent {agent!r}" if drawn else ""
                    text = f"{said}{who}: what the component makes of that is its own affair"
                    problems.warning(text, blueprint.where("components", part.name, "start", name))
                    break


def _outside(variable: Variable, values: Sequence[Value]) -> str:
    """The first of the values that breaks limits, in words."""
    names = scalar_names(variable.name, variable.shape)
    for name, element, value in zip(names, elements_of(variable), values, strict=True):
        own = own_value(variable, element, value)
        if said := outside(element.variable, element.index, own):
            shown = f"{own:.9g}" if isinstance(own, float) else own
            return f"{name!r} starts at {shown}, {said}"
    return ""
