"""What a report says in numbers: how it went, whether the agents agree, the paper's condition."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.agents.step_control import StepAccount
from cosim.reporting.words import NOTHING, Rows, number
from cosim.results import Results
from cosim.scenario.names import in_short
from cosim.theory import mu, published_bound
from cosim.topology import kappa, reached_by, roots
from network.units import to_seconds

_MOST_AGENTS = 5
"""So many are told of with their steps."""


def outcome(results: Results) -> Rows:
    """Status, seed, times and sizes."""
    manifest = results.manifest
    ticks = manifest["ticks"]
    whole = ticks["done"] == ticks["planned"]
    speed = manifest["speed"]
    return [
        ("Status", manifest["status"]),
        ("Seed", str(manifest["seed"])),
        *_coupling_error(manifest),
        *_steps(manifest),
        ("Simulated", f"{manifest['simulated_s']:g} s" + ("" if whole else f" of {_planned(results):g} s")),
        *_ended(manifest),
        (
            "Ticks",
            f"{ticks['done']}" + ("" if whole else f" of {ticks['planned']}") + f", T = {results.period_ns / 1e9:g} s",
        ),
        ("Wall time", number(manifest["wall_s"], "s", 3)),
        ("Speed", NOTHING if not speed else f"{speed:.3g} × real time"),
        ("Agents and edges", f"{len(results.agents)} and {len(results.links)}"),
        ("Started", manifest["created"].replace("T", " ").replace("Z", " UTC")),
    ]


def _ended(manifest: Mapping[str, Any]) -> Rows:
    """Who asked for the end, if somebody did."""
    ended = manifest.get("ended")
    if ended is None:
        return []
    who = f"component {ended['component']} of agent {ended['agent']}"
    return [("Ended", f"at t = {ended['time_s']:.9g} s by {who}, which asked for it")]


def _planned(results: Results) -> float:
    return to_seconds(int(results.manifest["ticks"]["planned"]) * results.period_ns)


# --- agreement --------------------------------------------------------------------------------------------------------
def agreement(results: Results) -> Rows:
    """Largest deviations at the end of the run; empty where the roles are not given."""
    rows: Rows = []
    reference = results.analysis["reference_velocity"]
    if results.n_ticks == 0:
        return rows
    last = results.n_ticks - 1
    for role, label in (("position", "|p₁ − pᵢ|"), ("velocity", "|vᵢ − {}|"), ("estimate", "|v̂ᵢ − {}|")):
        variable = results.analysis[role]
        if variable is None or variable not in results.variables:
            continue
        values = results.array(variable, every=max(1, last))[-1].reshape(len(results.agents), -1)
        values = values[~np.isnan(values).all(axis=1)]
        if len(values) < 2:
            continue
        centre = values[:1]
        if role != "position":
            centre = values.mean(axis=0) if reference is None else np.array(reference)
        text = label.format("mean" if reference is None else "v_d")
        unit = results.unit(variable)
        rows.append((f"Largest {text} at the end", number(float(np.abs(values - centre).max()), unit or "", 3)))
    return rows


# --- the wall clock ---------------------------------------------------------------------------------------------------
def _coupling_error(manifest: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The largest estimated error of an agent, if the run estimated it."""
    errors = manifest.get("coupling_error")
    if not errors:
        return []
    worst = max(errors, key=lambda error: error["relative"])
    said = f"about {worst['error']:.2g} in {worst['variable']} of agent {worst['agent']}"
    return [("Coupling error", f"{said}, {100 * worst['relative']:.2g} % of its range")]


