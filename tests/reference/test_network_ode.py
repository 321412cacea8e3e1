"""The reference solution itself: is it the paper's system, and how exact is it?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

from tests.reference.arm import acceleration, coriolis, gravity, inertia, regressor
from tests.reference.integrators import dop853, implicit, rk4
from tests.reference.network_ode import (
    UNHEARD,
    Agent,
    Drive,
    Extrapolation,
    Floats,
    Law,
    Log,
    Role,
    Solution,
    right_hand_side,
    solve,
)
from tests.reference.scenarios import PERIOD_NS, random_agents, window_log

T = PERIOD_NS / 1e9


def log_of(rows: list[tuple[int, int, int, float]]) -> Log:
    """A log from (sender, receiver, stamp, arrival in s)."""
    table = np.array([(*row[:3], round(row[3] * 1e9)) for row in rows], dtype=np.int64).reshape(-1, 4)
    return Log(table[:, 0], table[:, 1], table[:, 2], table[:, 3])


def test_right_hand_side_is_the_papers_matrix_form() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        k_p, k_d, k_e, lambda_, k_eta = rng.uniform(0.5, 3.0, 5).tolist()
        law = Law(k_p, k_d, k_e, lambda_, k_eta, Pi=tuple(rng.uniform(0.1, 1.0, 5).tolist()))
        agent = Agent(neighbours=(0,), weights=(1.0,), law=law)
        y, v_hat, constant, slope = rng.normal(size=19), rng.normal(size=2), rng.normal(size=2), rng.normal(size=2)
        s, follow = rng.uniform(0, 0.1), rng.uniform()
        p, v, v_bar, v_bar_dot, eta, psi, theta_hat, integral = np.split(y, [2, 4, 6, 8, 10, 12, 17])
        drive = constant + slope * s + follow * integral
        eta_dot = -law.k_eta * eta - law.lambda_ * (p - psi)
        v_bar_ddot = -law.k_d * v_bar_dot - law.k_p * (v_bar - v_hat)
        e = v - eta - v_bar
        Y = regressor(p, v, eta + v_bar, eta_dot + v_bar_dot, law.g)
        expected = np.concatenate(
            [
                v,
                acceleration(agent.arm, p, v, Y @ theta_hat - law.k_e * e),
                v_bar_dot,
                v_bar_ddot,
                eta_dot,
                -psi + v_bar + drive,
                -np.diag(law.Pi) @ Y.T @ e,
                v_bar,
            ]
        )
        rhs = right_hand_side(agent)(Drive(tuple(constant), tuple(slope), follow), tuple(v_hat))
        np.testing.assert_allclose(rhs(s, y), expected, rtol=1e-12, atol=1e-12)


def test_arm_without_control_keeps_its_energy() -> None:
    arm = Agent().arm
    theta = arm.theta

    def energy(y: Floats) -> float:
        p, v = y[:2], y[2:]
        height = theta[4] * np.sin(p[0]) + theta[3] * np.sin(p[0] + p[1])
        return float(v @ inertia(theta, p) @ v / 2 + arm.g * height)

    start = np.array([0.4, -0.7, 0.1, 0.2])
    end = dop853()(lambda _, y: [*y[2:], *acceleration(arm, y[:2], y[2:], np.zeros(2))], start, 3.0)
    assert abs(energy(end) - energy(start)) < 1e-10
    assert np.abs(end - start).max() > 1.0


@pytest.fixture(scope="module")
def twenty_seconds() -> tuple[list[Agent], Log, Solution]:
    agents = random_agents(seed=5)
    log = window_log(5, agents, 200)
    return agents, log, solve(agents, PERIOD_NS, 200, log)


def test_halved_tolerances_change_nothing(twenty_seconds: tuple[list[Agent], Log, Solution]) -> None:
    agents, log, exact = twenty_seconds
    halved = solve(agents, PERIOD_NS, 200, log, dop853(rtol=5e-13, atol=5e-14, max_step=5e-3))
    assert np.nanmax(np.abs(halved.states - exact.states)) < 1e-11
    assert np.abs(halved.u - exact.u).max() < 1e-10


@pytest.mark.parametrize("method", ["Radau", "LSODA"])
def test_implicit_methods_agree(method: str, twenty_seconds: tuple[list[Agent], Log, Solution]) -> None:
    agents, log, exact = twenty_seconds
    other = solve(agents, PERIOD_NS, 10, log, implicit(method, rtol=1e-9, atol=1e-11))
    assert np.abs(other.p - exact.p[:11]).max() < 1e-8
    assert np.abs(other.v - exact.v[:11]).max() < 1e-7


def test_rk4_converges_to_it_with_order_four(twenty_seconds: tuple[list[Agent], Log, Solution]) -> None:
    agents, log, exact = twenty_seconds
    # 2.5 and 1.25 ms: at 5 ms the stiffest mode is not yet in the asymptotic range
    errors = [np.abs(solve(agents, PERIOD_NS, 30, log, rk4(h)).p - exact.p[:31]).max() for h in (2.5e-3, 1.25e-3)]
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.7


def test_rk4_at_5_ms_is_within_1e_6_rad(twenty_seconds: tuple[list[Agent], Log, Solution]) -> None:
    agents, log, exact = twenty_seconds
    error = np.abs(solve(agents, PERIOD_NS, 200, log, rk4(5e-3)).p - exact.p).max()
    assert 1e-9 < error < 1e-6


def test_torque_and_reference_are_functions_of_the_state(twenty_seconds: tuple[list[Agent], Log, Solution]) -> None:
    """Newton's law at ticks: M v' + C v + G = u, with v' from the right-hand side."""
    agents, _, exact = twenty_seconds
    for k in (1, 50, 200):
        for i, agent in enumerate(agents):
            y, theta = exact.states[k, i].copy(), agent.arm.theta
            y[10:12] = np.nan_to_num(y[10:12])
            zero = (0.0, 0.0)
            v_dot = np.array(right_hand_side(agent)(Drive(zero, zero, 0.0), zero)(0.0, y)[2:4])
            p, v = y[:2], y[2:4]
            torque = inertia(theta, p) @ v_dot + coriolis(theta, p, v) @ v + gravity(theta, p, agent.arm.g)
            np.testing.assert_allclose(torque, exact.u[k, i], rtol=1e-11, atol=1e-11)
            np.testing.assert_allclose(exact.e[k, i], v - exact.eta[k, i] - exact.v_bar[k, i], atol=1e-14)


