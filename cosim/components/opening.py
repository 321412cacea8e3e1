"""From a plan to live components: FMUs and Python classes alike, each from its own module, imported when needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cosim.attention import COMPONENT, idle
from cosim.components.component import Component, Description, Interface
from cosim.components.presented import own_starts
from cosim.errors import ComponentError, RunError
from cosim.logs import NO_LOGS, Logs, Sink
from cosim.plan import AgentPlan, ComponentPlan, Method
from network.messages import Ints


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


def open_components(plan: AgentPlan, logs: Logs = NO_LOGS, attended: Ints | None = None) -> list[Component]:
    """The components of an agent, instantiated and with their start values set; none is left open when one fails.

    Args:
        plan: of the agent.
        logs: where what they log goes.
        attended: kept up to date; see `cosim.attention`.

    Raises:
        ConfigError: a file or class cannot be used any more.
        RunError: a component refuses.
    """
    joint = plan.coupling.method is Method.JOINT
    interface = Interface.MODEL_EXCHANGE if joint else Interface.CO_SIMULATION
    components: list[Component] = []
    attended = idle() if attended is None else attended
    try:
        for place, part in enumerate(plan.components):
            log = logs.sink(f"{plan.name}.{part.name}")
            attended[COMPONENT] = place
            component = _open(part, interface, log)
            component.attend(attended, place)
            components.append(component)
            set_start_values(component, part)
    except ComponentError as error:
        terminate(components)
        raise RunError(plan.name, error.component, 0.0, error.message, error.log) from error
    except BaseException:
        terminate(components)
        raise
    return components


def open_component(  # noqa: PLR0917
    name: str, path: Path | None, python: str | None, interface: Interface, description: Description, log: Sink
) -> Component:
    """A component in this process, instantiated; see `describe`.

    Raises:
        ConfigError: the file or class cannot be used any more.
        ComponentError: it refuses.
    """
    if path is not None:
        from cosim.components.fmu import open_fmu

        return open_fmu(name, path, interface, description, log)
    from cosim.components.python import PythonInstance

    return PythonInstance(name, python or "", interface, description)


def _open(plan: ComponentPlan, interface: Interface, log: Sink) -> Component:
    open_part = _here if plan.isolation is None else _isolated
    if plan.cvode is None:
        return open_part(plan, interface, log)
    from cosim.components.cvode import CvodeComponent

    return CvodeComponent(open_part(plan, Interface.MODEL_EXCHANGE, log), plan.cvode)


def _here(plan: ComponentPlan, interface: Interface, log: Sink) -> Component:
    own = plan.description.own or plan.description
    return open_component(plan.name, plan.path, plan.python, interface, own, log)


def _isolated(plan: ComponentPlan, interface: Interface, log: Sink) -> Component:
    from cosim.components.isolation import IsolatedComponent

    return IsolatedComponent(plan, interface, log)


def open_started(plan: ComponentPlan, interface: Interface) -> Component:
    """One component by itself, in this process, instantiated and with its start values set.

    Raises:
        ConfigError: its file or class cannot be used any more.
        ComponentError: it refuses.
    """
    component = _here(plan, interface, NO_LOGS.sink(plan.name))
    try:
        set_start_values(component, plan)
    except BaseException:
        component.terminate()
        raise
    return component


def set_start_values(component: Component, plan: ComponentPlan) -> None:
    """Those of the plan; structural parameters first: they size the others.

    Raises:
        ComponentError: it refuses one.
    """
    starts = own_starts(plan.description.variables, plan.start)
    for variable, values in sorted(starts, key=lambda start: start[0].causality != "structuralParameter"):
        component.start(variable, values)


def await_open(plan: AgentPlan, components: Sequence[Component]) -> None:
    """Return when all components of an agent are open, in whatever process.

    Raises:
        ConfigError: a file or class cannot be used any more.
        RunError: a component refuses.
    """
    try:
        for component in components:
            component.await_open()
    except ComponentError as error:
        raise RunError(plan.name, error.component, 0.0, error.message, error.log) from error


def terminate(components: Sequence[Component]) -> None:
    """End components; safe after a failure, and twice."""
    for component in components:
        component.terminate()
