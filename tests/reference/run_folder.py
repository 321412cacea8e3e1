"""From a run folder of `cosim run` to the reference's terms: its agents, its delivery log, its recorded trajectories.

Reads the files by their documented contract (`scenario.yaml`, `deliveries.parquet`, `trajectories.parquet`), with no
code of the product.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import yaml

from tests.reference.arm import Arm, Floats
from tests.reference.axes import Axes
from tests.reference.integrators import Integrator
from tests.reference.network_ode import Agent, Extrapolation, Ints, Law, Log, Role, Solution, solve

EXTRAPOLATIONS = dict(
    zip(("received_estimate", "own_estimate", "own_filtered", "own_filtered_at_stamp"), Extrapolation, strict=True)
)
GAINS = {"k_p": "k_p", "k_d": "k_d", "k_e": "k_e", "lambda": "lambda_", "k_eta": "k_eta", "g": "g"}
INITIAL = {"v_d": "v_d", "v_hat_start": "v_hat", "eta_start": "eta", "theta_hat_start": "theta_hat"}
NO_EQUATION = {"solver_step", "T", "n_axes"}
"""Start values that no equation of the exact solution has: a step size, the period, known from the scenario, and 2."""


@dataclass(frozen=True)
class RunFolder:
    """A finished run of the shipped plants with the shipped controllers, components named `plant` and `controller`."""

    folder: Path

    @cached_property
    def scenario(self) -> dict[str, Any]:
        tree: dict[str, Any] = yaml.safe_load((self.folder / "scenario.yaml").read_text(encoding="utf-8"))
        return tree

    @cached_property
    def names(self) -> list[str]:
        """Agents in the order of the file; their places are the reference's indices."""
        return [str(name) for name in self.scenario["agents"]]

    @cached_property
    def period_ns(self) -> int:
        number, unit = str(self.scenario["period"]).split()
        return round(float(number) * {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}[unit])

    @cached_property
    def agents(self) -> list[Agent]:
        """The agents as the scenario describes them."""
        heard = self._in_links()
        return [self._agent(name, *heard[name]) for name in self.names]

    @cached_property
    def log(self) -> Log:
        """Every message that arrived, whatever the run made of it: freshness is the reference's own business."""
        table = pq.read_table(self.folder / "deliveries.parquet").to_pydict()
        arrived = [i for i, fate in enumerate(table["fate"]) if fate != "lost"]
        place = {name: i for i, name in enumerate(self.names)}

        def column(name: str, convert: Mapping[str, int] | None = None) -> Ints:
            values = [table[name][i] for i in arrived]
            return np.array([convert[value] for value in values] if convert else values, dtype=np.int64)

        return Log(column("sender", place), column("receiver", place), column("stamp"), column("arrival_ns"))

    @cached_property
    def ticks(self) -> int:
        """The last recorded tick."""
        return int(pq.read_metadata(self.folder / "trajectories.parquet").num_rows) // len(self.names) - 1

    def recorded(self, variable: str, *shape: int) -> Floats:
        """A recorded variable such as `plant.p`, (ticks + 1, n, size): flattened; of two numbers by default."""
        indices = list(np.ndindex(*(shape or (2,))))
        columns = [f"{variable}[{','.join(str(i + 1) for i in index)}]" for index in indices]
        table = pq.read_table(self.folder / "trajectories.parquet", columns=["tick", "agent", *columns])
        ticks, agents = table["tick"].to_pylist(), table["agent"].to_pylist()
        if agents != self.names * (self.ticks + 1) or ticks != sorted(ticks):
            raise ValueError(f"{self.folder}: rows are not one per tick and agent in the order of the file")
        values = np.stack([table[column].to_numpy() for column in columns], axis=1)
        return values.reshape(self.ticks + 1, len(self.names), len(columns))

    def solve(self, ticks: int | None = None, integrate: Integrator | None = None) -> Solution:
        """The exact solution of this run, driven by its own deliveries.

        Raises:
            DivergedError: it escapes to infinity.
        """
        return solve(self.agents, self.period_ns, self.ticks if ticks is None else ticks, self.log, integrate)

    def _in_links(self) -> dict[str, tuple[tuple[int, ...], tuple[float, ...]]]:
        """In-neighbours and weights by name."""
        links: dict[str, list[tuple[int, float | None]]] = {name: [] for name in self.names}
        for edge in self.scenario["graph"]["edges"]:
            if isinstance(edge, str):
                sender, receiver = (part.strip() for part in edge.split("->"))
                weight = None
            else:
                sender, receiver, weight = str(edge["from"]), str(edge["to"]), edge.get("weight")
            links[receiver].append((self.names.index(sender), weight))
        return {
            name: (
                tuple(sender for sender, _ in incoming),
                tuple(1.0 / len(incoming) if weight is None else float(weight) for _, weight in incoming),
            )
            for name, incoming in links.items()
        }

    def _agent(self, name: str, neighbours: tuple[int, ...], weights: tuple[float, ...]) -> Agent:
        own = self.scenario["agents"][name]
        tree = _merged(self.scenario["templates"][own["template"]], own) if "template" in own else own
        plant = dict(tree["components"]["plant"].get("start", {}))
        start = dict(tree["components"]["controller"].get("start", {}))
        p, v = _pair(plant.pop("p", 0.0)), _pair(plant.pop("v", 0.0))
        plant = {key: value for key, value in plant.items() if key not in NO_EQUATION}
        model = tree["components"]["plant"]["fmu"].partition(".")[0]
        arm, axes = Arm(), None
        if model == "TwoLinkArm":
            arm = Arm(**{key: float(value) for key, value in plant.items()})
        else:
            axes = _axes(model, plant, _gains(tree["components"]["plant"]))

        gains: dict[str, Any] = {field: float(start.pop(key)) for key, field in GAINS.items() if key in start}
        if "Pi" in start:
            gains["Pi"] = _vector(start.pop("Pi"), 5)
        law = Law(**gains, sign=float(start.pop("adaptation_sign", -1.0)))

        initial: dict[str, Any] = {
            field: _vector(start.pop(key), (5 if axes is None else 10) if field == "theta_hat" else 2)
            for key, field in INITIAL.items()
            if key in start
        }
        psi, v_bar = start.pop("psi_start", 0.0), start.pop("v_bar_start", 0.0)
        if not start.pop("psi_from_position", True):
            initial["psi"] = _pair(psi)
        if not start.pop("v_bar_from_estimate", True):
            initial["v_bar"] = _pair(v_bar)
        role = Role(start.pop("role", "follower"))
        extrapolation = EXTRAPOLATIONS[start.pop("extrapolation", "received_estimate")]
        if unknown := set(start) - NO_EQUATION:
            raise ValueError(f"agent {name}: the reference has no equation for {', '.join(sorted(unknown))}")
        return Agent(neighbours, weights, role, extrapolation, arm, axes, law, p=p, v=v, **initial)