# --- the hybrid part, against the definitions taken literally --------------------------------------------------------


def literal_freshest(log: Log, sender: int, receiver: int, now_ns: int) -> int:
    """`k_t`, as it stands."""
    of_edge = (log.sender == sender) & (log.receiver == receiver) & (log.arrival_ns <= now_ns)
    return int(log.stamp[of_edge].max(initial=UNHEARD))


def literal_estimates(agents: list[Agent], log: Log, ticks: int) -> Floats:
    """`updatevk_leader` to `updatevk_f2`, as they stand."""
    v_hat = np.zeros((ticks + 1, len(agents), 2))
    v_hat[0] = [agent.v_hat if agent.role is Role.FOLLOWER else agent.v_d for agent in agents]
    for k in range(ticks):
        now, before = k * PERIOD_NS, (k - 1) * PERIOD_NS
        for i, agent in enumerate(agents):
            heard = agent.neighbours if agent.role is Role.FOLLOWER else ()
            news = [j for j in heard if literal_freshest(log, j, i, now) > literal_freshest(log, j, i, before)]
            terms = [v_hat[k, i], *(v_hat[literal_freshest(log, j, i, now), j] for j in news)]
            v_hat[k + 1, i] = np.mean(terms, axis=0)
    return v_hat


class Literal:
    """Drive and psi of one agent by quadrature of the definitions, with v_bar by the matrix exponential."""

    def __init__(self, agents: list[Agent], log: Log, solution: Solution, me: int) -> None:
        self.agents, self.log, self.solution, self.me = agents, log, solution, me
        law = agents[me].law
        self.A = np.array([[0.0, 1.0], [-law.k_p, -law.k_d]])
        self.nodes, self.weights = np.polynomial.legendre.leggauss(10)

    def v_bar(self, t: float) -> Floats:
        """`hat_v_filter` from the tick before: the input is constant over a period."""
        tick = min(int(t / T + 1e-9), len(self.solution.time) - 1)
        target = np.stack([self.solution.v_hat[tick, self.me], np.zeros(2)])
        start = np.stack([self.solution.v_bar[tick, self.me], self.solution.v_bar_dot[tick, self.me]])
        value: Floats = (target + expm(self.A * (t - tick * T)) @ (start - target))[0]
        return value

    def integral(self, start: float, end: float, breaks: list[float], f: Callable[[float], Floats]) -> Floats:
        """Gauss-Legendre between the break points."""
        edges = [start, *sorted(b for b in breaks if start < b < end), end]
        total = np.zeros(2)
        for a, b in pairwise(edges):
            mid, half = (a + b) / 2, (b - a) / 2
            total += half * sum(w * f(mid + half * x) for x, w in zip(self.nodes, self.weights, strict=True))
        return total

    def epsilon(self, j: int, k: int, t: float) -> Floats:
        me, s = self.agents[self.me], self.solution
        ticks = [n * T for n in range(len(s.time))]
        if me.role is Role.KNOWN_VELOCITY:
            return (t - k * T) * np.array(me.v_d)
        if me.extrapolation is Extrapolation.RECEIVED_ESTIMATE:
            return np.asarray(s.v_hat[k, j] * (t - k * T))
        if me.extrapolation is Extrapolation.OWN_ESTIMATE:
            return self.integral(k * T, t, ticks, lambda x: s.v_hat[int(x / T + 1e-9), self.me])
        if me.extrapolation is Extrapolation.OWN_FILTERED:
            return self.integral(k * T, t, ticks, self.v_bar)
        return self.v_bar(k * T) * (t - k * T)

    def drive(self, t: float) -> Floats:
        me, total = self.agents[self.me], np.zeros(2)
        for j, a_ij in zip(me.neighbours, me.weights, strict=True):
            k = literal_freshest(self.log, j, self.me, round(t * 1e9))
            seen = np.array(me.p) if k == UNHEARD else self.solution.p[k, j] + self.epsilon(j, k, t)
            total += a_ij * seen
        return total / sum(me.weights)

    def psi(self, tick: int) -> Floats:
        """`filter` by variation of constants over the whole past."""
        start = np.array(self.agents[self.me].p)
        arrivals = self.log.arrival_ns[self.log.receiver == self.me] / 1e9
        breaks = [*arrivals, *(n * T for n in range(tick))]
        end = tick * T
        forced = self.integral(0.0, end, breaks, lambda t: np.exp(t - end) * (self.v_bar(t) + self.drive(t)))
        return np.asarray(start * np.exp(-end) + forced)


