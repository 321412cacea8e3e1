"""Model Exchange components stepped by CVODE, beside those of Co-Simulation."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cosim.components.python import Output, PythonComponent
from cosim.errors import ConfigError, RunError
from cosim.plan import Loop, Method, Plan
from cosim.running import inline
from tests.components.probe import description2, description3, with_indicator, write_fmu
from tests.distributed.networks import planned


class Ramp(PythonComponent):
    """y = (t, 0)."""

    y = Output(shape=(2,))

    def outputs(self, time: float) -> None:
        self.y = time, 0.0


class Record:
    """Keeps every row."""

    def __init__(self) -> None:
        self.rows: list[Any] = []

    def tick(self, _tick: int, row: Any) -> None:
        self.rows.append(row)

    def fates(self, _fates: Any) -> None: ...


def play(plan: Plan) -> np.ndarray:
    record = Record()
    inline.run(plan, [record])
    return np.array(record.rows)


def scenario(components: dict[str, Any], record: list[str], **agent: Any) -> Plan:
    tree = {
        "name": "cvode",
        "seed": 1,
        "period": "100 ms",
        "duration": "1 s",
        "agents": {"1": {"components": components, "record": record, **agent}},
    }
    return planned(json.dumps(tree))


@pytest.fixture(scope="module")
def indicated(probe_library: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("indicated")
    texts = {2: description2(), 3: description3()}
    return {v: write_fmu(folder / f"probe{v}.fmu", probe_library, with_indicator(t)) for v, t in texts.items()}


def probe(path: Path, fails: str = "nothing", rate: float = 13.7, **more: Any) -> dict[str, Any]:
    start = {"fails": fails, "vector_in": [rate - 10.0, 0]}
    return {"fmu": str(path), "start": start, "solver": "cvode", **more}


@pytest.mark.parametrize("fmi", [2, 3])
def test_events_on_the_way(indicated: dict[int, Path], fmi: int) -> None:
    """x' = 13.7 and x falls from 2 to 1 on its way, and there are time events every 0.03 s."""
    plan = scenario({"probe": probe(indicated[fmi])}, ["probe.x"])
    assert plan.agents[0].coupling.loop is Loop.PYTHON
    assert plan.agents[0].coupling.method is Method.MIDPOINT
    x = play(plan)[:, 0]
    assert np.abs(x - (1.0 + 13.7 * 0.1 * np.arange(11) % 1.0)).max() < 1e-6


@pytest.mark.parametrize("method", ["midpoint", "gauss-seidel", "jacobi"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_state_event_that_an_input_causes(
    indicated: dict[int, Path], fmi: int, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The indicator is u - 0.5, u = t, and x' = 1 from there on: x(1 s) = 1.5, but for a step that u is held."""
    monkeypatch.setitem(sys.modules, "cvode_ramp", sys.modules[Ramp.__module__])
    components = {"ramp": {"python": "cvode_ramp:Ramp"}, "relay": probe(indicated[fmi], "relays", 10.0)}
    for step in (10, 1):
        coupling = {"method": method, "step": f"{step} ms"}
        plan = scenario(components, ["relay.x"], connections=["ramp.y -> relay.vector_in"], coupling=coupling)
        assert abs(play(plan)[-1, 0] - 1.5) < 1.001e-3 * step


@pytest.mark.parametrize("interval", [0.007, 0.01, 1 / 60])
@pytest.mark.parametrize("fmi", [2, 3])
def test_time_events_at_the_ends_of_micro_steps(probes: dict[int, Path], fmi: int, interval: float) -> None:
    """x' counts the multiples of the interval: an event that is a step late would show in x."""
    own = probe(probes[fmi], "ticks", tolerance=1e-10)
    own["start"]["vector_in"] = [1.0, interval]
    x = play(scenario({"own": own}, ["own.x"], coupling={"step": "1 ms"}))[-1, 0]
    events = interval * np.arange(1, 200)
    assert x == pytest.approx(1.0 + np.maximum(1.0 - events, 0.0).sum(), rel=1e-9)


def test_a_stiff_arm_beside_its_controller() -> None:
    """`midpoint` with the plant stepped by CVODE tends to the same motion as `joint`."""
    wires = ["plant.p -> controller.p", "plant.v -> controller.v", "controller.u -> plant.u"]
    controller = {"fmu": "ArmSyncController", "start": {"n_neighbours": 0}}
    plant = {"fmu": "TwoLinkArm", "start": {"p": [0.5, -0.8]}}
    joint = play(scenario({"plant": plant, "controller": controller}, ["plant.p"], connections=wires))
    stepped = {**plant, "solver": "cvode", "tolerance": 1e-10}
    mixed = play(scenario({"plant": stepped, "controller": controller}, ["plant.p"], connections=wires))
    assert np.abs(mixed - joint).max() < 1e-5


def test_two_runs_are_equal(indicated: dict[int, Path]) -> None:
    runs = [play(scenario({"probe": probe(indicated[3], isolate=isolate)}, ["probe.x"])) for isolate in (False, True)]
    assert runs[0].tobytes() == runs[1].tobytes()


def test_the_resolved_scenario_says_so(indicated: dict[int, Path]) -> None:
    plan = scenario({"probe": probe(indicated[3], tolerance=1e-5)}, ["probe.x"])
    again = planned(plan.scenario)
    assert again.agents[0].components[0].cvode == plan.agents[0].components[0].cvode == 1e-5
    assert yaml.safe_load(again.scenario) == yaml.safe_load(plan.scenario)


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        ("derivative_error", "GetDerivatives|ContinuousStateDerivatives returned Error"),
        ("derivative_nan", "CVODE gave up"),
        ("chatters", "had more than 1000 events within one step"),
        ("update_stops", "asks to end the simulation"),
    ],
)
@pytest.mark.parametrize("fmi", [2, 3])
def test_failures(indicated: dict[int, Path], fmi: int, fails: str, said: str, capfd: Any) -> None:
    with pytest.raises(RunError, match=said) as caught:
        play(scenario({"probe": probe(indicated[fmi], fails)}, ["probe.x"]))
    assert caught.value.component == "probe"
    assert capfd.readouterr().err == ""


def test_it_takes_model_exchange(probe_library: Path, tmp_path: Path) -> None:
    text = description3().replace('<ModelExchange modelIdentifier="probe"/>', "")
    path = write_fmu(tmp_path / "x.fmu", probe_library, text)
    with pytest.raises(ConfigError, match="'solver' takes Model Exchange, which 'probe' does not offer"):
        scenario({"probe": probe(path)}, ["probe.x"])
