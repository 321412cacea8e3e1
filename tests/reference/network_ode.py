"""The exact solution of a network under the paper's scheme, independent of the product: one equation per agent.

Given the agents, the graph and a log of what the network delivered and when, `solve` computes every agent's state at
every tick. Agents influence each other only through samples taken at ticks, so the network is solved tick by tick, each
agent alone over [kT, (k+1)T], broken exactly at its arrivals, between which its right-hand side is smooth. The
equations are those of the paper with the errata of `docs/errata.md`; equation labels below are those of its TeX source.
Agents are arms, as in the paper, or decoupled axes (`tests.reference.axes`) with the regressor of those; all have two
coordinates. Nothing here is shared with `cosim`, `network` or `fmus`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from tests.reference import axes
from tests.reference.arm import Arm, regressor
from tests.reference.axes import Axes
from tests.reference.integrators import Integrator, SolverError, dop853

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Pair = tuple[float, float]

UNHEARD = -1
"""Stamp of a neighbour before its first message."""


class Role(Enum):
    FOLLOWER = "follower"
    LEADER = "leader"
    KNOWN_VELOCITY = "known_velocity"  # Corollary 1: no observer, extrapolation with v_d


class Extrapolation(Enum):
    """How a neighbour's position is carried on from its last sample."""

    RECEIVED_ESTIMATE = "epsilon"
    OWN_ESTIMATE = "epsilonA"
    OWN_FILTERED = "epsilonB"
    OWN_FILTERED_AT_STAMP = "epsilonC"


@dataclass(frozen=True)
class Law:
    """Gains of the controller; `sign` is that of the adaptation law, -1 corrected, +1 as printed in `adapt_EL`."""

    k_p: float = 2.0
    k_d: float = 2.0
    k_e: float = 10.0
    lambda_: float = 13.0
    k_eta: float = 2.0 * math.sqrt(13.0)
    Pi: tuple[float, ...] = (0.3,) * 5
    g: float = 9.81
    sign: float = -1.0


@dataclass(frozen=True)
class Agent:
    """One arm, its controller, whom it hears, and where it starts.

    Attributes:
        axes: two decoupled axes in the place of the arm; of `law`, `Pi` then holds for each axis, and `g` for none.
        neighbours: indices of the agents that it hears.
        weights: a_ij of each of them.
        v_d: desired velocity rad/s, used by leaders and where the velocity is known.
        p, v: initial angles rad and velocities rad/s.
        v_hat: initial estimate of a follower.
        psi, v_bar: None for the notes' choice, psi(0) = p(0) and v_bar(0) = v_hat(0).
    """

    neighbours: tuple[int, ...] = ()
    weights: tuple[float, ...] = ()
    role: Role = Role.FOLLOWER
    extrapolation: Extrapolation = Extrapolation.RECEIVED_ESTIMATE
    arm: Arm = field(default_factory=Arm)
    axes: Axes | None = None
    law: Law = field(default_factory=Law)
    v_d: Pair = (0.3, 0.6)
    p: Pair = (0.0, 0.0)
    v: Pair = (0.0, 0.0)
    v_hat: Pair = (0.0, 0.0)
    v_bar: Pair | None = None
    v_bar_dot: Pair = (0.0, 0.0)
    eta: Pair = (0.0, 0.0)
    psi: Pair | None = None
    theta_hat: tuple[float, ...] = ()  # zeros, if empty

    @property
    def n_parameters(self) -> int:
        return 5 if self.axes is None else 10


@dataclass(frozen=True)
class Log:
    """Every message that arrived, in any order: arrays of shape (n,), agents by index, `arrival_ns` exact."""

    sender: Ints
    receiver: Ints
    stamp: Ints
    arrival_ns: Ints


