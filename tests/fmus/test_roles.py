"""Leaders, followers, agents without in-neighbours, Corollary 1, and the law in closed loop with the arm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fmus.driver import CS, ME, Driver, Floats
from tests.fmus.inputs import START, T, messages, own
from tests.fmus.theory import Law, arm_derivative, runge_kutta
from tests.reference import axes
from tests.reference.arm import Arm, coriolis, gravity, inertia

OpenFmu = Callable[[str, str], Driver]
VERSIONS = pytest.mark.parametrize("version", ["fmi2", "fmi3"])
CONTROLLERS = pytest.mark.parametrize("model", ["ArmSyncController", "AxisSyncController"])
LAWS = {"ArmSyncController": Law(), "AxisSyncController": Law(regressor=axes.regressor)}
LEADER, KNOWN_VELOCITY = 2, 3


@CONTROLLERS
@VERSIONS
@pytest.mark.parametrize("role", [LEADER, KNOWN_VELOCITY])
def test_who_knows_the_velocity_estimates_nothing(open_fmu: OpenFmu, model: str, version: str, role: int) -> None:
    fmu = open_fmu(f"{model}.{version}", CS)
    fmu.initialize(role=role, v_d=[0.2, -0.3], v_bar_from_estimate=0, v_bar_start=[5.0, 5.0], **START)
    for tick in range(10):
        fmu.set(**messages(tick))
        fmu.step_to((tick + 1) * T)
        for name in ("v_hat", "v_bar"):
            np.testing.assert_array_equal(fmu.get(name), [0.2, -0.3])
        np.testing.assert_array_equal(fmu.get("v_bar_dot"), 0.0)


@CONTROLLERS
@VERSIONS
@pytest.mark.parametrize("alone", [{"n_neighbours": 0}, {"n_neighbours": 2, "weight": 0.0}])
def test_without_in_neighbours_eta_is_zero(
    open_fmu: OpenFmu, model: str, version: str, alone: dict[str, float]
) -> None:
    fmu = open_fmu(f"{model}.{version}", CS)
    fmu.initialize(eta_start=[1.0, 1.0], p=[0.5, 0.5], psi_from_position=0, v_hat_start=[0.1, 0.2], **alone)
    for _ in range(5):
        fmu.step(0.07)
        np.testing.assert_array_equal(fmu.get("eta"), 0.0)
        np.testing.assert_array_equal(fmu.get("v_r"), fmu.get("v_bar"))


@CONTROLLERS
@VERSIONS
def test_unheard_neighbour_stands_at_the_own_start(open_fmu: OpenFmu, model: str, version: str) -> None:
    fmu = open_fmu(f"{model}.{version}", ME)
    fmu.initialize(n_neighbours=2, weight=[0.25, 0.75], p=[0.4, -0.3])
    fmu.event(neighbour_stamp=[-1, 0], neighbour_p=[[9, 9], [1, 2]], p=[0.5, 0.5])
    expected = 0.25 * np.array([0.4, -0.3]) + 0.75 * np.array([1, 2]) - fmu.get("psi") + fmu.get("v_bar")
    np.testing.assert_allclose(fmu.get("der(psi)"), expected, atol=1e-15)


@CONTROLLERS
@VERSIONS
def test_weights_need_not_sum_to_one(open_fmu: OpenFmu, model: str, version: str) -> None:
    fmu = open_fmu(f"{model}.{version}", ME).initialize(n_neighbours=2, weight=[2.0, 6.0])
    fmu.event(neighbour_stamp=[0, 0], neighbour_p=[[1, 0], [0, 1]])
    np.testing.assert_allclose(fmu.get("der(psi)"), [0.25, 0.75], atol=1e-15)


@CONTROLLERS
@VERSIONS
def test_start_values(open_fmu: OpenFmu, model: str, version: str) -> None:
    fmu = open_fmu(f"{model}.{version}", ME)
    fmu.initialize(
        p=[0.4, -0.3],
        psi_from_position=0,
        psi_start=[1.0, 2.0],
        eta_start=[0.1, 0.2],
        v_hat_start=[0.5, 0.6],
        theta_hat_start=[1, 2, 3, 4, 5],
    )
    for name, value in {"psi": [1, 2], "eta": [0.1, 0.2], "v_bar": [0.5, 0.6]}.items():
        np.testing.assert_array_equal(fmu.get(name), value)
    np.testing.assert_array_equal(fmu.get("theta_hat").reshape(-1, 5) - [1, 2, 3, 4, 5], 0.0)


def test_outputs_in_initialization_mode_follow_the_inputs(open_fmu: OpenFmu) -> None:
    fmu = open_fmu("ArmSyncController.fmi3", ME)
    fmu.fmu.enterInitializationMode()
    fmu.set(p=[0.4, -0.3], v=[1.0, 2.0])
    np.testing.assert_array_equal(fmu.get("psi"), [0.4, -0.3])
    np.testing.assert_array_equal(fmu.get("u"), [-10.0, -20.0])
    fmu.set(p=[1.0, 1.0])
    np.testing.assert_array_equal(fmu.get("psi"), [1.0, 1.0])


angles = st.floats(-4, 4)
Pair = tuple[float, float]
pairs = st.tuples(angles, angles)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(p=pairs, v=pairs, eta=pairs, psi=pairs, v_bar=pairs)
def test_regressor_is_the_arms(open_fmu: OpenFmu, p: Pair, v: Pair, eta: Pair, psi: Pair, v_bar: Pair) -> None:
    """Property P.3: with the true parameters and k_e = 0, u = M v_r' + C v_r + G."""
    arm = Arm()
    fmu = open_fmu("ArmSyncController.fmi3", ME)
    fmu.initialize(
        p=p,
        v=v,
        eta_start=eta,
        psi_start=psi,
        v_bar_start=v_bar,
        k_e=0.0,
        psi_from_position=0,
        v_bar_from_estimate=0,
        theta_hat_start=arm.theta,
    )
    v_r, v_r_dot = fmu.get("v_r"), fmu.get("der(eta)") + fmu.get("v_bar_dot")
    P, V = np.array(p), np.array(v)
    theta = arm.theta
    expected = inertia(theta, P) @ v_r_dot + coriolis(theta, P, V) @ v_r + gravity(theta, P, arm.g)
    np.testing.assert_allclose(fmu.get("u"), expected, rtol=1e-12, atol=1e-12)


