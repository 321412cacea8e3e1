"""Networks of agents made of FMUs, as scenarios: some of them fail, some are advanced by the Python loop."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from hypothesis import strategies as st

from cosim.plan import Integrator, Loop, Method, Plan
from tests.distributed.networks import CHANNELS, planned

PERIOD_MS = 100
FAILURES = {
    Method.JOINT: ("derivative_nan", "derivative_jumps", "state_grows", "never_settles", "update_error"),
    Method.MIDPOINT: ("step_error", "step_discards", "output_nan"),
}
"""What the probe can do wrong in a joint agent, and in any other; not before the first step."""


@dataclass(frozen=True)
class Network:
    """Agents of one FMU each, beside a probe where one shall fail."""

    edges: tuple[tuple[int, int], ...]
    channel: str
    method: Method
    integrator: Integrator
    failures: Mapping[int, str]
    loops: tuple[Loop, ...]
    fmi: tuple[int, ...]
    seed: int
    ticks: int
    step: ClassVar = "25 ms"

    @property
    def text(self) -> str:
        """The scenario but for the loops."""
        n = len(self.loops)
        tree: dict[str, Any] = {
            "name": "block",
            "seed": self.seed,
            "period": f"{PERIOD_MS} ms",
            "duration": f"{self.ticks * PERIOD_MS} ms",
            "coupling": {"method": str(self.method), "step": self.step},
            "agents": {f"{i + 1}": self._agent(i) for i in range(n)},
        }
        if self.method is Method.JOINT:
            tree["coupling"]["integrator"] = str(self.integrator)
        if self.edges:
            tree["graph"] = {"channel": "used", "edges": [f"{i + 1} -> {j + 1}" for i, j in self.edges]}
            tree["channels"] = {"used": "@"}
        return json.dumps(tree).replace('"@"', CHANNELS[self.channel])

    def _agent(self, index: int) -> dict[str, Any]:
        raise NotImplementedError

    def plan(self, loops: Sequence[Loop]) -> Plan:
        """The plan, agent by agent with these loops."""
        plan = planned(self.text)
        agents = tuple(
            replace(agent, coupling=replace(agent.coupling, loop=loop))
            for agent, loop in zip(plan.agents, loops, strict=True)
        )
        return replace(plan, agents=agents)


@dataclass(frozen=True)
class Averagers(Network):
    """Agents that tend to the mean of what they hear (benchmarks/averager)."""

    averagers: Mapping[int, Path]
    probes: Mapping[int, Path]

    def _agent(self, index: int) -> dict[str, Any]:
        fmi = self.fmi[index]
        components: dict[str, Any] = {
            "mean": {"fmu": str(self.averagers[fmi]), "start": {"x": {"uniform": [-1, 1]}}},
        }
        record = ["mean.x"]
        if index in self.failures:
            start = {"fails": self.failures[index], "vector_in": [-9.5, 0]}
            components["probe"] = {"fmu": str(self.probes[fmi]), "start": start}
            record.append("probe.x")
        return {
            "components": components,
            "publish": {"x": "mean.x"},
            "receive": {"x": "mean.heard", "count": "mean.n_neighbours"},
            "record": record,
        }


@dataclass(frozen=True)
class Arms(Network):
    """Arms with their controllers."""

    step: ClassVar = "5 ms"

    def _agent(self, index: int) -> dict[str, Any]:
        return {
            "components": {
                "plant": {"fmu": f"TwoLinkArm.fmi{self.fmi[index]}", "start": {"p": {"uniform": [-1, 1]}}},
                "controller": {"fmu": f"ArmSyncController.fmi{self.fmi[index]}"},
            },
            "connections": [
                *(f"plant.{name} -> controller.{name}" for name in ("p", "v")),
                "controller.u -> plant.u",
            ],
            "publish": {"p": "plant.p", "v_hat": "controller.v_hat"},
            "receive": {
                "p": "controller.neighbour_p",
                "v_hat": "controller.neighbour_v_hat",
                **{name: f"controller.neighbour_{name}" for name in ("stamp", "time")},
                "weight": "controller.weight",
                "count": "controller.n_neighbours",
                "period": "controller.T",
            },
            "record": ["plant.p", "plant.v", "controller.u"],
        }


@st.composite
def parts(draw: st.DrawFn, method: Method) -> dict[str, Any]:
    """What all networks have."""
    n = draw(st.integers(1, 5))
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    every = range(n)
    failing = draw(st.lists(st.sampled_from(every), max_size=2, unique=True))
    modes = FAILURES[Method.JOINT if method is Method.JOINT else Method.MIDPOINT]
    return {
        "edges": tuple(draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else ()),
        "channel": draw(st.sampled_from(sorted(CHANNELS))),
        "method": method,
        "integrator": draw(st.sampled_from(list(Integrator))),
        "failures": {i: draw(st.sampled_from(modes)) for i in failing},
        "loops": tuple(draw(st.sampled_from([Loop.NATIVE, Loop.NATIVE, Loop.PYTHON])) for _ in every),
        "fmi": tuple(draw(st.sampled_from([2, 3])) for _ in every),
        "seed": draw(st.integers(0, 2**31)),
        "ticks": draw(st.integers(1, 6)),
    }
