"""Steps that keep to a tolerance: the error against exact solutions, what they cost, and the same steps anywhere."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import fmus
from cosim.agents.memory import LoopMemory
from cosim.agents.step_control import Saved, StepAccount
from cosim.components.component import Component, Floats, Interface
from cosim.components.fmu import describe, open_fmu
from cosim.errors import RunError
from cosim.running.inline import run
from tests.accuracy.coupled_oscillators import SPLITS, Oscillators, build_models, error
from tests.accuracy.test_estimate import SCENARIO, exact
from tests.components.misbehaving import cosim, digest
from tests.distributed.loopback import Loopback
from tests.distributed.networks import Record, planned

TRANSIENT = Oscillators(d=(6.0, 3.0), d_c=3.0)
"""Dampers bring the masses to rest within a second or two."""

PD = "{fmu: PDController, start: {k_p: 20, k_d: 3, p_ref: 0.4, v_ref: 0, u_ref: 0}}"
HAND = '{python: "tests.accuracy.hand:Hand"}'
DEVICE = '{python: "tests.accuracy.hand:Device"}'
LOOP = SCENARIO.replace(PD.replace("{", "{{").replace("}", "}}"), "{pd}").replace(
    "method: {method}, step: {step}", "{coupling}"
)

NETWORK = """\
period: 100 ms
duration: 1.5 s
seed: 4
templates:
  mass:
    components:
      plant: {fmu: MassSpringDamper, start: {p: {uniform: [-1, 1]}}}
      controller: {fmu: ConsensusController}
    connections: [plant.p -> controller.p, plant.v -> controller.v, controller.u -> plant.u]
    publish: {p: plant.p, v: plant.v}
    receive: {p: controller.neighbour_p, v: controller.neighbour_v, stamp: controller.neighbour_stamp,
              count: controller.n_neighbours}
    record: [plant.p, plant.v]
agents: {1..4: {template: mass}}
coupling: {method: midpoint, tolerance: 1e-6}
channels: {used: {model: netem, delay: [10 ms, 220 ms], loss: 10 %}}
graph: {channel: used, edges: [1 -> 2, 2 -> 3, 3 -> 4, 4 -> 1, 2 -> 1]}
"""


CONTROLLED = "tolerance: 1e-6"


@dataclass
class Accounted(Record):
    """An observer that keeps all it is told, rows and accounts as well."""

    rows: list[Floats] = field(default_factory=list)
    accounts: list[StepAccount] = field(default_factory=list)

    def tick(self, tick: int, row: Floats) -> None:
        super().tick(tick, row)
        self.rows.append(row.copy())

    def steps(self, accounts: Sequence[StepAccount]) -> None:
        self.accounts += accounts


def played(text: str) -> Accounted:
    seen = Accounted()
    run(planned(text), [seen])
    return seen


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_models(tmp_path_factory.mktemp("controlled"))


def oscillate(pair: Oscillators, split: str, built: Path, **coupling: object) -> tuple[float, StepAccount | None]:
    """The error of a position over 5 s, and what became of the steps."""
    scenario = pair.scenario(split, built) | {"duration": "5 s", "coupling": coupling}
    seen = played(yaml.safe_dump(scenario, sort_keys=False))
    return error(np.array(seen.rows), pair), seen.accounts[0] if seen.accounts else None


# --- the error --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize(
    ("method", "order", "tolerances"),
    [("midpoint", 2, (1e-3, 1e-5, 1e-7)), ("gauss-seidel", 1, (1e-3, 1e-5)), ("jacobi", 1, (1e-3, 1e-5))],
)
def test_error_follows_the_tolerance(
    split: str, method: str, order: int, tolerances: Sequence[float], built: Path
) -> None:
    """A step's error is of order p + 1 and all in all of order p: so the latter is as the tolerance to p / (p + 1)."""
    errors = []
    for tolerance in tolerances:
        found, account = oscillate(Oscillators(), split, built, method=method, tolerance=tolerance)
        assert account is not None
        assert account.ratio <= 1.0
        assert found < tolerance * account.steps, "the errors of all steps together are a bound"
        errors.append(found)
    slope = np.polyfit(np.log10(tolerances), np.log10(errors), 1)[0]
    assert slope == pytest.approx(order / (order + 1), abs=0.1)