ROLES = [
    *((Role.FOLLOWER, extrapolation) for extrapolation in Extrapolation),
    (Role.LEADER, Extrapolation.OWN_FILTERED),
    (Role.KNOWN_VELOCITY, Extrapolation.OWN_FILTERED),
]


@pytest.mark.parametrize(("role", "extrapolation"), ROLES)
def test_hybrid_part_is_the_definitions_taken_literally(role: Role, extrapolation: Extrapolation) -> None:
    drawn = random_agents(seed=2, leaders=())
    weights = np.random.default_rng(2).uniform(0.2, 2.0, (10, 10))  # kappa is not 1
    agents = [
        replace(agent, role=role, extrapolation=extrapolation, weights=tuple(weights[i, j] for j in agent.neighbours))
        for i, agent in enumerate(drawn)
    ]
    log = window_log(2, agents, 12)
    solution = solve(agents, PERIOD_NS, 12, log)
    np.testing.assert_allclose(solution.v_hat, literal_estimates(agents, log, 12), rtol=0, atol=1e-15)
    busiest = max(range(10), key=lambda i: len(agents[i].neighbours))
    literal = Literal(agents, log, solution, busiest)
    np.testing.assert_allclose(solution.psi[12, busiest], literal.psi(12), rtol=0, atol=1e-11)
    np.testing.assert_allclose(solution.v_bar[12, busiest], literal.v_bar(1.2 - 1e-12), rtol=0, atol=1e-11)