@dataclass(frozen=True)
class Solution:
    """States at ticks 0..K of n agents: `time` s has shape (K+1,), the rest (K+1, n, 2) or, `theta_hat`, (K+1, n, 5).

    `psi` is NaN for an agent that hears nobody: the paper defines none for it. `states` holds the raw state vectors,
    with NaN behind the shorter ones. `theta_hat` is that of arms; `axes_theta_hat`, (K+1, n, 10), that of the others.
    """

    time: Floats
    states: Floats
    v_hat: Floats
    u: Floats
    e: Floats
    v_r: Floats

    @property
    def p(self) -> Floats:
        return self.states[:, :, 0:2]

    @property
    def v(self) -> Floats:
        return self.states[:, :, 2:4]

    @property
    def v_bar(self) -> Floats:
        return self.states[:, :, 4:6]

    @property
    def v_bar_dot(self) -> Floats:
        return self.states[:, :, 6:8]

    @property
    def eta(self) -> Floats:
        return self.states[:, :, 8:10]

    @property
    def psi(self) -> Floats:
        return self.states[:, :, 10:12]

    @property
    def theta_hat(self) -> Floats:
        return self.states[:, :, 12:17]

    @property
    def axes_theta_hat(self) -> Floats:
        return self.states[:, :, 12:22]


class DivergedError(ArithmeticError):
    """The solution escaped: when, s, which agent, and the largest magnitude of a component of its state there."""

    def __init__(self, time: float, agent: int, size: float) -> None:
        self.time = time
        self.agent = agent
        self.size = size
        super().__init__(f"agent {agent} diverged at t = {time:.6f} s: its state reached {size:.3g}")


@dataclass
class Drive:
    """The term `sum_j a_ij p_j^(i)(t) / kappa_i` of `filter` on one segment, s seconds after its start.

    It is `constant + slope * s + follow * J(t)`, with `J` the integral of v_bar from 0, one of the agent's states.
    """

    constant: Pair
    slope: Pair
    follow: float


Right = Callable[[float, Floats], Sequence[float]]


def right_hand_side(agent: Agent) -> Callable[[Drive, Pair], Right]:
    """A factory of right-hand sides of one agent, given the drive and the estimate v_hat in force on a segment.

    State, 19 or 24 numbers: p(2), v(2), v_bar(2), v_bar'(2), eta(2), psi(2), theta_hat(5 or 10), J(2). Scalar floats
    throughout: this is called millions of times.
    """
    law = agent.law
    k_p, k_d = law.k_p, law.k_d
    move_and_adapt = _arm(agent) if agent.axes is None else _decoupled(agent.axes, law)
    linked = bool(agent.neighbours)  # `eta_zeros`: without in-neighbours eta stays 0
    lam, k_eta, track = (law.lambda_, law.k_eta, 1.0) if linked else (0.0, 0.0, 0.0)

    def on_segment(drive: Drive, v_hat: Pair) -> Right:
        (a1, a2), (b1, b2), w = drive.constant, drive.slope, drive.follow
        h1, h2 = v_hat

        def rhs(s: float, y: Floats) -> Sequence[float]:
            p1, p2, v1, v2, f1, f2, fd1, fd2, n1, n2, q1, q2, *theta_hat, j1, j2 = y.tolist()
            # synchronization term, `filter`
            nd1 = -k_eta * n1 - lam * (p1 - q1)
            nd2 = -k_eta * n2 - lam * (p2 - q2)
            qd1 = track * (-q1 + f1 + a1 + b1 * s + w * j1)
            qd2 = track * (-q2 + f2 + a2 + b2 * s + w * j2)
            # filtered estimate, `hat_v_filter`
            fdd1 = -k_d * fd1 - k_p * (f1 - h1)
            fdd2 = -k_d * fd2 - k_p * (f2 - h2)
            # reference velocity and error, `v_reference`
            r1, r2, rd1, rd2 = n1 + f1, n2 + f2, nd1 + fd1, nd2 + fd2
            acceleration1, acceleration2, *rates = move_and_adapt(p1, p2, v1, v2, r1, r2, rd1, rd2, theta_hat)
            return (v1, v2, acceleration1, acceleration2, fd1, fd2, fdd1, fdd2, nd1, nd2, qd1, qd2, *rates, f1, f2)

        return rhs

    return on_segment


MoveAndAdapt = Callable[[float, float, float, float, float, float, float, float, Sequence[float]], Sequence[float]]
"""Plant and control law: from p, v, v_r, v_r' (two each) and the estimates to v' (two) and the estimates' rates."""


