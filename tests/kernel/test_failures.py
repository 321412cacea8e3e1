"""Failures inside the loop: the native one and the Python one name the same component, time and reason."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.components.component import Interface
from cosim.components.python import PythonInstance, describe_python
from cosim.errors import ComponentError, ConfigError
from cosim.kernel import Member, NativeBlock, layout
from cosim.plan import AgentPlan, CouplingPlan, Integrator, Method
from fmus import build
from network.messages import MessageLayout
from tests.kernel.agents import T_NS, Case, LiveAgent, live
from tests.kernel.test_bits import probe_pair

NO_MESSAGES = MessageLayout((), ())
JOINT = CouplingPlan(Method.JOINT, 10_000_000)
STEPS = CouplingPlan(Method.GAUSS_SEIDEL, 10_000_000)


def advance(agent: LiveAgent, ticks: int) -> None:
    for tick in range(ticks):
        agent.advance(tick)


def failure(plan: AgentPlan, *, native: bool, ticks: int = 100) -> tuple[str, str, str | None, float]:
    """Component, message, last log line and time of the first failure."""
    agent = LiveAgent(plan, native=native, layout=NO_MESSAGES)
    try:
        agent.python.initialise(0, ticks * T_NS)
        with np.errstate(all="ignore"), pytest.raises(ComponentError) as caught:
            advance(agent, ticks)
    finally:
        for component in agent.components:
            component.terminate()
    error = caught.value
    return error.component, error.message, error.log, float(agent.state.time[0])


MODEL_EXCHANGE = {
    "completed_stops": "asks to end the simulation (terminateSimulation)",
    "completed_error": "fmi{fmi}CompletedIntegratorStep returned Error",
    "derivative_error": "returned Error",
    "update_error": "returned Error",
    "update_stops": "asks to end the simulation (terminateSimulation)",
    "never_settles": "its discrete states did not settle within 100 updates at one instant",
    "derivative_nan": "continuous state 1 is not finite",
}
CO_SIMULATION = {
    "step_discards": "fmi{fmi}DoStep returned Discard",
    "step_error": "fmi{fmi}DoStep returned Error",
    "step_fatal": "fmi{fmi}DoStep returned Fatal",
    "step_stops": "asks to end the simulation (terminateSimulation)",
}
CO_SIMULATION_3 = {
    "step_early": "fmi3DoStep returned early, at t = 0.0025 s",
}


@pytest.mark.parametrize(
    ("coupling", "fmi", "mode", "said"),
    [
        *((JOINT, fmi, mode, said) for fmi in (2, 3) for mode, said in MODEL_EXCHANGE.items()),
        *((STEPS, fmi, mode, said) for fmi in (2, 3) for mode, said in CO_SIMULATION.items()),
        *((STEPS, 3, mode, said) for mode, said in CO_SIMULATION_3.items()),
    ],
)
def test_the_same_failure(probes: dict[int, Path], coupling: CouplingPlan, fmi: int, mode: str, said: str) -> None:
    plan = probe_pair([probes[fmi]] * 2, [("vector_out", "vector_in")], coupling, ("nothing", mode))
    component, message, log, time = failure(plan, native=True)
    assert component == "second"
    assert said.format(fmi=fmi) in message
    assert (log is not None) == ("returned" in said and "early" not in said)
    assert (component, message, log, time) == failure(plan, native=False)


@pytest.mark.parametrize("coupling", [JOINT, STEPS], ids=["joint", "steps"])
def test_an_output_that_is_not_finite(probes: dict[int, Path], coupling: CouplingPlan) -> None:
    connections = [("vector_out", "vector_in"), ("Float32_out", "Float32_in")]
    plan = probe_pair([probes[3]] * 2, connections, coupling, ("output_nan", "nothing"))
    expected = ("first", "output Float32_out is not finite", None)
    assert failure(plan, native=True)[:3] == expected
    assert failure(plan, native=True) == failure(plan, native=False)


def test_values_that_never_settle_at_an_event(probes: dict[int, Path]) -> None:
    plan = probe_pair([probes[3]] * 2, [("Float32_out", "Float32_in")], JOINT, ("never_converges", "nothing"))
    agent = LiveAgent(plan, native=True, layout=NO_MESSAGES)
    with pytest.raises(ComponentError, match="did not settle within 100 rounds") as at_start:
        agent.python.initialise(0, T_NS)
    with pytest.raises(ComponentError) as native:
        agent.advance(0)
    assert native.value.args == at_start.value.args
    for component in agent.components:
        component.terminate()


def test_a_step_size_that_vanishes(probes: dict[int, Path]) -> None:
    coupling = replace(JOINT, integrator=Integrator.DORMAND_PRINCE)
    plan = probe_pair([probes[3]] * 2, [], coupling, ("nothing", "derivative_jumps"))
    component, message, _, _ = failure(plan, native=True)
    assert component == "second"
    assert "without meeting the tolerances" in message
    assert failure(plan, native=True) == failure(plan, native=False)


def test_the_adaptation_law_as_printed_blows_up() -> None:
    """With the paper's printed sign the error names who and when, and gives the FMU's own log line."""
    seen = []
    for native in (True, False):
        case = Case(adaptation_sign=1.0, step_ns=20_000_000, p=(1.0, -1.0))
        with live(case, native=native) as agent, pytest.raises(ComponentError) as caught:
            advance(agent, 100)
        seen.append((caught.value.component, caught.value.message, caught.value.log, float(agent.state.time[0])))
    assert seen[0] == seen[1]
    assert seen[0][0] == "controller"
    assert "is not finite" in f"{seen[0][1]} {seen[0][2]}"


# --- using it wrongly -----------------------------------------------------------------------------------------------
def test_an_ended_agent_cannot_advance() -> None:
    with live(Case(), native=True) as agent:
        agent.advance(0)
        agent.end()
        with pytest.raises(ValueError, match="has failed or ended"):
            agent.advance(1)


def test_python_components_need_the_python_loop(probes: dict[int, Path]) -> None:
    plan = probe_pair([probes[3]] * 2, [], STEPS)
    agent = LiveAgent(plan, native=False, layout=NO_MESSAGES)
    sine = PythonInstance(
        "s", "cosim.components.library:Sine", Interface.CO_SIMULATION, describe_python("cosim.components.library:Sine")
    )
    with pytest.raises(ConfigError, match="loop: python"):
        NativeBlock([Member(0, agent.wiring, [agent.components[0], sine], STEPS)], agent.memory, T_NS)
    for component in agent.components:
        component.terminate()


def test_texts_cannot_be_connected(probes: dict[int, Path]) -> None:
    plan = probe_pair([probes[3]] * 2, [("label", "Int32_in")], STEPS)
    with pytest.raises(ConfigError, match="label is of type String: it holds no numbers"):
        LiveAgent(plan, native=True, layout=NO_MESSAGES)


def test_a_time_beyond_the_exact_range() -> None:
    with live(Case(), native=True) as agent, pytest.raises(ComponentError, match="loop: python"):
        agent.advance(2**53 // T_NS)


# --- the library ----------------------------------------------------------------------------------------------------
def library_beside(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "__file__", str(path / "layout.py"))
    layout.library.cache_clear()
    try:
        layout.library()
    finally:
        layout.library.cache_clear()


def test_a_missing_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"cannot be loaded .*build it with `python -m fmus.build`"):
        library_beside(tmp_path, monkeypatch)


FUNCTIONS = ("kernel_advance", "watch_crashes", "ignore_crashes")
EXPORT = '__attribute__((visibility("default")))'


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (f"{EXPORT} int other(void) {{ return 0; }}", "cannot be loaded"),
        (
            "".join(f"{EXPORT} int cosim_{name}(void) {{ return 0; }}\n" for name in FUNCTIONS)
            + f"{EXPORT} unsigned long long cosim_kernel_sizes(void) {{ return 1; }}",
            "built from other sources",
        ),
    ],
)
def test_another_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, said: str) -> None:
    (tmp_path / "other.c").write_text(source, encoding="utf-8")
    build.compile_shared([tmp_path / "other.c"], tmp_path / f"_kernel{build.library_suffix()}")
    with pytest.raises(ConfigError, match=said):
        library_beside(tmp_path, monkeypatch)