def test_fast_transients_cost_less_than_with_fixed_steps(built: Path) -> None:
    """All that is stepped counts: a step of the control is one whole and two halves, and so is one that is rejected."""
    found, account = oscillate(TRANSIENT, "force-displacement", built, method="midpoint", tolerance=1e-5)
    assert account is not None
    cost = 3 * (account.steps + account.rejected)
    fixed, _ = oscillate(TRANSIENT, "force-displacement", built, method="midpoint", step="5 ms")
    assert found < fixed
    assert cost < 0.5 * 5.0 / 0.005
    assert account.longest > 10 * account.shortest


@pytest.mark.parametrize("method", ["midpoint", "gauss-seidel"])
def test_without_saved_states_the_change_of_the_inputs_decides(method: str) -> None:
    errors = []
    for tolerance in (1e-3, 1e-5):
        seen = played(LOOP.format(pd=DEVICE, coupling=f"method: {method}, tolerance: {tolerance}"))
        (account,) = seen.accounts
        assert (account.method, account.rejected) == ("change of the inputs", 0)
        errors.append(float(np.abs(np.array(seen.rows) - exact()).max()))
    assert errors[1] < 0.2 * errors[0] < 0.02


def test_a_python_component_takes_steps_back_as_an_fmu_does() -> None:
    fmu, hand = (played(LOOP.format(pd=pd, coupling="method: midpoint, tolerance: 1e-7")) for pd in (PD, HAND))
    (account,) = hand.accounts
    assert (account.method, account.steps, account.rejected) == ("step doubling", *counts(fmu))
    assert account.rejected > 0
    np.testing.assert_allclose(hand.rows, fmu.rows, atol=1e-12)


def counts(seen: Accounted) -> tuple[int, int]:
    (account,) = seen.accounts
    return account.steps, account.rejected


@pytest.mark.parametrize("rollback", [True, False])
def test_arrivals_at_which_inputs_jump(*, rollback: bool) -> None:
    """Beside steps of 10 us. The FMUs can save their state; the plan says that they cannot for the second way."""
    fine, fixed = (played(NETWORK.replace(CONTROLLED, f"step: {step}")) for step in ("10 us", "1 ms"))
    plan, seen, agents = planned(NETWORK), Accounted(), []
    for agent in plan.agents:
        assert agent.coupling.control is not None
        control = replace(agent.coupling.control, rollback=rollback)
        agents.append(replace(agent, coupling=replace(agent.coupling, control=control)))
    run(replace(plan, agents=tuple(agents)), [seen])
    errors = [float(np.abs(np.array(one.rows) - np.array(fine.rows)).max()) for one in (seen, fixed)]
    assert errors[0] < 5e-5 < 5e-4 < errors[1]
    assert max(account.steps for account in seen.accounts) < 1500, "as many as the fixed step makes"


def test_nothing_connected_needs_no_short_steps() -> None:
    text = LOOP.replace("    connections: [plant.p -> pd.p, plant.v -> pd.v, pd.u -> plant.u]\n", "")
    (account,) = played(text.format(pd=PD, coupling="method: midpoint, tolerance: 1e-9")).accounts
    assert (account.longest, account.rejected) == (0.1, 0)
    assert account.error < 1e-12


FORWARD = """\
period: 100 ms
duration: 5 s
agents:
  1:
    components: {{{components}}}
    connections: [sine.phi -> mass.u]
    record: {record}
coupling: {{{coupling}}}
"""
SINE = '{python: "cosim.components.library:Sine", start: {amplitude: 1, frequency: 3}}'
MASS = "{fmu: MassSpringDamper, start: {solver_step: 0.001}}"


