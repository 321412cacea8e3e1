"""The evidence for `docs/errata.md`: one section per erratum, numbered as there; no code of the product."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

from tests.reference.arm import Arm, Floats, acceleration, coriolis, gravity, inertia, inertia_rate, regressor
from tests.reference.network_ode import Agent, DivergedError, Drive, Law, Log, right_hand_side, solve
from tests.reference.scenarios import PERIOD_NS, random_agents, window_log

T = PERIOD_NS / 1e9
THETA = Arm().theta
G = Arm().g


def random_configuration(rng: np.random.Generator) -> tuple[Floats, Floats, Floats, Floats]:
    """p, v, x, x', each of shape (2,)."""
    p, v, x, x_dot = rng.uniform(-3, 3, (4, 2))
    return p, v, x, x_dot


# --- 1. sign of the adaptation law -----------------------------------------------------------------------------------


def lyapunov(agent: Agent, y: Floats) -> float:
    """`V = (e' M e + theta~' Pi^-1 theta~) / 2` after `observer_ELsystems`."""
    e, error = y[2:4] - y[8:10] - y[4:6], y[12:17] - agent.arm.theta
    return float(e @ inertia(agent.arm.theta, y[0:2]) @ e + error @ (error / np.array(agent.law.Pi))) / 2


def lyapunov_rate(agent: Agent, y: Floats, v_hat: tuple[float, float]) -> float:
    """dV/dt along the flow, by central differences of V."""
    drive = Drive((0.3, -0.2), (0.1, 0.4), 0.0)
    flow = np.array(right_hand_side(agent)(drive, v_hat)(0.0, y))
    h = 1e-5
    return (lyapunov(agent, y + h * flow) - lyapunov(agent, y - h * flow)) / (2 * h)


def test_lyapunov_function_decreases_with_the_corrected_sign_only() -> None:
    rng = np.random.default_rng(1)
    grows = 0
    for _ in range(200):
        y = rng.normal(size=19)
        e = y[2:4] - y[8:10] - y[4:6]
        rates = {}
        for sign in (-1.0, 1.0):
            agent = Agent(neighbours=(0,), weights=(1.0,), law=Law(sign=sign))
            rates[sign] = lyapunov_rate(agent, y, (0.3, 0.6))
        # with the corrected sign the terms in theta~ cancel, and by P.1 those in M' and C
        assert rates[-1.0] == pytest.approx(-10.0 * float(e @ e), rel=1e-4, abs=1e-4)
        grows += rates[1.0] > 0
    assert grows > 50


@pytest.mark.parametrize("leaders", [(0, 3), ()])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_printed_sign_escapes_to_infinity_before_15_s(seed: int, leaders: tuple[int, ...]) -> None:
    agents = random_agents(seed, leaders, law=Law(sign=1.0))
    with pytest.raises(DivergedError) as caught:
        solve(agents, PERIOD_NS, 150, window_log(seed, agents, 150))
    assert caught.value.time < 15.0
    assert caught.value.size > 1e4


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_corrected_sign_stays_bounded(seed: int) -> None:
    agents = random_agents(seed)
    solution = solve(agents, PERIOD_NS, 150, window_log(seed, agents, 150), bound=100.0)
    assert np.abs(solution.v).max() < 5.0


# --- 2. regressor ----------------------------------------------------------------------------------------------------


def test_regressor_identity_with_the_angle_of_the_first_joint() -> None:
    rng = np.random.default_rng(2)
    right, wrong = [], []
    for _ in range(1000):
        p, v, x, x_dot = random_configuration(rng)
        force = inertia(THETA, p) @ x_dot + coriolis(THETA, p, v) @ x + gravity(THETA, p, G)
        right.append(np.abs(regressor(p, v, x, x_dot, G) @ THETA - force).max())
        wrong.append(np.abs(regressor(p, v, x, x_dot, G, shoulder=1) @ THETA - force).max())
    assert max(right) < 1e-13
    assert max(wrong) > 15.0
    assert np.median(wrong) > 3.0


def test_parameters_are_in_the_printed_order() -> None:
    """Swapping theta_4 and theta_5 in G breaks the potential energy of the two links."""

    def potential(p: Floats) -> float:
        arm = Arm()
        first = arm.m1 * arm.g * arm.lc1 * math.sin(p[0])
        return first + arm.m2 * arm.g * (arm.l1 * math.sin(p[0]) + arm.lc2 * math.sin(p[0] + p[1]))

    p, h = np.array([0.4, 0.9]), 1e-6
    gradient = [(potential(p + h * axis) - potential(p - h * axis)) / (2 * h) for axis in np.eye(2)]
    np.testing.assert_allclose(gravity(THETA, p, G), gradient, rtol=1e-8)
    assert np.abs(gravity(THETA[[0, 1, 2, 4, 3]], p, G) - gradient).max() > 1.0


