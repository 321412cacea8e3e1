"""Plans without FMUs, and a small network of double integrators under the paper's scheme to record runs of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.components.component import Description, Interface, Variable
from cosim.plan import AgentPlan, AnalysisPlan, ComponentPlan, CouplingPlan, MailboxPlan, Method, Plan, Port
from cosim.recording.recorder import Recorder
from network.channel import ChannelModel
from network.emulator import Emulator
from network.messages import Exchange, Floats, Links, MessageLayout
from network.window import Window

PERIOD_NS = 100_000_000
MICRO_STEPS = 5
V_D = (0.3, 0.6)
VARIABLES = {
    "plant.p": ((2,), "rad"),
    "plant.v": ((2,), "rad/s"),
    "controller.v_hat": ((2,), "rad/s"),
    "controller.theta_hat": ((5,), None),
}
Record = dict[str, tuple[tuple[int, ...], str | None]]


def port(name: str, shape: tuple[int, ...], unit: str | None = None) -> tuple[str, Port]:
    """A recorded variable of a component `plant` (index 0) or `controller` (1)."""
    component, variable = name.split(".", 1)
    return name, Port(
        ("plant", "controller").index(component),
        Variable(variable, "output", "continuous", "Float64", shape, unit=unit),
    )


def component(name: str) -> ComponentPlan:
    description = Description(f"Test{name.title()}", "3.0", (Interface.MODEL_EXCHANGE,), {}, sha256="ab" * 32)
    return ComponentPlan(name, Path(f"/models/{name}.fmu"), None, description, {})


def graph(n: int, rng: np.random.Generator) -> Links:
    """Rooted at agent 4 (index 3), every other agent with one to three in-links."""
    pairs: set[tuple[int, int]] = set()
    root = min(3, n - 1)
    order = [root, *(i for i in range(n) if i != root)]
    for place, agent in enumerate(order[1:], start=1):
        for sender in rng.choice(order[:place], size=min(place, int(rng.integers(1, 3))), replace=False).tolist():
            pairs.add((agent, sender))
    for agent in rng.choice(order[1:], size=n // 4, replace=False).tolist():
        sender = int(rng.choice([i for i in range(n) if i != agent]))
        pairs.add((agent, sender))
    receiver, sender = np.array(sorted(pairs), dtype=np.int64).T
    slot = np.concatenate([np.arange(count) for count in np.bincount(receiver, minlength=n)])
    return Links(tuple(str(i + 1) for i in range(n)), sender, receiver, slot)


def make_plan(
    n: int = 10,
    ticks: int = 600,
    *,
    record: Sequence[Record] | Record = VARIABLES,
    links: Links | None = None,
    channel: ChannelModel | None = None,
    analysis: AnalysisPlan | None = None,
    leaders: Sequence[str] = ("1", "4"),
    published: str = "plant.p",
) -> Plan:
    """A plan of `n` agents; `record` is what all of them, or each of them, records."""
    links = graph(n, np.random.default_rng(1)) if links is None else links
    records = [record] * n if isinstance(record, dict) else list(record)
    degree = np.bincount(links.receiver, minlength=n)
    layout = MessageLayout(("p", "v_hat"), (2, 2))
    agents = tuple(
        AgentPlan(
            index=i,
            name=links.agents[i],
            components=(component("plant"), component("controller")),
            connections=(),
            publish=(port(published, (2,))[1], port("controller.v_hat", (2,))[1]),
            mailbox=MailboxPlan({}, None, None, None),
            neighbours=tuple(links.sender[links.receiver == i].tolist()),
            weights=(1.0 / max(1, degree[i]),) * int(degree[i]),
            coupling=CouplingPlan(Method.JOINT, 5_000_000),
            record=tuple(port(name, shape, unit) for name, (shape, unit) in records[i].items()),
        )
        for i in range(n)
    )
    gains = AnalysisPlan(
        position="plant.p",
        velocity="plant.v",
        estimate="controller.v_hat",
        parameters="controller.theta_hat",
        reference_velocity=V_D if leaders else None,
        leaders=tuple(name for name in leaders if name in links.agents),
        k_eta={agent.name: 2 * math.sqrt(13.0) for agent in agents},
        lambda_={agent.name: 13.0 for agent in agents},
    )
    return Plan(
        name="arms",
        title=f"{n} agents, leaders {' and '.join(leaders) or 'none'}",
        seed=7,
        period_ns=PERIOD_NS,
        ticks=ticks,
        layout=layout,
        links=links,
        weights=tuple((1.0 / degree[links.receiver]).tolist()),
        channels={"paper": channel or Window(depth=10, delay=("150 ms", "250 ms"))},
        link_channel=("paper",) * len(links),
        agents=agents,
        analysis=analysis or gains,
        scenario="name: arms\n",
    )


def restrict(plan: Plan, keep: Sequence[str]) -> Plan:
    """The same plan, recording less."""
    agents = tuple(
        replace(agent, record=tuple(entry for entry in agent.record if entry[0] in keep)) for agent in plan.agents
    )
    return replace(plan, agents=agents)


class Integrators:
    """Double integrators under the paper's scheme (k_p = k_d = 2, λ = 13, k_η = 2√13, e = 0), explicit Euler.

    Arrivals take effect at the next tick: this is a signal to draw, not a reference.
    """

    def __init__(self, plan: Plan) -> None:
        n = len(plan.agents)
        rng = np.random.default_rng(plan.seed)
        self._plan = plan
        self._leads = np.isin([agent.name for agent in plan.agents], plan.analysis.leaders)
        self._hears = np.bincount(plan.links.receiver, minlength=n) > 0
        self._link = {
            (int(r), int(s)): i for i, (r, s) in enumerate(zip(plan.links.receiver, plan.links.slot, strict=True))
        }
        self.p = rng.uniform(-1.5, 1.5, (n, 2))
        self.v_hat = np.where(self._leads[:, None], V_D, 0.0 if self._leads.any() else rng.uniform(0, 0.8, (n, 2)))
        self.theta = np.zeros((n, 5))
        self._goal = rng.normal(1.0, 0.5, (n, 5))
        self._v_bar, self._v_bar_dot = self.v_hat.copy(), np.zeros((n, 2))
        self._psi, self._eta = self.p.copy(), np.zeros((n, 2))
        self._heard_p = self.p[plan.links.receiver].copy()
        self._heard_v = np.zeros_like(self._heard_p)
        self._stamp = np.full(len(plan.links), -1)

    @property
    def v(self) -> Floats:
        return self._eta + self._v_bar

    def message(self) -> Floats:
        return np.hstack([self.p, self.v_hat])

    def row(self) -> Floats:
        values = {"plant.p": self.p, "plant.v": self.v, "controller.v_hat": self.v_hat}
        values["controller.theta_hat"] = self.theta
        recorded = (values[name][agent.index] for agent in self._plan.agents for name, _ in agent.record)
        return np.concatenate([np.empty(0), *recorded])

    def advance(self, exchange: Exchange) -> None:
        h = self._plan.period / MICRO_STEPS
        links, weights = self._plan.links, np.array(self._plan.weights)[:, None]
        fresh = self._receive(exchange)
        for step in range(MICRO_STEPS):
            age = ((exchange.tick - self._stamp) * self._plan.period + step * h)[:, None] * (self._stamp >= 0)[:, None]
            extrapolated = weights * (self._heard_p + age * self._heard_v)
            mean = np.zeros_like(self.p)
            np.add.at(mean, links.receiver, extrapolated)
            eta_dot = -2 * math.sqrt(13) * self._eta - 13 * (self.p - self._psi)
            self.p = self.p + h * self.v
            self._psi = self._psi + h * (-self._psi + self._v_bar + mean)
            self._eta = np.where(self._hears[:, None], self._eta + h * eta_dot, 0.0)
            pull = -2 * self._v_bar_dot - 2 * (self._v_bar - self.v_hat)
            self._v_bar, self._v_bar_dot = self._v_bar + h * self._v_bar_dot, self._v_bar_dot + h * pull
            self.theta = self.theta + h * 0.1 * (self._goal - self.theta) * (1 + np.sin(3 * self.p[:, :1]))
        total, count = self.v_hat.copy(), np.ones((len(self.p), 1))
        np.add.at(total, links.receiver[fresh], self._heard_v[fresh])
        np.add.at(count, links.receiver[fresh], 1)
        self.v_hat = np.where(self._leads[:, None], self.v_hat, total / count)

    def _receive(self, exchange: Exchange) -> np.ndarray:
        fresh = np.zeros(len(self._stamp), bool)
        for receiver, deliveries in enumerate(exchange.mail):
            for slot, stamp, values in zip(
                deliveries.slot.tolist(), deliveries.stamp.tolist(), deliveries.values, strict=True
            ):
                link = self._link[receiver, slot]
                if stamp > self._stamp[link]:
                    self._stamp[link], fresh[link] = stamp, True
                    self._heard_p[link], self._heard_v[link] = values[:2], values[2:]
        return fresh


def record(plan: Plan, folder: Path, *, status: str = "complete", ticks: int | None = None, **options: int) -> str:
    """Run the integrators and record them; the digest."""
    recorder = Recorder(plan, folder, **options)
    recorder.open()
    play(plan, recorder, plan.ticks if ticks is None else ticks)
    return recorder.close(status)


def play(plan: Plan, recorder: Recorder, ticks: int) -> None:
    """Ticks 0 to `ticks` into an open recorder."""
    agents = Integrators(plan)
    emulator = Emulator(plan.links, plan.channels, plan.link_channel, plan.layout, plan.seed, plan.period_ns)
    for tick in range(ticks):
        recorder.tick(tick, agents.row())
        exchange = emulator.emulate(tick, agents.message())
        recorder.fates(exchange.fates)
        agents.advance(exchange)
    recorder.tick(ticks, agents.row())
    recorder.fates(emulator.finish())