def _arm(agent: Agent) -> MoveAndAdapt:
    t1, t2, t3, t4, t5 = agent.arm.theta.tolist()
    plant_g, law = agent.arm.g, agent.law
    k_e, sign, g = law.k_e, law.sign, law.g
    pi1, pi2, pi3, pi4, pi5 = law.Pi
    cos, sin = math.cos, math.sin

    def move_and_adapt(
        p1: float,
        p2: float,
        v1: float,
        v2: float,
        r1: float,
        r2: float,
        rd1: float,
        rd2: float,
        theta_hat: Sequence[float],
    ) -> Sequence[float]:
        o1, o2, o3, o4, o5 = theta_hat
        e1, e2 = v1 - r1, v2 - r2
        # control, `control_EL`, and adaptation, `adapt_EL`
        c, si = cos(p2), sin(p2)
        cos_p1, cos_p12 = cos(p1), cos(p1 + p2)
        y12 = c * (2.0 * rd1 + rd2) - si * (r1 * v2 + r2 * (v1 + v2))
        y22 = rd1 * c + r1 * v1 * si
        y23 = rd1 + rd2
        y14, y15 = g * cos_p12, g * cos_p1
        u1 = rd1 * o1 + y12 * o2 + rd2 * o3 + y14 * o4 + y15 * o5 - k_e * e1
        u2 = y22 * o2 + y23 * o3 + y14 * o4 - k_e * e2
        # arm, `model_case1`
        m11, m12 = t1 + 2.0 * t2 * c, t3 + t2 * c
        g2 = plant_g * t4 * cos_p12
        b_1 = u1 + t2 * si * v2 * v1 + t2 * si * (v1 + v2) * v2 - plant_g * t5 * cos_p1 - g2
        b_2 = u2 - t2 * si * v1 * v1 - g2
        det = m11 * t3 - m12 * m12
        return (
            (t3 * b_1 - m12 * b_2) / det,
            (m11 * b_2 - m12 * b_1) / det,
            sign * pi1 * (rd1 * e1),
            sign * pi2 * (y12 * e1 + y22 * e2),
            sign * pi3 * (rd2 * e1 + y23 * e2),
            sign * pi4 * (y14 * (e1 + e2)),
            sign * pi5 * (y15 * e1),
        )

    return move_and_adapt


def _decoupled(plant: Axes, law: Law) -> MoveAndAdapt:
    parameters = plant.theta.reshape(2, axes.PARAMETERS).tolist()

    def of_one_axis(
        axis: int, p: float, v: float, r: float, rd: float, theta_hat: Sequence[float]
    ) -> tuple[float, list[float]]:
        m, d, k, b, gravity = parameters[axis]
        e, s = v - r, math.sin(p)
        row = (rd, r, p, 1.0, s)
        u = sum(y * o for y, o in zip(row, theta_hat, strict=True)) - law.k_e * e
        rates = [law.sign * pi * y * e for pi, y in zip(law.Pi, row, strict=True)]
        return (u - d * v - k * p - b - gravity * s) / m, rates

    def move_and_adapt(
        p1: float,
        p2: float,
        v1: float,
        v2: float,
        r1: float,
        r2: float,
        rd1: float,
        rd2: float,
        theta_hat: Sequence[float],
    ) -> Sequence[float]:
        a1, first = of_one_axis(0, p1, v1, r1, rd1, theta_hat[: axes.PARAMETERS])
        a2, second = of_one_axis(1, p2, v2, r2, rd2, theta_hat[axes.PARAMETERS :])
        return (a1, a2, *first, *second)

    return move_and_adapt


