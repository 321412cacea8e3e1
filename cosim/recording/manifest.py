"""`manifest.json`: what a run folder says of itself, enough to draw its report without the scenario or the FMUs."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Any

from cosim.errors import ConfigError, Location, Problem
from cosim.plan import AgentPlan, AnalysisPlan, Plan
from cosim.recording.columns import Columns
from network.units import to_seconds

FORMAT = 1

MANIFEST = "manifest.json"
SCENARIO = "scenario.yaml"
TRAJECTORIES = "trajectories.parquet"
DELIVERIES = "deliveries.parquet"

RESERVE = ".reserve"
SPOOL = ".spool"
GROUPS = ".groups"
HIDDEN = (SPOOL, GROUPS, RESERVE)
"""What lies in a run folder while the run goes on, beside the lock."""

_PACKAGES = ("netcosim", "numpy", "FMPy", "pyarrow", "eclipse-zenoh")


class Status(StrEnum):
    """What `status` in the manifest says; the reason follows `aborted`, as in `aborted: interrupted at t = 3 s`."""

    RUNNING = "running"
    COMPLETE = "complete"
    ABORTED = "aborted"


def begin(plan: Plan, columns: Columns, details: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of a run before its first tick."""
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    empty = dict.fromkeys(("status", "digest", "ticks", "simulated_s", "wall_s", "start_s", "speed"))
    manifest = {
        "name": plan.name,
        "title": plan.title,
        "seed": plan.seed,
        **empty,
        "created": created,
        "command": command_line(),
        **describe(plan, columns),
        **details,
        "ticks": {"planned": plan.ticks},
    }
    return with_outcome(manifest, Status.RUNNING, 0)


def with_outcome(  # noqa: PLR0917
    manifest: Mapping[str, Any],
    status: str,
    n_ticks: int,
    wall: float | None = None,
    start: float | None = None,
    digest: str | None = None,
) -> dict[str, Any]:
    """What became of a run.

    Args:
        manifest: as it was.
        status: see `Status`.
        n_ticks: that are recorded, tick 0 among them.
        wall: seconds that it took, if that is known.
        start: those of them until tick 0 was recorded.
        digest: of what is recorded.
    """
    done = max(0, n_ticks - 1)
    simulated = to_seconds(done * manifest["period_ns"])
    return {
        **manifest,
        "status": status,
        "digest": digest,
        "ticks": {"planned": manifest["ticks"]["planned"], "done": done},
        "simulated_s": simulated,
        "wall_s": None if wall is None else round(wall, 6),
        "start_s": None if start is None else round(start, 6),
        "speed": round(simulated / wall, 3) if wall else None,
    }


def describe(plan: Plan, columns: Columns) -> dict[str, Any]:
    """Everything in the manifest that is known before the first tick."""
    return {
        "format": FORMAT,
        "name": plan.name,
        "title": plan.title,
        "seed": plan.seed,
        "period_s": plan.period,
        "period_ns": plan.period_ns,
        "config_sha256": hashlib.sha256(plan.scenario.encode()).hexdigest(),
        "versions": versions(),
        "platform": platform.platform(),
        "components": _components(plan),
        "agents": [_agent(agent, plan) for agent in plan.agents],
        "record": _record(plan),
        "columns": list(columns.names),
        "message": dict(zip(plan.layout.names, plan.layout.sizes, strict=True)),
        "links": {
            "sender": plan.links.sender.tolist(),
            "receiver": plan.links.receiver.tolist(),
            "slot": plan.links.slot.tolist(),
            "weight": list(plan.weights),
            "channel": list(plan.link_channel),
        },
        "channels": _channels(plan),
        "analysis": _analysis(plan.analysis),
    }


def folder_problem(path: Path, message: str) -> ConfigError:
    """One thing that is wrong with a run folder or a file in it."""
    return ConfigError([Problem(message, Location(str(path)))])


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a run's numbers could depend on."""
    import importlib.metadata

    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # run from a checkout, not installed
            found[package.lower()] = importlib.metadata.version(package)
    return found


def to_json(manifest: Mapping[str, Any]) -> str:
    """Readable JSON: one line per top-level entry and agent."""
    lines = []
    for key, value in manifest.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            text = "[\n    " + ",\n    ".join(_dump(item) for item in value) + "\n  ]"
        else:
            text = _dump(value)
        lines.append(f"  {_dump(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _dump(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def command_line() -> list[str]:
    """How this process was called, without the path of the program; `python -m cosim` is `cosim`."""
    program = Path(sys.argv[0])
    return [program.parent.name if program.name == "__main__.py" else program.name, *sys.argv[1:]]


def _components(plan: Plan) -> list[dict[str, Any]]:
    """Each FMU file or Python class once, with its hash and how many components are made from it."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for agent in plan.agents:
        for component in agent.components:
            source = component.python or str(component.path)
            description = component.description
            entry = found.setdefault(
                (source, description.sha256),
                {
                    "source": source,
                    "model": description.model,
                    "fmi": description.fmi,
                    "sha256": description.sha256,
                    "instances": 0,
                },
            )
            entry["instances"] += 1
    return list(found.values())


def _agent(agent: AgentPlan, plan: Plan) -> dict[str, Any]:
    names = [component.name for component in agent.components]
    return {
        "name": agent.name,
        "components": {component.name: component.description.model for component in agent.components},
        "publish": {
            variable: f"{names[port.component]}.{port.variable.name}"
            for variable, port in zip(plan.layout.names, agent.publish, strict=False)  # empty where nobody hears it
        },
        "method": agent.coupling.method.value,
        "step_ns": agent.coupling.step_ns,
    }


def _record(plan: Plan) -> dict[str, dict[str, Any]]:
    """Unit and largest shape of every recorded variable."""
    record: dict[str, dict[str, Any]] = {}
    for agent in plan.agents:
        for name, port in agent.record:
            entry = record.setdefault(name, {"unit": port.variable.unit, "shape": list(port.variable.shape)})
            if len(entry["shape"]) == len(port.variable.shape):
                entry["shape"] = [max(pair) for pair in zip(entry["shape"], port.variable.shape, strict=True)]
    return record


def _channels(plan: Plan) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "model": model.as_written(),
            "min_delay_ns": model.min_delay_ns(),
            "age_bound_ns": model.age_bound_ns(plan.period_ns),
        }
        for name, model in plan.channels.items()
    }


def _analysis(analysis: AnalysisPlan) -> dict[str, Any]:
    """The roles, under the names that they have in YAML."""
    return {key.removesuffix("_"): value for key, value in asdict(analysis).items()}
