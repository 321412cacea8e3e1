"""modelDescription.xml says what the binary does: start values, flags, units, and dependencies found by experiment."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description

import fmus
from fmus import build, description
from tests.fmus.driver import CS, ME, Driver, Floats
from tests.fmus.reference_solutions import SOLUTIONS, START

OpenFmu = Callable[[str, str], Driver]
MODELS = list(SOLUTIONS)
SYNCHRONIZING = ["ArmSyncController", "AxisSyncController"]
FILES = [f"{model}.{version}" for model in MODELS for version in ("fmi2", "fmi3")]


@pytest.mark.parametrize("name", FILES)
def test_start_values_are_the_binary_s(open_fmu: OpenFmu, name: str) -> None:
    fmu = open_fmu(name, CS)
    checked = 0
    for variable in fmu.variables.values():
        if variable.start is None:
            continue
        kind = {"Enumeration": "Integer" if fmu.version == 2 else "Int64"}.get(variable.type, variable.type)
        words = variable.start.split()
        keywords = {} if fmu.version == 2 else {"nValues": len(words)}
        values = getattr(fmu.fmu, f"get{kind}")([variable.valueReference], **keywords)
        assert [float(value) for value in values] == [
            {"true": 1.0, "false": 0.0}.get(w) or float(w != "false" and w) for w in words
        ]
        checked += 1
    assert checked > 3


@pytest.mark.parametrize("name", FILES)
def test_capabilities(built: dict[str, Path], name: str) -> None:
    xml = read_model_description(str(built[name]))
    for interface in (xml.modelExchange, xml.coSimulation):
        assert interface.modelIdentifier == xml.modelName
        assert interface.canGetAndSetFMUstate
        assert interface.canSerializeFMUstate
        assert not interface.canBeInstantiatedOnlyOncePerProcess
        assert not getattr(interface, "providesDirectionalDerivative", False)
    assert xml.coSimulation.canHandleVariableCommunicationStepSize
    assert not xml.modelExchange.needsCompletedIntegratorStep
    assert xml.numberOfEventIndicators == 0


@pytest.mark.parametrize("model", MODELS)
def test_versions_describe_the_same(built: dict[str, Path], model: str) -> None:
    """Array for array: causality, variability, unit, description and dependencies."""

    def summary(version: str) -> dict[str, Any]:
        xml = read_model_description(str(built[f"{model}.{version}"]))

        def base(variable: Any) -> Any:
            return variable.name.split("[")[0] + (
                ")" if variable.name.startswith("der(") and "[" in variable.name else ""
            )

        result: dict[Any, Any] = {}
        for v in xml.modelVariables:
            causality = v.causality.replace("structuralParameter", "parameter")
            result[base(v)] = (causality, v.variability, v.initial, v.unit, v.description)
        for group in ("outputs", "derivatives", "initialUnknowns"):
            for unknown in getattr(xml, group):
                result[group, base(unknown.variable)] = {base(d) for d in unknown.dependencies}
        return result

    assert summary("fmi2") == summary("fmi3")


def influence(fmu: Driver, knowns: list[str], unknowns: list[str], states: dict[str, slice]) -> set[tuple[str, str]]:
    """(unknown, known) pairs where a change of the known changes the unknown, in Event Mode without an event update."""
    pairs = set()
    base_states = fmu.states
    for known, sign in itertools.product(knowns, (1.0, -1.0)):
        fmu.fmu.enterEventMode()
        before = {name: fmu.get(name) for name in unknowns}
        original = fmu.get(known)
        if known in states:
            fmu.fmu.enterContinuousTimeMode()
            x = base_states.copy()
            x[states[known]] += 0.37 * sign
            fmu.states = x
        elif known == "time":
            fmu.fmu.setTime(fmu.time + 0.01)
        else:
            fmu.set(**{known: original + (0.37 * sign if known != "neighbour_stamp" else sign)})
        pairs |= {(name, known) for name in unknowns if not np.array_equal(fmu.get(name), before[name])}
        if known in states:
            fmu.states = base_states
            fmu.fmu.enterEventMode()
        elif known == "time":
            fmu.fmu.setTime(fmu.time)
        else:
            fmu.set(**{known: original})
        fmu.fmu.enterContinuousTimeMode()
    return pairs


def state_slices(fmu: Driver, xml: Any) -> dict[str, slice]:
    result, begin = {}, 0
    for unknown in xml.derivatives:
        size = int(np.prod(fmu.shape(unknown.variable.name)))
        result[unknown.variable.derivative.name] = slice(begin, begin + size)
        begin += size
    return result


def prepare(fmu: Driver, model: str, role: int, extrapolation: int) -> Floats:
    if model not in SYNCHRONIZING:
        fmu.initialize(**START[model])
        return fmu.states
    fmu.initialize(
        n_neighbours=2,
        weight=[0.4, 0.6],
        role=role,
        extrapolation=extrapolation,
        theta_hat_start=[0.5, 0.1, 0.2, 0.3, 0.4],
        v_hat_start=[0.1, 0.2],
        v_bar_from_estimate=0,
        p=[0.4, -0.7],
        v=[0.3, 0.6],
    )
    for tick in range(3):
        stamp, time = [max(tick - 1, 0), tick], [max(tick - 1, 0) * 0.1, tick * 0.1]
        fmu.event(neighbour_stamp=stamp, neighbour_time=time, neighbour_p=[[1, 2], [3, 4]], neighbour_v_hat=1.0)
        fmu.integrate(0.1 * (tick + 1) - 0.03, lambda f, a, b, x: x + (b - a) * f(a, x))
    return fmu.states


@pytest.mark.parametrize("model", MODELS)
def test_dependencies_are_those_that_one_can_find(open_fmu: OpenFmu, built: dict[str, Path], model: str) -> None:
    xml = read_model_description(str(built[f"{model}.fmi3"]))
    unknowns = [*xml.outputs, *xml.derivatives]
    declared = {(u.variable.name, d.name) for u in unknowns for d in u.dependencies}
    inputs = [v.name for v in xml.modelVariables if v.causality == "input"]
    found: set[tuple[str, str]] = set()
    choices = [(1, 1), (1, 2), (1, 3), (1, 4), (2, 1), (3, 1)] if model in SYNCHRONIZING else [(0, 0)]
    for role, extrapolation in choices:
        fmu = open_fmu(f"{model}.fmi3", ME)
        prepare(fmu, model, role, extrapolation)
        states = state_slices(fmu, xml)
        found |= influence(fmu, [*inputs, *states, "time"], [u.variable.name for u in unknowns], states)
    assert found == declared


FEEDTHROUGH: dict[str, dict[str, set[str]]] = {
    "ArmSyncController": {"u": {"p", "v"}, "v_hat": set()},
    "AxisSyncController": {"u": {"p", "v"}, "v_hat": set()},
    "PDController": {"u": {"p", "v", "p_ref", "v_ref", "u_ref"}},
    "ConsensusController": {"u": {"p", "v", "neighbour_p", "neighbour_v", "neighbour_stamp", "weight"}},
}


def test_feedthrough_of_the_shipped_models(built: dict[str, Path]) -> None:
    """What the ordering of an agent's evaluation rests on: no algebraic loop between plants and controllers."""
    for version in ("fmi2", "fmi3"):
        for model in MODELS:
            through = {}
            for unknown in read_model_description(str(built[f"{model}.{version}"])).outputs:
                inputs = {d.name.split("[")[0] for d in unknown.dependencies if d.causality == "input"}
                through[unknown.variable.name.split("[")[0]] = inputs
            assert through == FEEDTHROUGH.get(model, {"p": set(), "v": set()})


@pytest.mark.parametrize("model", MODELS)
def test_readme_lists_every_variable(model: str) -> None:
    folder = build.ROOT / model
    rows = {
        line.split("`")[1]: line for line in (folder / "README.md").read_text("utf-8").splitlines() if line[:3] == "| `"
    }
    for variable in description.load(folder / "model.toml").variables:
        if not variable.state and variable.name != "time":
            cells = [cell.strip() for cell in rows[variable.name].split("|")]
            unitless = ["any", "mixed"] if variable.kind == "Real" else [""]
            assert cells[3] in ([variable.unit] if variable.unit else unitless)
            assert cells[5] == variable.description


def test_shipped_names() -> None:
    models = [folder.name for folder in build.model_folders()]
    assert models == sorted(MODELS)
    expected = sorted(name for model in models for name in (model, f"{model}.fmi2", f"{model}.fmi3"))
    assert fmus.names() == expected
    assert fmus.path("TwoLinkArm") == fmus.path("TwoLinkArm.fmi3")
    assert all(fmus.path(name).is_file() for name in expected)
    with pytest.raises(KeyError, match=r"no shipped FMU is called 'TwoLinkArms' \(known: ArmSyncController, "):
        fmus.path("TwoLinkArms")
