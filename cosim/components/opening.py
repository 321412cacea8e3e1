"""From a plan to live components: FMUs and Python classes alike, each from its own module, imported when needed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cosim.components.component import Component, Description, Interface
from cosim.components.presented import own_starts
from cosim.errors import ComponentError, RunError
from cosim.plan import AgentPlan, ComponentPlan, Method


def describe(path: Path | None, python: str | None, structural: Mapping[str, int]) -> Description:
    """What a component says of itself before it is instantiated.

    Args:
        path: of an FMU, or None.
        python: `package.module:Class`, used if `path` is None.
        structural: values of structural parameters; other names are ignored.

    Raises:
        ConfigError: it cannot be used; the message says why.
    """
    if path is not None:
        from cosim.components import fmu

        return fmu.describe(path, structural)
    from cosim.components.python import describe_python

    return describe_python(python or "", structural)


def open_components(plan: AgentPlan) -> list[Component]:
    """The components of an agent, instantiated and with their start values set; none is left open when one fails.

    Raises:
        ConfigError: a file or class cannot be used any more.
        RunError: a component refuses.
    """
    joint = plan.coupling.method is Method.JOINT
    interface = Interface.MODEL_EXCHANGE if joint else Interface.CO_SIMULATION
    components: list[Component] = []
    try:
        for component_plan in plan.components:
            component = _open(component_plan, interface)
            components.append(component)
            _start(component, component_plan)
    except ComponentError as error:
        _terminate(components)
        raise RunError(plan.name, error.component, 0.0, error.message, error.log) from error
    except BaseException:
        _terminate(components)
        raise
    return components


def _open(plan: ComponentPlan, interface: Interface) -> Component:
    own = plan.description.own or plan.description
    if plan.path is not None:
        from cosim.components.fmu import open_fmu

        return open_fmu(plan.name, plan.path, interface, own)
    from cosim.components.python import PythonInstance

    return PythonInstance(plan.name, plan.python or "", interface, own)


def _start(component: Component, plan: ComponentPlan) -> None:
    """Structural parameters first: they size the others."""
    starts = own_starts(plan.description.variables, plan.start)
    for variable, values in sorted(starts, key=lambda start: start[0].causality != "structuralParameter"):
        component.start(variable, values)


def _terminate(components: list[Component]) -> None:
    for component in components:
        component.terminate()
