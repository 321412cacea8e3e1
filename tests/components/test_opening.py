"""From plans to live components."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import fmus
from cosim.components.component import Component, Interface, Value
from cosim.components.fmu import FmuComponent
from cosim.components.opening import describe, open_components
from cosim.errors import RunError
from cosim.plan import AgentPlan, ComponentPlan, Method
from tests.agents.plans import alone


def agent(*components: ComponentPlan, method: Method = Method.JOINT) -> AgentPlan:
    return alone(components, name="7", method=method)


def sine() -> ComponentPlan:
    name = "cosim.components.library:Sine"
    return ComponentPlan("sine", None, name, describe(None, name, {}), {"amplitude": (3.0,)})


def controller(path: Path, n: int) -> ComponentPlan:
    description = describe(path, None, {"n_neighbours": n})
    start: dict[str, tuple[Value, ...]] = {"neighbour_p": (0.5,) * 2 * n, "role": ("leader",), "n_neighbours": (n,)}
    return ComponentPlan("controller", path, None, description, start)


@pytest.mark.parametrize("method", [Method.JOINT, Method.JACOBI])
def test_fmus_and_python_classes_side_by_side(method: Method) -> None:
    plan = agent(sine(), controller(fmus.path("ArmSyncController"), 3), method=method)
    components = open_components(plan)
    wanted = Interface.MODEL_EXCHANGE if method is Method.JOINT else Interface.CO_SIMULATION
    assert [component.interface for component in components] == [wanted] * 2
    for component in components:
        component.enter_initialization(0.0, 1.0)
        component.exit_initialization()
    variables = plan.components[1].description.variables
    assert components[1].get(variables["neighbour_p"]).tolist() == [0.5] * 6
    assert components[1].get(variables["role"]).tolist() == [2.0]
    assert components[0].get(plan.components[0].description.variables["amplitude"]).tolist() == [3.0]
    for component in components:
        component.terminate()


def test_structural_parameters_come_first() -> None:
    """Otherwise the array's six start values would not fit."""
    plan = controller(fmus.path("ArmSyncController"), 3)
    plan = replace(plan, start={**plan.start, "neighbour_p": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)})
    (component,) = open_components(agent(plan))
    component.enter_initialization(0.0, 1.0)
    component.exit_initialization()
    assert component.get(plan.description.variables["neighbour_p"]).tolist() == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    component.terminate()


def test_none_is_left_open_when_one_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[Component] = []
    terminate = FmuComponent.terminate

    def watch(component: FmuComponent) -> None:
        ended.append(component)
        terminate(component)

    monkeypatch.setattr(FmuComponent, "terminate", watch)
    good = controller(fmus.path("ArmSyncController.fmi2"), 16)
    bad = replace(good, name="second", start={"role": ("boss",)})
    with pytest.raises(RunError) as caught:
        open_components(agent(good, bad))
    assert caught.value.agent == "7"
    assert caught.value.component == "second"
    assert "role has no item 'boss'" in caught.value.message
    assert [component.name for component in ended] == ["controller", "second"]