def _steps(manifest: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What became of the steps of each agent whose steps are controlled; of many, those with the largest errors."""
    accounts = sorted(manifest.get("step_control", ()), key=lambda account: -account["ratio"])
    return [(f"Steps of agent {account['agent']}", str(StepAccount(**account))) for account in accounts[:_MOST_AGENTS]]


def realtime(results: Results) -> Rows:
    """How the schedule of a paced run was kept; empty for others."""
    account = results.realtime
    if account is None:
        return []
    policy = {"warn": "warn and catch up", "abort": "abort", "stretch": "stretch the schedule"}[account["overrun"]]
    rows = [
        ("Real-time factor", f"{number(account['reached'], digits=6)} reached, {account['factor']:g} wanted"),
        ("Wall time from release to deadline", _milliseconds(account["period_s"])),
        ("Lateness of ticks", _percentiles(account["lateness_s"])),
        ("Jitter of releases", _percentiles(account["jitter_s"])),
        ("Missed ticks", f"{account['missed']} of {account['ticks']}"),
        ("On an overrun", policy),
    ]
    if account["stretched_s"]:
        rows.append(("Schedule stretched by", _milliseconds(account["stretched_s"])))
    return rows


def _percentiles(durations: Mapping[str, float | None]) -> str:
    if durations["max"] is None:
        return NOTHING
    return ", ".join(f"{name} {_milliseconds(value)}" for name, value in durations.items())


def _milliseconds(seconds: float | None) -> str:
    return number(None if seconds is None else 1e3 * seconds, "ms", 3)


# --- the paper's condition --------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Condition:
    """One line of the table of conditions: agents that are alike. Numbers as text."""

    agents: str
    in_neighbours: str
    kappa: str
    mu: str
    h_star: str
    bound: str
    margin: str
    verdict: str


def conditions(results: Results) -> list[Condition]:
    """κ_i, μ_i and the published condition μ_i > 1 + 2h*, alike agents in one line."""
    links, analysis = results.links, results.analysis
    sums = kappa(links, results.weights.tolist())
    degree = np.bincount(links.receiver, minlength=len(links.agents))
    ages = _largest_ages(results)
    groups: dict[tuple[str, ...], list[str]] = {}
    for i, name in enumerate(links.agents):
        line = (str(degree[i]), number(float(sums[i]), digits=6), *_published(name, int(degree[i]), ages[i], analysis))
        groups.setdefault(line, []).append(name)
    return [Condition(in_short(names), *line) for line, names in groups.items()]


def _published(name: str, degree: int, age: float, analysis: Mapping[str, Any]) -> tuple[str, ...]:
    """μ_i, h*, (μ_i - 1)/2, margin and verdict."""
    h_star = NOTHING if not degree else number(age, "s") if math.isfinite(age) else "no bound"
    k_eta, lambda_ = ((analysis[key] or {}).get(name) for key in ("k_eta", "lambda"))
    if k_eta is None or lambda_ is None:
        return NOTHING, h_star, NOTHING, NOTHING, NOTHING
    mu_i = mu(k_eta, lambda_)
    bound = published_bound(mu_i)
    if not degree:
        return number(mu_i, "1/s"), h_star, number(bound, "s"), NOTHING, "hears nobody"
    if not math.isfinite(age):
        return number(mu_i, "1/s"), h_star, number(bound, "s"), NOTHING, "cannot be evaluated"
    verdict = "holds" if age < bound else "does not hold"
    return number(mu_i, "1/s"), h_star, number(bound, "s"), number(bound - age, "s", 2), verdict


def _largest_ages(results: Results) -> list[float]:
    """Per agent, the largest age at ticks that its incoming channels allow, in seconds; infinite without a bound."""
    ages = [0.0] * len(results.agents)
    for link, receiver in enumerate(results.links.receiver.tolist()):
        bound = results.age_bound(link)
        ages[receiver] = max(ages[receiver], math.inf if bound is None else bound)
    return ages


def graph(results: Results) -> Rows:
    """Roots and leaders, and whom the leaders reach."""
    links = results.links
    found = roots(links)
    rows = [("Roots", "every agent" if len(found) == len(links.agents) else _names(links.agents, found))]
    if not found:
        rows = [("Roots", "none: the graph is not rooted")]
    leaders = results.analysis["leaders"]
    rows.append(("Leaders", in_short(leaders) if leaders else "none"))
    if leaders:
        reached = np.any([reached_by(links, links.agents.index(leader)) for leader in leaders], axis=0)
        missing = _names(links.agents, np.flatnonzero(~reached).tolist())
        rows.append(("Reached by a leader", f"all but {missing}" if missing else "every agent"))
    return rows


def _names(agents: tuple[str, ...], indices: Iterable[int]) -> str:
    return in_short(agents[i] for i in indices)


# --- provenance -------------------------------------------------------------------------------------------------------
def provenance(results: Results) -> Rows:
    """What is needed to run it again: hashes, versions, platform."""
    manifest = results.manifest
    rows = [("Command", " ".join(manifest["command"])), ("SHA-256 of scenario.yaml", manifest["config_sha256"])]
    for component in manifest["components"]:
        kind = "Python" if component["fmi"] == "python" else f"FMI {component['fmi']}"
        label = f"{component['model']} ({kind}, {component['instances']} ×), SHA-256"
        rows.append((label, component["sha256"] or NOTHING))
    rows.append(("Versions", ", ".join(f"{name} {version}" for name, version in manifest["versions"].items())))
    rows.append(("Platform", manifest["platform"]))
    return rows
