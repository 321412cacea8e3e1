"""Random ten-arm networks and logs of the paper's intermittent channel, for the reference's own tests.

Graph, initial conditions and channel are drawn from NumPy's generator: no run of the product enters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.reference.network_ode import Agent, Extrapolation, Law, Log, Role

PERIOD_NS = 100_000_000


def random_graph(rng: np.random.Generator, n: int, root: int) -> list[tuple[int, ...]]:
    """In-neighbours of each of n nodes: a random tree from `root`, and one more in-link for about half the nodes."""
    heard: list[set[int]] = [set() for _ in range(n)]
    order = [root, *(int(i) for i in rng.permutation([i for i in range(n) if i != root]))]
    for place, node in enumerate(order[1:], start=1):
        heard[node].add(order[int(rng.integers(place))])
    for node in range(n):
        other = int(rng.integers(n))
        if node != root and other != node and rng.random() < 0.5:
            heard[node].add(other)
    return [tuple(sorted(nodes)) for nodes in heard]


def random_agents(
    seed: int,
    leaders: tuple[int, ...] = (0, 3),
    n: int = 10,
    root: int = 3,
    law: Law | None = None,
    extrapolation: Extrapolation = Extrapolation.RECEIVED_ESTIMATE,
) -> list[Agent]:
    """Agents with equal weights 1/|N_i| and random initial angles; without leaders, with random initial estimates."""
    rng = np.random.default_rng(seed)
    agents = []
    for i, neighbours in enumerate(random_graph(rng, n, root)):
        p, v_hat = rng.uniform(-1.5, 1.5, 2), rng.uniform(0.0, 0.8, 2)
        agent = Agent(
            neighbours=neighbours,
            weights=tuple(1.0 / len(neighbours) for _ in neighbours),
            role=Role.LEADER if i in leaders else Role.FOLLOWER,
            extrapolation=extrapolation,
            law=law or Law(),
            p=(float(p[0]), float(p[1])),
        )
        agents.append(agent if leaders else replace(agent, v_hat=(float(v_hat[0]), float(v_hat[1]))))
    return agents


def window_log(
    seed: int, agents: list[Agent], ticks: int, depth: int = 10, delay_ns: tuple[int, int] = (150_000_000, 250_000_000)
) -> Log:
    """Section 5's channel: at tick k send a random one of the last `depth + 1` samples, unless it was sent before."""
    rng = np.random.default_rng((seed, 1))
    rows: list[tuple[int, int, int, int]] = []
    for receiver, agent in enumerate(agents):
        for sender in agent.neighbours:
            sent: set[int] = set()
            for k in range(ticks + 1):
                stamp = int(rng.integers(k - depth, k + 1))
                delay = int(rng.integers(delay_ns[0], delay_ns[1] + 1))
                if stamp >= 0 and stamp not in sent:
                    sent.add(stamp)
                    rows.append((sender, receiver, stamp, k * PERIOD_NS + delay))
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return Log(table[:, 0], table[:, 1], table[:, 2], table[:, 3])
