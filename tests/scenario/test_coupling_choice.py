"""Which coupling an agent gets, from what its components offer."""

import pytest

from cosim.components.component import Description, Interface
from cosim.errors import ConfigError, Severity
from cosim.plan import CouplingPlan, Loop, Method
from cosim.planning.coupling import choose_coupling
from cosim.planning.problems import Problems
from cosim.scenario.reading import AgentEntry
from cosim.scenario.source import parse
from cosim.scenario.spec import AgentSpec

ME, CS = Interface.MODEL_EXCHANGE, Interface.CO_SIMULATION
PERIOD = 100_000_000


def describe(*interfaces: Interface, fmi: str = "3.0", indicators: int = 0, variable_step: bool = True) -> Description:
    return Description("M", fmi, interfaces, {}, n_event_indicators=indicators, variable_step=variable_step)


def choose(
    text: str, *descriptions: Description, period_ns: int = PERIOD
) -> tuple[CouplingPlan | None, list[str], list[str]]:
    """The choice, the errors and the warnings."""
    node = parse(f"coupling: {text}", "f")
    problems = Problems()
    named = dict(zip(("plant", "controller"), descriptions, strict=False))
    found = choose_coupling(
        AgentEntry(AgentSpec.model_validate(node.plain()), node, None), named, 2, period_ns, problems
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
        ([describe(ME, CS, indicators=1), describe(ME, CS)], Method.JOINT),
        ([describe(ME, indicators=1), describe(ME)], Method.JOINT),
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
            "the native loop runs FMUs only, and 'controller' is Python",
        ),
    ],
)
def test_what_cannot_be(text: str, descriptions: list[Description], sentence: str) -> None:
    _, errors, _ = choose(text, *descriptions)
    assert len(errors) == 1
    assert sentence in errors[0]


@pytest.mark.parametrize(
    ("text", "description", "sentence"),
    [
        ("{method: midpoint}", describe(CS, variable_step=False), "'plant' accepts steps of one length only"),
    ],
)
def test_what_is_not_promised(text: str, description: Description, sentence: str) -> None:
    found, errors, (warning,) = choose(text, description)
    assert found is not None
    assert errors == []
    assert sentence in warning


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
    assert [found.loop for found in (native, python, mixed) if found] == [Loop.NATIVE, Loop.PYTHON, Loop.PYTHON]
