"""Which coupling an agent gets, from what its components offer."""

import re
from collections.abc import Set
from typing import Any

import pytest

from cosim.components.component import Description, Interface
from cosim.errors import ConfigError, Severity
from cosim.plan import ControlPlan, CouplingPlan, Loop, Method
from cosim.planning.coupling import choose_coupling
from cosim.planning.problems import Problems
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import parse
from cosim.scenario.spec import AgentSpec

ME, CS = Interface.MODEL_EXCHANGE, Interface.CO_SIMULATION
PERIOD = 100_000_000


def describe(*interfaces: Interface, fmi: str = "3.0", **attributes: Any) -> Description:
    return Description("M", fmi, interfaces, {}, **attributes)


def choose(
    text: str, *descriptions: Description, period_ns: int = PERIOD, readers: Set[str] = frozenset({"controller"})
) -> tuple[CouplingPlan | None, list[str], list[str]]:
    """The choice, the errors and the warnings."""
    node = parse(f"coupling: {text}", "f")
    problems = Problems()
    named = dict(zip(("plant", "controller"), descriptions, strict=False))
    found = choose_coupling(
        AgentEntry(AgentSpec.model_validate(node.plain()), node, None), named, readers, period_ns, problems
    )
    errors: list[str] = []
    try:
        problems.raise_if_any()
    except ConfigError as error:
        errors = [problem.message for problem in error.problems if problem.severity is Severity.ERROR]
    return found, errors, [problem.message for problem in problems.warnings]


@pytest.mark.parametrize(
    ("descriptions", "method"),
    [
        ([describe(ME, CS), describe(ME, CS)], Method.JOINT),
        ([describe(ME), describe(ME)], Method.JOINT),
        ([describe(ME, CS), describe(CS)], Method.MIDPOINT),
        ([describe(ME, CS, n_event_indicators=1), describe(ME, CS)], Method.JOINT),
        ([describe(ME, n_event_indicators=1), describe(ME)], Method.JOINT),
    ],
)
def test_auto(descriptions: list[Description], method: Method) -> None:
    found, errors, _ = choose("{method: auto}", *descriptions)
    assert errors == []
    assert found is not None
    assert found.method is method


@pytest.mark.parametrize(
    ("text", "descriptions", "sentence"),
    [
        (
            "{method: joint}",
            [describe(ME, CS), describe(CS)],
            "joint needs Model Exchange: 'controller' does not offer Model Exchange",
        ),
        (
            "{method: jacobi}",
            [describe(ME), describe(ME)],
            "jacobi needs Co-Simulation: 'plant', 'controller' do not offer Co-Simulation",
        ),
        (
            "{method: auto}",
            [describe(ME), describe(CS)],
            "no method fits all components: 'plant' does not offer Co-Simulation",
        ),
        (
            "{loop: native}",
            [describe(ME), describe(ME, fmi="python")],
            "the native loop cannot be had: 'controller' is Python; leave 'loop' out",
        ),
        (
            "{loop: native}",
            [describe(CS, asynchronous=True), describe(CS)],
            "the native loop cannot be had: 'plant' steps asynchronously (canRunAsynchronuously); leave 'loop' out",
        ),
        (
            "{retries: 3}",
            [describe(CS), describe(CS, can_get_and_set_state=True)],
            "'retries' takes components that can save their state, and 'plant' cannot (an FMU: canGetAndSetFMUState; a",
        ),
    ],
)
def test_what_cannot_be(text: str, descriptions: list[Description], sentence: str) -> None:
    _, errors, _ = choose(text, *descriptions)
    assert len(errors) == 1
    assert sentence in errors[0]


@pytest.mark.parametrize(
    ("plant", "rollback"),
    [
        ({"can_get_and_set_state": True}, True),
        ({}, False),
        ({"can_get_and_set_state": True, "asynchronous": True}, False),
    ],
)
def test_steps_are_taken_back_where_all_can_save_their_state(plant: dict[str, bool], *, rollback: bool) -> None:
    saves = describe(CS, can_get_and_set_state=True)
    found, errors, _ = choose("{tolerance: 1e-5, least_step: 10 us}", describe(CS, **plant), saves)
    assert errors == []
    assert found is not None
    assert found.control == ControlPlan(1e-5, 1e-5, 10_000, PERIOD, rollback)
    assert (found.step_ns, found.loop, found.grid) == (PERIOD, Loop.PYTHON, False)