class _Node:
    """One agent on its way through the ticks: state, estimates, and the freshest stamp of each neighbour."""

    def __init__(self, agent: Agent, period_ns: int, ticks: int) -> None:
        self.agent = agent
        self.period_ns = period_ns
        self.state = initial_state(agent)
        self.right_hand_side = right_hand_side(agent)
        self.v_hat = np.empty((ticks + 1, 2))
        self.v_hat[0] = agent.v_d if agent.role is not Role.FOLLOWER else agent.v_hat
        self.integral = np.zeros((ticks + 1, 2))  # of v_hat from 0, at ticks
        self.freshest = dict.fromkeys(agent.neighbours, UNHEARD)
        self.freshest_a_tick_ago = dict(self.freshest)

    def hear(self, sender: int, stamp: int) -> None:
        """`k_t`: an older stamp that arrives later changes nothing."""
        self.freshest[sender] = max(self.freshest[sender], stamp)

    def observe(self, tick: int, nodes: Sequence[_Node]) -> None:
        """`updatevk_follower`: the estimate of tick + 1 from what was heard in ((tick - 1)T, tick T]."""
        own = self.v_hat[tick]
        if self.agent.role is Role.FOLLOWER:
            news = [j for j in self.agent.neighbours if self.freshest[j] > self.freshest_a_tick_ago[j]]
            own = (own + sum(nodes[j].v_hat[self.freshest[j]] for j in news)) / (1 + len(news))
        if tick + 1 < len(self.v_hat):
            self.v_hat[tick + 1] = own
            self.integral[tick + 1] = self.integral[tick] + self.v_hat[tick] * (self.period_ns / 1e9)
        self.freshest_a_tick_ago = dict(self.freshest)

    def drive(self, tick: int, now_ns: int, nodes: Sequence[_Node], states: Floats, me: int) -> Drive:
        """The drive on a segment that starts at `now_ns` during `tick`; `states` are those at ticks so far."""
        agent, role = self.agent, self.agent.role
        kappa = sum(agent.weights)
        constant, slope, follow = np.zeros(2), np.zeros(2), 0.0
        for j, a_ij in zip(agent.neighbours, agent.weights, strict=True):
            weight, k = a_ij / kappa, self.freshest[j]
            if k == UNHEARD:  # own initial position, zero velocity
                constant += weight * np.array(agent.p)
                continue
            constant += weight * states[k, j, 0:2]
            age = (now_ns - k * self.period_ns) / 1e9
            if role is Role.KNOWN_VELOCITY:
                velocity = np.array(agent.v_d)
            elif agent.extrapolation is Extrapolation.RECEIVED_ESTIMATE:
                velocity = nodes[j].v_hat[k]
            elif agent.extrapolation is Extrapolation.OWN_FILTERED_AT_STAMP:
                velocity = states[k, me, 4:6]
            elif agent.extrapolation is Extrapolation.OWN_ESTIMATE:
                since_tick = (now_ns - tick * self.period_ns) / 1e9
                covered = self.integral[tick] + self.v_hat[tick] * since_tick - self.integral[k]
                constant += weight * covered
                slope += weight * self.v_hat[tick]
                continue
            else:
                behind = 12 + agent.n_parameters
                constant -= weight * states[k, me, behind : behind + 2]
                follow += weight
                continue
            constant += weight * velocity * age
            slope += weight * velocity
        return Drive((constant[0], constant[1]), (slope[0], slope[1]), follow)


def initial_state(agent: Agent) -> Floats:
    """The state at t = 0, shape (19,) or (24,)."""
    follower = agent.role is Role.FOLLOWER
    v_hat = agent.v_hat if follower else agent.v_d
    v_bar = agent.v_bar if follower and agent.v_bar is not None else v_hat
    v_bar_dot = agent.v_bar_dot if follower else (0.0, 0.0)
    eta = agent.eta if agent.neighbours else (0.0, 0.0)
    psi = agent.p if agent.psi is None else agent.psi
    theta_hat = agent.theta_hat or (0.0,) * agent.n_parameters
    return np.array([*agent.p, *agent.v, *v_bar, *v_bar_dot, *eta, *psi, *theta_hat, 0.0, 0.0], dtype=float)