PAIR = [Agent(v_hat=(1.0, -1.0), p=(0.5, 0.2)), Agent(neighbours=(0,), weights=(1.0,), v_hat=(0.0, 0.5))]


def test_message_without_delay_is_used_at_its_own_tick() -> None:
    solution = solve(PAIR, PERIOD_NS, 2, log_of([(0, 1, 0, 0.0)]))
    np.testing.assert_array_equal(solution.v_hat[:, 1], [[0.0, 0.5], [0.5, -0.25], [0.5, -0.25]])


def test_arrival_at_a_tick_belongs_to_it_and_one_nanosecond_later_to_the_next() -> None:
    at_tick = solve(PAIR, PERIOD_NS, 3, log_of([(0, 1, 0, 0.1)]))
    later = solve(PAIR, PERIOD_NS, 3, log_of([(0, 1, 0, 0.100000001)]))
    np.testing.assert_array_equal(at_tick.v_hat[:, 1, 0], [0.0, 0.0, 0.5, 0.5])
    np.testing.assert_array_equal(later.v_hat[:, 1, 0], [0.0, 0.0, 0.0, 0.5])


def test_older_stamp_that_arrives_later_changes_nothing() -> None:
    fresh = [(0, 1, 1, 0.15)]
    alone, with_old = (solve(PAIR, PERIOD_NS, 5, log_of(rows)) for rows in (fresh, [*fresh, (0, 1, 0, 0.27)]))
    np.testing.assert_array_equal(alone.v_hat, with_old.v_hat)
    # the break point at 0.27 s moves the solver's steps, nothing else
    np.testing.assert_allclose(alone.p, with_old.p, rtol=0, atol=1e-12)


def test_arrival_takes_effect_at_its_own_time() -> None:
    early, late = (solve(PAIR, PERIOD_NS, 1, log_of([(0, 1, 0, t)])).psi[1, 1, 0] for t in (0.02, 0.06))
    # psi' = -psi + p_0 + t until the end of the period, or -psi + 0 before the arrival
    for psi, arrival in ((early, 0.02), (late, 0.06)):
        s = 0.1
        expected = 0.5 * (1 - np.exp(-(s - arrival))) + (s - 1) - (arrival - 1) * np.exp(-(s - arrival))
        assert psi == pytest.approx(expected, abs=1e-13)


def test_agent_that_hears_nobody_has_no_synchronization_term() -> None:
    solution = solve(PAIR, PERIOD_NS, 5, log_of([]))
    assert not solution.eta[:, 0].any()
    assert np.isnan(solution.psi[:, 0]).all()


def test_sample_from_the_future_is_refused() -> None:
    with pytest.raises(ValueError, match="before it is taken"):
        solve(PAIR, PERIOD_NS, 5, log_of([(0, 1, 3, 0.2)]))


# Ten nodes in three cycles, rooted at nodes 0 to 6, so at node 3, the paper's agent 4.
CYCLES = ((2, 3), (0,), (1, 4), (6,), (3,), (2, 4), (5,), (6, 9), (5, 7), (1, 8))


@pytest.mark.parametrize("leaders", [(0, 3), ()])
def test_corrected_scheme_settles(leaders: tuple[int, ...]) -> None:
    agents = [
        replace(agent, neighbours=heard, weights=(1.0 / len(heard),) * len(heard))
        for agent, heard in zip(random_agents(seed=5, leaders=leaders), CYCLES, strict=True)
    ]
    solution = solve(agents, PERIOD_NS, 600, window_log(5, agents, 600), dop853(rtol=1e-9, atol=1e-10))
    final = np.array([0.3, 0.6]) if leaders else solution.v_hat[-1].mean(axis=0)
    late = slice(400, None)
    assert np.abs(solution.v_hat[late] - final).max() < 1e-6
    assert np.abs(solution.v[late] - final).max() < 1e-2
    assert np.abs(solution.p[late] - solution.p[late, :1]).max() < 1e-2