def test_inertia_is_the_kinetic_energy_of_the_two_links() -> None:
    arm, rng = Arm(), np.random.default_rng(3)
    for _ in range(20):
        p, v, *_ = random_configuration(rng)
        elbow = arm.l1 * v[0] * np.array([-math.sin(p[0]), math.cos(p[0])])
        forearm = arm.lc2 * (v[0] + v[1]) * np.array([-math.sin(p[0] + p[1]), math.cos(p[0] + p[1])])
        kinetic = (
            arm.m1 * (arm.lc1 * v[0]) ** 2
            + arm.I1 * v[0] ** 2
            + arm.m2 * float((elbow + forearm) @ (elbow + forearm))
            + arm.I2 * (v[0] + v[1]) ** 2
        ) / 2
        assert v @ inertia(THETA, p) @ v / 2 == pytest.approx(kinetic, rel=1e-12)


def test_inertia_rate_minus_twice_coriolis_is_skew_symmetric() -> None:
    rng = np.random.default_rng(4)
    for _ in range(100):
        p, v, *_ = random_configuration(rng)
        h = 1e-6
        rate = (inertia(THETA, p + h * v) - inertia(THETA, p - h * v)) / (2 * h)
        np.testing.assert_allclose(inertia_rate(THETA, p, v), rate, atol=1e-8)
        skew = inertia_rate(THETA, p, v) - 2 * coriolis(THETA, p, v)
        np.testing.assert_allclose(skew, -skew.T, atol=1e-14)


# --- 3. units --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("exponent", "holds"), [(2, True), (-2, False)])
def test_inertia_scales_as_mass_times_length_squared(exponent: int, holds: bool) -> None:
    """In millimetres instead of metres the arm moves as before only if I scales with length squared."""
    mm, rng = 1000.0, np.random.default_rng(5)
    metres = Arm()
    scaled = replace(
        metres,
        **{name: getattr(metres, name) * mm for name in ("l1", "l2", "lc1", "lc2", "g")},
        I1=metres.I1 * mm**exponent,
        I2=metres.I2 * mm**exponent,
    )
    p, v, u, _ = random_configuration(rng)
    same = np.allclose(acceleration(scaled, p, v, u * mm**2), acceleration(metres, p, v, u), rtol=1e-10)
    assert same is holds


# --- 4. the gain condition -------------------------------------------------------------------------------------------

LAMBDAS = [1.0, 4.0, 13.0, 100.0, 400.0]


def loop(lam: float) -> tuple[Floats, Floats]:
    """A, B of `dot_eta`, `dot_tilde_p`: state (eta, p~), input psi~ + epsilon; critically damped as in Section 5."""
    return np.array([[-2 * math.sqrt(lam), -lam], [1.0, 0.0]]), np.array([0.0, 1.0])


def peak_gain(A: Floats, B: Floats) -> float:
    """The gain from the sup norm of the input to that of the first state: integral of |impulse response|."""
    rate = -np.linalg.eigvals(A).real.max()
    pieces = pairwise(np.linspace(0.0, 60.0 / rate, 121))

    def response(t: float) -> float:
        return float(abs((expm(A * t) @ B)[0]))

    return float(sum(quad(response, a, b, limit=200)[0] for a, b in pieces))


@pytest.mark.parametrize("lam", LAMBDAS)
def test_gain_to_eta_is_one_for_every_lambda(lam: float) -> None:
    A, B = loop(lam)
    assert np.linalg.solve(-A, B)[0] == pytest.approx(-1.0, rel=1e-12)  # a constant input d gives eta = -d
    assert peak_gain(A, B) == pytest.approx(1.0, rel=1e-6)


def test_gain_is_not_one_over_mu() -> None:
    """The bound of `estimate_eta` fails already for the gains of Section 5: 1 > 1/mu = 0.277."""
    A, B = loop(13.0)
    mu = -np.linalg.eigvals(A).real.max()
    assert 1 / mu == pytest.approx(0.27735, abs=1e-5)
    settled = np.linalg.solve(-A, B)
    assert np.linalg.norm(settled) > 1.0 > 1 / mu
    # and |exp(A t)| <= exp(-mu t) fails as well: the state first grows
    assert max(np.linalg.norm(expm(A * t), 2) for t in np.linspace(0, 1, 101)) == pytest.approx(1.530, abs=1e-3)