@pytest.mark.parametrize("names", [("sine", "mass"), ("mass", "sine")])
@pytest.mark.parametrize(
    ("method", "order", "tolerances"),
    [("midpoint", 2, (1e-5, 1e-7)), ("gauss-seidel", 1, (1e-3, 1e-5)), ("jacobi", 1, (1e-3, 1e-5))],
)
def test_what_nobody_reads_keeps_to_the_tolerance_too(
    names: tuple[str, str], method: str, order: int, tolerances: Sequence[float]
) -> None:
    """The sine has no error, and only its output is connected. p'' = sin(3 t) - 0.5 v - p, of (p, v, sin, cos)."""
    matrix = np.array([[0, 1, 0, 0], [-1, -0.5, 1, 0], [0, 0, 0, 3], [0, 0, -3, 0]])
    true = [(expm(0.1 * k * matrix) @ [0, 0, 0, 1])[0] for k in range(51)]
    parts = {"sine": SINE, "mass": MASS}
    components = ", ".join(f"{name}: {parts[name]}" for name in names)
    errors = []
    for tolerance in tolerances:
        coupling = f"method: {method}, tolerance: {tolerance}"
        seen = played(FORWARD.format(components=components, record="[mass.p]", coupling=coupling))
        (account,) = seen.accounts
        assert account.variable in {"mass.p", "mass.v"}
        errors.append(float(np.abs(np.array(seen.rows)[:, 0] - true).max()))
        assert errors[-1] < tolerance * account.steps
    slope = np.polyfit(np.log10(tolerances), np.log10(errors), 1)[0]
    assert slope == pytest.approx(order / (order + 1), abs=0.15)


@pytest.mark.parametrize("fmi", ["", ".fmi2"])
def test_a_state_that_is_no_output_counts(fmi: str) -> None:
    """The only output of the controller that changes continuously, its torque, shows the sine's error a step late."""
    arm = f"{{fmu: ArmSyncController{fmi}, start: {{n_neighbours: 0, v_hat_start: [0.3, 0.6]}}}}"
    text = FORWARD.format(
        components=f"arm: {arm}, sine: {SINE}", record="[arm.u]", coupling="method: gauss-seidel, tolerance: 1e-4"
    ).replace("sine.phi -> mass.u", "sine.phi -> arm.p1")
    mapped = text.replace(f"arm: {arm}", f"arm: {arm[:-1]}, inputs: {{p1: {{to: 'p[1]'}}}}}}")
    (account,) = played(mapped).accounts
    assert account.variable.startswith(("arm.psi", "arm.eta", "arm.v_bar", "arm.theta_hat"))
    assert account.longest < 0.1


def test_a_tolerance_that_sees_nothing_is_a_warning(tmp_path: Path) -> None:
    judge = '{python: "tests.accuracy.hand:Judge"}'
    components = f"sine: {SINE}, mass: {MASS}, judge: {judge}"
    text = FORWARD.format(components=components, record="[judge.right]", coupling="method: midpoint, tolerance: 1e-6")
    text = text.replace("sine.phi -> mass.u", "mass.p -> judge.p")
    done = cosim(tmp_path, "check", "net.yaml", text=text)
    assert done.returncode == 0
    assert "net.yaml:8:41: warning: 'tolerance' sees no error here: 'judge', which reads others, has no" in done.stderr


# --- determinism ------------------------------------------------------------------------------------------------------
def test_the_same_steps_in_one_process_and_across_several() -> None:
    """Messages arrive between ticks, where inputs jump."""
    here = played(NETWORK)
    plan, there = planned(NETWORK), Accounted()
    Loopback(plan, 3, [there], random.Random(7)).run()
    assert there.ticks == here.ticks
    assert there.fates_of == here.fates_of
    assert there.accounts == here.accounts
    assert [account.agent for account in here.accounts] == ["1", "2", "3", "4"]
    assert sum(account.rejected for account in here.accounts) > 0