@CONTROLLERS
@VERSIONS
def test_law_is_the_papers(open_fmu: OpenFmu, model: str, version: str) -> None:
    """Every derivative and the torque at scripted inputs, against the law written in NumPy."""
    fmu = open_fmu(f"{model}.{version}", ME).initialize(**START)
    for tick in range(12):
        p, v = own(fmu.time)
        fmu.event(p=p, v=v, **messages(tick))
        fmu.integrate((tick + 0.5) * T, runge_kutta(0.02))
        heard, weights = messages(tick), np.array(START["weight"])
        age = (fmu.time - heard["neighbour_time"])[:, None]
        seen = (heard["neighbour_stamp"] >= 0)[:, None]
        positions = np.where(seen, heard["neighbour_p"] + heard["neighbour_v_hat"] * age, START["p"])
        states = np.concatenate([fmu.get(name) for name in ("v_bar", "v_bar_dot", "eta", "psi", "theta_hat")])
        rates, u = LAWS[model].derivative_and_torque(states, p, v, fmu.get("v_hat"), weights @ positions)
        names = ("der(v_bar)", "der(v_bar_dot)", "der(eta)", "der(psi)", "der(theta_hat)")
        np.testing.assert_allclose(np.concatenate([fmu.get(name) for name in names]), rates, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(fmu.get("u"), u, rtol=1e-12, atol=1e-12)


class Loop:
    """An arm and a controller without in-neighbours, integrated together."""

    def __init__(self, open_fmu: OpenFmu, version: str, **start: float) -> None:
        self.plant = open_fmu(f"TwoLinkArm.{version}", ME).initialize(p=[1.0, -0.5])
        self.law = open_fmu(f"ArmSyncController.{version}", ME)
        self.law.initialize(n_neighbours=0, role=LEADER, p=[1.0, -0.5], **start)

    def derivative(self, t: float, x: Floats) -> Floats:
        self.plant.fmu.setTime(t)
        self.plant.states = x[:4]
        self.law.fmu.setTime(t)
        self.law.states = x[4:]
        self.law.set(p=self.plant.get("p"), v=self.plant.get("v"))
        self.plant.set(u=self.law.get("u"))
        return np.concatenate([self.plant.derivatives(t, x[:4]), self.law.derivatives(t, x[4:])])

    def run(self, end: float) -> Floats:
        x = np.concatenate([self.plant.states, self.law.states])
        return runge_kutta(0.01)(self.derivative, 0.0, end, x)


@VERSIONS
def test_arm_reaches_the_desired_velocity(open_fmu: OpenFmu, version: str) -> None:
    loop = Loop(open_fmu, version)
    result = loop.run(20.0)
    np.testing.assert_allclose(result[2:4], [0.3, 0.6], atol=0.02)

    def independent(_: float, x: Floats) -> Floats:
        v_d, zero = np.array([0.3, 0.6]), np.zeros(2)
        law = np.concatenate([v_d, zero, zero, zero, x[4:]])
        rates, u = Law(leader=True, coupled=False).derivative_and_torque(law, x[:2], x[2:4], v_d, zero)
        return np.concatenate([arm_derivative(Arm(), x[:4], u), rates[8:]])

    expected = runge_kutta(0.01)(independent, 0.0, 20.0, np.concatenate([[1.0, -0.5, 0.0, 0.0], np.zeros(5)]))
    np.testing.assert_allclose(result[:4], expected[:4], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result[12:17], expected[4:], rtol=0, atol=1e-9)


def test_sign_as_printed_does_not(open_fmu: OpenFmu) -> None:
    """Erratum 1: with theta_hat' = +Pi Y' e."""
    result = Loop(open_fmu, "fmi3", adaptation_sign=1.0).run(20.0)
    assert np.abs(result[2:4] - [0.3, 0.6]).max() > 0.5