@pytest.mark.parametrize("fixed", [{"variable_step": False}, {"internal_step": 0.001}])
def test_steps_of_one_length_cannot_keep_to_a_tolerance(fixed: dict[str, Any]) -> None:
    _, errors, _ = choose("{tolerance: 1e-5}", describe(CS, **fixed), describe(CS))
    assert len(errors) == 1
    assert "'tolerance' chooses steps of any length, and 'plant' takes those of one length only" in errors[0]


def test_all_that_stands_against_a_tolerance_is_said_at_once() -> None:
    text = "{tolerance: 1e-5}\ncomponents: {plant: {fmu: a.fmu}, controller: {fmu: b.fmu, step: 10 ms}}"
    found, errors, _ = choose(text, describe(CS, variable_step=False), describe(CS))
    assert found is None
    assert len(errors) == 2
    assert "'plant' takes those of one length only" in errors[0]
    assert "leave 'step' out of 'controller'" in errors[1]


@pytest.mark.parametrize(
    ("text", "plant", "controller", "period_ns", "step_ns"),
    [
        ("{}", {"variable_step": False}, {}, PERIOD, 1_000_000),
        ("{}", {"variable_step": False, "usual_step": 0.02}, {}, PERIOD, 20_000_000),
        ("{}", {"internal_step": 0.0002}, {}, PERIOD, 1_000_000),
        ("{}", {"internal_step": 0.1}, {}, PERIOD, PERIOD),
        ("{}", {"internal_step": 0.004}, {"internal_step": 0.005}, 400_000_000, 20_000_000),
        ("{method: gauss-seidel}", {"internal_step": 0.004}, {"internal_step": 0.01}, PERIOD, 20_000_000),
        ("{}", {}, {"internal_step": 0.01}, PERIOD, 20_000_000),
        ("{step: 20 ms}", {"internal_step": 0.01}, {}, PERIOD, 20_000_000),
    ],
)
def test_components_that_make_steps_of_their_own(
    text: str, plant: dict[str, Any], controller: dict[str, Any], period_ns: int, step_ns: int
) -> None:
    """In `midpoint`, a component that reads one listed before it makes two half steps."""
    found, errors, warnings = choose(text, describe(CS, **plant), describe(CS, **controller), period_ns=period_ns)
    assert (errors, warnings) == ([], [])
    assert found is not None
    assert found.step_ns == step_ns
    assert found.grid


@pytest.mark.parametrize(
    ("usual", "said", "step_ns", "got"),
    [
        (0.03, "30 ms", 25_000_000, "25 ms"),
        (1 / 30, "33.333333 ms", 25_000_000, "25 ms"),
        (0.2, "200 ms", PERIOD, "100 ms"),
    ],
)
def test_the_step_of_a_default_experiment_that_does_not_fit(usual: float, said: str, step_ns: int, got: str) -> None:
    """Another one is taken, as large as there is, and said."""
    found, errors, (warning,) = choose("{}", describe(CS, variable_step=False, usual_step=usual), describe(CS))
    assert errors == []
    assert found is not None
    assert found.step_ns == step_ns
    assert f"{said} (its default experiment) do not fit the period 100 ms: it gets {got}; 'step'" in warning


@pytest.mark.parametrize("interfaces", [(CS,), (ME, CS)])
def test_steps_of_any_length_need_no_grid(interfaces: tuple[Interface, ...]) -> None:
    described = describe(*interfaces, internal_step=0.01 if ME in interfaces else None)
    found, _, _ = choose("{}", described, describe(*interfaces))
    assert found is not None
    assert not found.grid


