"""Components with micro steps of their own: what they make of them, and which fit."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from cosim.components.component import Floats
from cosim.components.python import Input, Output, PythonComponent
from tests.distributed.networks import in_process, planned
from tests.scenario.scenarios import errors


class Euler(PythonComponent):
    """x' = 50 (u - x), one step of Euler's method per communication step."""

    u = Input()
    x = Output(depends_on=())
    steps = Output(dtype="Int64", depends_on=())

    def step(self, time: float, step: float) -> None:
        self.x = self.x + step * 50.0 * (self.u - self.x)
        self.steps = self.steps + 1


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """pytest imports this file under a name of its own."""
    monkeypatch.setitem(sys.modules, "multirate", sys.modules[Euler.__module__])


def scenario(coupling: str, *own: str) -> str:
    """A chain: the sine drives the actuator, it the plant, it the sensor."""
    names = ("actuator", "plant", "sensor")
    components = "".join(
        f'      {name}: {{python: "multirate:Euler"{step}}}\n' for name, step in zip(names, own, strict=True)
    )
    return f"""\
period: 100 ms
duration: 500 ms
agents:
  1:
    components:
      sine: {{python: "cosim.components.library:Sine", start: {{phase: 1.5707963267948966, frequency: 0}}}}
{components}\
    connections: [sine.phi -> actuator.u, actuator.x -> plant.u, plant.x -> sensor.u]
    record: [actuator.x, plant.x, sensor.x, actuator.steps, plant.steps, sensor.steps]
coupling: {{{coupling}}}
"""


def rows(text: str) -> Floats:
    record, error = in_process(planned(text))
    assert error is None
    found: Floats = np.array([np.frombuffer(row) for _, row in record.ticks])
    return found


@pytest.mark.parametrize("method", ["gauss-seidel", "jacobi"])
def test_each_makes_its_own_steps(method: str) -> None:
    """The actuator, whose input is constant, is exact to its own step; 10 ms would be 0.5 of its time constant."""
    found = rows(scenario(f"method: {method}, step: 10 ms", ", step: 0.1 ms", ", step: 5 ms", ""))
    assert found[-1, 3:].tolist() == [5000, 100, 50]
    exact = 2.0 * (1.0 - (1.0 - 50.0 * 1e-4) ** (1000 * np.arange(6)))
    assert np.abs(found[:, 0] - exact).max() < 1e-12


def test_half_steps_of_midpoint_are_cut_too() -> None:
    found = rows(scenario("method: midpoint, step: 10 ms", ", step: 1 ms", ", step: 1 ms", ""))
    assert found[-1, 3:].tolist() == [500, 500, 100]


def test_the_slowest_sets_the_exchange() -> None:
    plan = planned(scenario("method: gauss-seidel", ", step: 0.5 ms", ", step: 20 ms", ""))
    coupling = plan.agents[0].coupling
    assert coupling.step_ns == 20_000_000
    assert coupling.parts == (1, 40, 1, 1)
    assert planned(plan.scenario).agents[0].coupling == coupling


@pytest.mark.parametrize(
    ("coupling", "own", "said"),
    [
        (
            "method: jacobi, step: 10 ms",
            "3 ms",
            "the step 3 ms of 'plant' does not divide the coupling's step 10 ms; 2.5 ms does",
        ),
        (
            "method: jacobi, step: 5 ms",
            "10 ms",
            "'plant' cannot step every 10 ms where values are exchanged every 5 ms; write `coupling: {step: 10 ms}`",
        ),
        ("method: jacobi", "30 ms", "the step 30 ms of 'plant' does not divide the period; 25 ms does"),
        ("method: jacobi", "0 s", "it must be more than 0"),
    ],
)
def test_steps_that_do_not_fit(tmp_path: Path, coupling: str, own: str, said: str) -> None:
    (found,) = errors(tmp_path, scenario(coupling, "", f", step: {own}", ""))
    assert said in found.message
    assert found.where is not None
    assert found.where.line == 8


def test_one_step_for_all_that_are_integrated_together(tmp_path: Path) -> None:
    text = scenario("method: joint", "", "", "").replace("multirate:Euler", "cosim.components.library:Hold")
    text = text.replace(".u", ".values").replace(".x", ".value").replace("    record:", "    # record:")
    text = text.replace('Hold"}\n', 'Hold", step: 1 ms}\n', 1)
    (found,) = errors(tmp_path, text)
    assert "'joint' integrates all components with one step" in found.message