@settings(deadline=None, max_examples=30)
@given(
    fmi=st.sampled_from([2, 3]),
    before=st.lists(st.tuples(st.floats(-10, 10), st.floats(1e-6, 0.1)), max_size=3),
    taken_back=st.lists(st.tuples(st.floats(-10, 10), st.floats(1e-6, 0.1)), min_size=1, max_size=3),
    after=st.lists(st.tuples(st.floats(-10, 10), st.floats(1e-6, 0.1)), min_size=1, max_size=3),
)
def test_what_is_taken_back_leaves_no_trace(
    fmi: int,
    before: list[tuple[float, float]],
    taken_back: list[tuple[float, float]],
    after: list[tuple[float, float]],
) -> None:
    one, twin = opened(fmi), opened(fmi)
    try:
        time = drive(one, 0.0, before)
        assert drive(twin, 0.0, before) == time
        state = LoopMemory([(1, 1)]).state(0)
        state.signals[:], state.previous[:], state.steps[0] = 1.0, 2.0, 3.0
        with Saved([one], state) as saved:
            for _ in range(2):
                drive(one, time, taken_back)
                state.signals[:], state.previous[:], state.steps[0] = 4.0, 5.0, 6.0
                saved.restore()
                assert (state.signals[0], state.previous[0], state.steps[0]) == (1.0, 2.0, 3.0)
        drive(one, time, after)
        drive(twin, time, after)
        for name in ("p", "v"):
            variable = one.description.variables[name]
            assert one.get(variable).tobytes() == twin.get(variable).tobytes()
    finally:
        one.terminate()
        twin.terminate()


def opened(fmi: int) -> Component:
    path = fmus.path(f"MassSpringDamper.fmi{fmi}" if fmi == 2 else "MassSpringDamper")
    component = open_fmu("plant", path, Interface.CO_SIMULATION, describe(path))
    component.enter_initialization(0.0, 10.0)
    component.exit_initialization()
    return component


def drive(component: Component, time: float, course: Sequence[tuple[float, float]]) -> float:
    """Steps with these inputs and lengths; the time reached."""
    variable = component.description.variables["u"]
    for u, length in course:
        component.set(variable, np.full(variable.size, u))
        component.step(time, length)
        time += length
    return time


# --- what people see --------------------------------------------------------------------------------------------------
def test_what_the_command_says_and_writes(tmp_path: Path) -> None:
    text = LOOP.format(pd=PD, coupling="method: midpoint, tolerance: 1e-5")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", text=text)
    again = cosim(tmp_path, "run", "out/scenario.yaml", "--out", "again", "--no-report")
    assert digest(done) == digest(again)
    (line,) = (line for line in done.stdout.splitlines() if "steps of agent 1" in line)
    assert "rejected; largest error of a step" in line
    (account,) = json.loads((tmp_path / "out" / "manifest.json").read_text())["step_control"]
    assert account["agent"] == "1"
    assert account["steps"] > 20
    assert 0.0 < account["ratio"] <= 1.0
    assert f"{account['steps']} steps, {account['rejected']} rejected" in (tmp_path / "out/report.html").read_text()


def test_steps_at_the_least_are_an_error_that_helps() -> None:
    text = LOOP.format(pd=PD, coupling="method: midpoint, tolerance: 1e-12, least_step: 1 ms")
    with pytest.raises(
        RunError, match=r"agent 1, component plant, at t = .* the coupling's step is at the least, 1 ms"
    ):
        played(text)


@pytest.mark.parametrize(
    ("coupling", "said"),
    [
        ("method: joint, tolerance: 1e-6", "10:38: error: 'tolerance' is for the couplings of Co-Simulation"),
        ("method: midpoint, least_step: 1 ms", "'least_step' bounds the steps that 'tolerance' chooses"),
        ("method: midpoint, tolerance: 1e-6, least_step: 1 s", "'least_step' is 1 s, longer than the largest step"),
        ("method: midpoint, tolerance: 1e-6, loop: native", "the native loop cannot be had: 'plant' steps as long as"),
        ("method: midpoint, tolerance: 2", "must be less than 1, not 2"),
    ],
)
def test_mistakes(coupling: str, said: str, tmp_path: Path) -> None:
    done = cosim(tmp_path, "check", "net.yaml", text=LOOP.format(pd=PD, coupling=coupling))
    assert done.returncode == 2
    assert said in done.stderr