@pytest.mark.parametrize(
    ("text", "controller", "sentence"),
    [
        (
            "{method: jacobi}",
            {"internal_step": 0.03},
            "'controller' advances in steps of 30 ms (fixedInternalStepSize), and the period 100 ms is no multiple of "
            "that; 90 ms or 120 ms is",
        ),
        (
            "{}",
            {"internal_step": 0.1},
            "'controller' advances in steps of 100 ms and makes two of them per micro step (fixedInternalStepSize), "
            "and the period 100 ms is no multiple of that; 200 ms is",
        ),
        (
            "{method: jacobi, step: 25 ms}",
            {"internal_step": 0.01},
            "'controller' advances in steps of 10 ms (fixedInternalStepSize), and the step 25 ms is no multiple of "
            "that; 20 ms does",
        ),
        (
            "{method: jacobi, step: 30 ms}",
            {"internal_step": 0.01},
            "the step 30 ms does not divide the period 100 ms; 20 ms does",
        ),
    ],
)
def test_steps_that_a_component_cannot_make(text: str, controller: dict[str, Any], sentence: str) -> None:
    _, errors, _ = choose(text, describe(CS), describe(CS, **controller))
    assert errors == [sentence]


@pytest.mark.parametrize(
    ("text", "period_ns", "step_ns"),
    [
        ("{method: joint}", PERIOD, 5_000_000),
        ("{method: midpoint}", PERIOD, 1_000_000),
        ("{method: joint}", 12_000_000, 4_000_000),
        ("{method: joint}", 3_000_000, 3_000_000),
        ("{method: joint, step: 20 ms}", PERIOD, 20_000_000),
        ("{method: joint, integrator: dormand-prince, step: 30 ms}", PERIOD, 30_000_000),
    ],
)
def test_steps(text: str, period_ns: int, step_ns: int) -> None:
    found, errors, _ = choose(text, describe(ME, CS), period_ns=period_ns)
    assert errors == []
    assert found is not None
    assert found.step_ns == step_ns


def test_a_period_that_no_usual_step_divides() -> None:
    _, errors, _ = choose("{method: joint}", describe(ME), period_ns=1_000_000_007)
    assert errors == ["no usual step divides the period 1.000000007 s; give 'step' under 'coupling'"]


def test_loops() -> None:
    native, _, _ = choose("{}", describe(ME))
    python, _, _ = choose("{loop: python}", describe(ME))
    mixed, _, _ = choose("{}", describe(ME), describe(ME, fmi="python"))
    slow, _, _ = choose("{}", describe(CS, asynchronous=True))
    saved, _, _ = choose("{retries: 3}", describe(CS, can_get_and_set_state=True))
    joint, _, _ = choose("{retries: 3}", describe(ME, asynchronous=True, can_get_and_set_state=True))
    assert [found.loop for found in (native, joint) if found] == [Loop.NATIVE] * 2
    assert [found.loop for found in (python, mixed, slow, saved) if found] == [Loop.PYTHON] * 4
    assert saved is not None
    assert saved.retries == 3


@pytest.mark.parametrize(
    ("component", "method", "said"),
    [
        ("{fmu: Plant, tolerance: 1e-6}", "gauss-seidel", None),
        ("{fmu: Plant, tolerance: 1e-6, solver: cvode}", "gauss-seidel", None),
        ("{fmu: Plant, tolerance: 1e-6}", "joint", "write `coupling: {integrator: dormand-prince, relative_tolerance"),
        ("{python: 'm:Plant', tolerance: 1e-6}", "gauss-seidel", "'tolerance' is for FMUs and for 'solver: cvode'"),
    ],
)
def test_the_tolerance_of_a_component_is_for_a_solver_inside(component: str, method: str, said: str | None) -> None:
    node = parse(f"coupling: {{method: {method}}}\ncomponents: {{plant: {component}}}", "f")
    problems = Problems()
    entry = AgentEntry(AgentSpec.model_validate(node.plain()), node, None)
    choose_coupling(entry, {"plant": describe(ME, CS)}, frozenset(), PERIOD, problems)
    if said is None:
        problems.raise_if_any()
    else:
        with pytest.raises(ConfigError, match=re.escape(said)):
            problems.raise_if_any()