def solve(
    agents: Sequence[Agent],
    period_ns: int,
    ticks: int,
    log: Log,
    integrate: Integrator | None = None,
    bound: float = 1e6,
) -> Solution:
    """States of all agents at ticks 0..ticks.

    Args:
        agents: in the order of the indices of `log`.
        period_ns: T.
        ticks: how many periods to solve.
        log: deliveries; those after the end are ignored. A message that arrives exactly at a tick is known there.
        integrate: the solver of a segment; DOP853 at tight tolerances by default.
        bound: largest magnitude of a state that still counts as a solution.

    Raises:
        DivergedError: a state exceeded `bound`, or the solver could not follow it.
    """
    integrate = integrate or dop853()
    nodes = [_Node(agent, period_ns, ticks) for agent in agents]
    states = np.full((ticks + 1, len(agents), max(len(node.state) for node in nodes)), np.nan)
    _put(states[0], nodes)
    arrivals = _by_receiver_and_tick(log, len(agents), period_ns, ticks)
    for tick in range(ticks + 1):
        start_ns = tick * period_ns
        for me, node in enumerate(nodes):
            pending = arrivals[me].get(tick, [])
            while pending and pending[0][0] == start_ns:
                node.hear(*pending.pop(0)[1:])
            node.observe(tick, nodes)
        if tick == ticks:
            break
        for me, node in enumerate(nodes):
            _advance(node, me, tick, arrivals[me].get(tick, []), nodes, states, integrate)
            size = float(np.abs(node.state).max())
            if size > bound:
                raise DivergedError((tick + 1) * period_ns / 1e9, me, size)
        _put(states[tick + 1], nodes)
    return _solution(agents, period_ns, states, np.stack([node.v_hat for node in nodes], axis=1))


def _put(row: Floats, nodes: Sequence[_Node]) -> None:
    for i, node in enumerate(nodes):
        row[i, : len(node.state)] = node.state


def _advance(
    node: _Node,
    me: int,
    tick: int,
    pending: Sequence[tuple[int, int, int]],
    nodes: Sequence[_Node],
    states: Floats,
    integrate: Integrator,
) -> None:
    """Take one agent from kT to (k+1)T, breaking at each arrival.

    Raises:
        DivergedError: the solver could not follow the solution.
    """
    now_ns = tick * node.period_ns
    v_hat = (float(node.v_hat[tick, 0]), float(node.v_hat[tick, 1]))
    for arrival_ns, sender, stamp in (*pending, ((tick + 1) * node.period_ns, None, None)):
        if arrival_ns > now_ns:
            rhs = node.right_hand_side(node.drive(tick, now_ns, nodes, states, me), v_hat)
            try:
                node.state = integrate(rhs, node.state, (arrival_ns - now_ns) / 1e9)
            except SolverError as error:
                raise DivergedError(now_ns / 1e9 + error.after, me, error.size) from error
            now_ns = arrival_ns
        if sender is not None and stamp is not None:
            node.hear(sender, stamp)


def _by_receiver_and_tick(log: Log, n: int, period_ns: int, ticks: int) -> list[dict[int, list[tuple[int, int, int]]]]:
    """Per receiver, per tick k: (arrival_ns, sender, stamp) of arrivals in [kT, (k+1)T), sorted."""
    result: list[dict[int, list[tuple[int, int, int]]]] = [{} for _ in range(n)]
    rows = zip(log.arrival_ns.tolist(), log.sender.tolist(), log.stamp.tolist(), log.receiver.tolist(), strict=True)
    for arrival_ns, sender, stamp, receiver in sorted(rows):
        if arrival_ns < stamp * period_ns:
            raise ValueError(f"sample {stamp} of agent {sender} arrives before it is taken")
        if arrival_ns <= ticks * period_ns:
            result[receiver].setdefault(arrival_ns // period_ns, []).append((arrival_ns, sender, stamp))
    return result


def _solution(agents: Sequence[Agent], period_ns: int, states: Floats, v_hat: Floats) -> Solution:
    """Add the outputs that are functions of the state."""
    eta, v_bar, v_bar_dot = states[:, :, 8:10], states[:, :, 4:6], states[:, :, 6:8]
    v_r = eta + v_bar
    e = states[:, :, 2:4] - v_r
    u = np.empty_like(e)
    for i, agent in enumerate(agents):
        law = agent.law
        for k, state in enumerate(states[:, i]):
            eta_dot = -law.k_eta * eta[k, i] - law.lambda_ * (state[0:2] - state[10:12]) if agent.neighbours else 0.0
            motion = state[0:2], state[2:4], v_r[k, i], eta_dot + v_bar_dot[k, i]
            Y = regressor(*motion, law.g) if agent.axes is None else axes.regressor(*motion)
            u[k, i] = Y @ state[12 : 12 + agent.n_parameters] - law.k_e * e[k, i]
        if not agent.neighbours:
            states[:, i, 10:12] = np.nan
    return Solution(np.arange(len(states)) * period_ns / 1e9, states, v_hat, u, e, v_r)