def _axes(model: str, start: Mapping[str, Any], gains: tuple[float, float]) -> Axes:
    """A plant of decoupled axes as the rest of its agent sees it.

    Args:
        model: `MassSpringDamper`, `Pendulum` or `DoubleIntegrator`.
        start: its parameters.
        gains: of its positions, and of its drive, where the scenario maps them.
    """
    g = float(start.get("g", 9.81))
    given = {name: np.array(_pair(value)) for name, value in start.items() if name not in ("n_axes", "g")}
    zero, one = np.zeros(2), np.ones(2)
    if model == "MassSpringDamper":
        m, d, k, b = (given.get(name, start * one) for name, start in (("m", 1.0), ("d", 0.5), ("k", 1.0), ("b", 0.0)))
        gravity = zero
    elif model == "Pendulum":
        mass, length, d = (given.get(name, start * one) for name, start in (("m", 1.0), ("l", 0.5), ("d", 0.1)))
        m, k, b, gravity = mass * length**2, zero, zero, mass * g * length
    elif model == "DoubleIntegrator":
        m, d, k, b, gravity = one, zero, zero, zero, zero
    else:
        raise ValueError(f"the reference has no equation for {model}")
    seen, driven = gains
    scale = seen * driven
    return Axes(*(tuple(map(float, x)) for x in (m / scale, d / scale, k / scale, b / driven, gravity / scale)))


def _gains(component: Mapping[str, Any]) -> tuple[float, float]:
    """What a component's positions, and what its inputs, are multiplied by on their way."""
    position, drive = component.get("outputs", {}).get("p", {}), component.get("inputs", {}).get("u", {})
    return tuple(float(one.get("gain", 1.0)) if isinstance(one, Mapping) else 1.0 for one in (position, drive))  # type: ignore[return-value]


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` laid over `under`, mappings merged."""
    result = copy.deepcopy(dict(under))
    for key, value in over.items():
        both = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = _merged(result[key], value) if both else value
    return result


def _vector(value: Any, size: int) -> tuple[float, ...]:
    return tuple(float(x) for x in value) if isinstance(value, list) else (float(value),) * size


def _pair(value: Any) -> tuple[float, float]:
    first, second = _vector(value, 2)
    return first, second