@pytest.mark.parametrize(("lam", "gain"), [(1.0, 0.541), (4.0, 0.815), (13.0, 1.063), (100.0, 1.447), (400.0, 1.642)])
def test_small_gain_argument_closes_for_no_lambda(lam: float, gain: float) -> None:
    """The gain from phi to eta is 1, so every row of Gamma sums to at least 1 + h* times the gain from epsilon."""
    A, _ = loop(lam)
    cascade = np.zeros((3, 3))
    cascade[:2, :2], cascade[1, 2], cascade[2, 2] = A, 1.0, -1.0
    from_phi, from_epsilon = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, -1.0])
    assert peak_gain(cascade, from_phi) == pytest.approx(1.0, rel=1e-6)
    assert peak_gain(cascade, from_epsilon) == pytest.approx(gain, abs=1e-3)


def test_margin_of_the_published_condition() -> None:
    mu = -np.roots([1.0, 2 * math.sqrt(13.0), 13.0]).real.max()
    assert mu == pytest.approx(3.606, abs=1e-3)
    assert mu > 1 + 2 * 1.3
    assert (mu - 1) / 2 - 1.3 == pytest.approx(0.0028, abs=5e-5)


# --- 5. h* -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def edges() -> list[tuple[Floats, Floats]]:
    """Stamps and arrivals (s) on 300 edges over 60 s, in order of arrival."""
    agents = [Agent(), *(Agent(neighbours=(0,), weights=(1.0,)) for _ in range(300))]
    log = window_log(7, agents, 600)
    return [by_arrival(log, receiver) for receiver in range(1, 301)]


def by_arrival(log: Log, receiver: int) -> tuple[Floats, Floats]:
    """Stamps and arrivals, those after 60 s left out."""
    mine = (log.receiver == receiver) & (log.arrival_ns <= 60_000_000_000)
    order = np.argsort(log.arrival_ns[mine])
    return log.stamp[mine][order].astype(float), log.arrival_ns[mine][order] / 1e9


def ages(stamps: Floats, arrivals: Floats, times: Floats) -> Floats:
    """Age of information in s at `times`, an arrival at exactly such a time included."""
    freshest = np.maximum.accumulate(stamps)
    return times - freshest[np.searchsorted(arrivals, times + 1e-10, side="right") - 1] * T


def least_h_star(stamps: Floats, arrivals: Floats) -> float:
    """The minimum of k* T + h in `AssumptionDelay01` over all subsequences of delivered samples, s."""
    delay, best = arrivals - stamps * T, math.inf
    for h in np.unique(delay):
        kept = np.sort(stamps[delay <= h])
        k_star = max(kept[0], np.diff(kept).max(initial=0), stamps.max() - kept[-1])
        best = min(best, k_star * T + h)
    return best


def test_age_read_at_ticks_is_bounded_by_1_3_s_and_in_continuous_time_by_1_35_s(
    edges: list[tuple[Floats, Floats]],
) -> None:
    ticks = np.arange(20, 601, dtype=np.float64) * T  # from 2 s on, when every edge has been heard
    at_ticks = [ages(stamps, arrivals, ticks).max() for stamps, arrivals in edges]
    assert max(at_ticks) == pytest.approx(1.3, abs=1e-9)
    before_arrivals = [ages(s, a, a[a > 2.0] - 1e-6).max() for s, a in edges]
    assert 1.34 < max(before_arrivals) < 1.35


def test_literal_minimum_of_assumption_1_is_larger(edges: list[tuple[Floats, Floats]]) -> None:
    least = [least_h_star(stamps, arrivals) for stamps, arrivals in edges]
    assert np.median(least) == pytest.approx(1.52, abs=0.015)
    assert np.mean(np.array(least) > 1.3) > 0.95


def test_long_run_facts_of_the_channel(edges: list[tuple[Floats, Floats]]) -> None:
    never = np.mean([1 - np.sum(stamps < 580) / 580 for stamps, _ in edges])
    assert never == pytest.approx((10 / 11) ** 11, abs=0.005)
    times = np.arange(2.0, 60.0, 1e-3)
    assert np.mean([ages(s, a, times).mean() for s, a in edges]) == pytest.approx(0.535, abs=0.003)
