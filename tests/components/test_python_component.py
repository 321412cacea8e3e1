"""Components written in Python: declarations, life cycle, loading, and mistakes of their authors."""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim import results
from cosim.cli import main
from cosim.components.component import Interface
from cosim.components.python import (
    Input,
    Output,
    Parameter,
    PythonComponent,
    PythonInstance,
    State,
    Structural,
    describe_python,
    load,
)
from cosim.errors import ComponentError, ConfigError

ME, CS = Interface.MODEL_EXCHANGE, Interface.CO_SIMULATION


class Filter(PythonComponent):
    """x' = (mean of u - x) / tau, sampled every `period`; starts at the mean of its inputs."""

    n = Structural(1)
    tau = Parameter(0.5, unit="s")
    period = Parameter(0.1, unit="s")
    mode = Parameter(1, items={"mean": 1, "largest": 2})
    enabled = Parameter(True, dtype="Boolean")
    label = Parameter("filter", dtype="String")
    u = Input(shape=("n", 2), unit="m", description="what is filtered")
    x = State(shape=(2,), unit="m")
    sampled = Output(shape=(2,), depends_on=(), unit="m")
    twice = Output(shape=(2,))

    def initialise(self, time: float) -> None:
        self.x = self._target()
        self.sampled = self.x

    def outputs(self, time: float) -> None:
        self.twice = 2.0 * self.x

    def derivatives(self, time: float) -> Mapping[str, Any]:
        return {"x": (self._target() - self.x) / self.tau if self.enabled else 0.0}

    def event(self, time: float) -> None:
        self.sampled = self.x

    def next_event(self, time: float) -> float | None:
        period = float(self.period)
        return (math.floor(time / period + 1e-9) + 1) * period

    def _target(self) -> Any:
        return self.u.mean(axis=0) if self.mode == 1 else self.u.max(axis=0)


class Counter(PythonComponent):
    """Co-Simulation: counts its steps and keeps the time."""

    count = Output(dtype="Int64")
    until = Output()

    def step(self, time: float, step: float) -> None:
        self.count += 1
        self.until = time + step


class Gain(PythonComponent):
    """A function of its input."""

    k = Parameter(3.0)
    u = Input()
    y = Output(depends_on=("u",))

    def outputs(self, time: float) -> None:
        self.y = self.k * self.u + time


class Fragile(PythonComponent):
    """Does what its parameter says, all of it wrong."""

    wrong = Parameter("nothing", dtype="String")
    y = Output(shape=(2,))
    x = State()

    def outputs(self, time: float) -> None:
        if self.wrong == "raise":
            raise ZeroDivisionError("no friction")
        if self.wrong == "shape":
            self.y = [1.0, 2.0, 3.0]

    def derivatives(self, time: float) -> Mapping[str, Any]:
        if self.wrong == "missing":
            return {}
        return {"x": [1.0, 2.0] if self.wrong == "slope" else 1.0}


class NoEquation(PythonComponent):
    """A state that nothing changes."""

    x = State()


class NoState(PythonComponent):
    """Derivatives of nothing."""

    def derivatives(self, time: float) -> Mapping[str, Any]:
        return {"x": 1.0}


class Modes(PythonComponent):
    mode = Parameter("slow", items={"slow": 3, "fast": -8})
    modes = Parameter(["fast", "slow"], shape=(2,), items={"slow": 3, "fast": -8})


class BadMode(PythonComponent):
    mode = Parameter("slo", items={"slow": 3, "fast": -8})


class BadStart(PythonComponent):
    gain = Parameter("high")


class BadShape(PythonComponent):
    """An array sized by nothing that there is."""

    u = Input(shape=("m",))


class EarlyBird(PythonComponent):
    """Assigns too early."""

    y = Output()

    def __init__(self) -> None:
        self.y = 1.0


HERE = __name__


def dotted(cls: type[PythonComponent]) -> str:
    return f"{cls.__module__}:{cls.__name__}"


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """pytest imports this file under a name of its own."""
    monkeypatch.setitem(sys.modules, HERE, sys.modules[Filter.__module__])


def opened(cls: type[PythonComponent], interface: Interface, **start: Any) -> PythonInstance:
    description = describe_python(dotted(cls), {k: v for k, v in start.items() if k == "n"})
    instance = PythonInstance("c", dotted(cls), interface, description)
    for name, value in start.items():
        instance.start(description.variables[name], value if isinstance(value, tuple) else (value,))
    return instance


def get(instance: PythonInstance, name: str) -> list[float]:
    return list(instance.get(instance.description.variables[name]).tolist())


def put(instance: PythonInstance, name: str, *values: float) -> None:
    instance.set(instance.description.variables[name], np.array(values, dtype=np.float64))


# --- descriptions ---------------------------------------------------------------------------------------------------
def test_a_description() -> None:
    description = describe_python(dotted(Filter), {"n": 3})
    assert description.fmi == "python"
    assert description.model == "Filter"
    assert len(description.sha256) == 64
    variables = description.variables
    assert list(variables)[:3] == ["n", "tau", "period"]
    assert variables["n"].causality == "structuralParameter"
    assert variables["n"].start == (3,)
    assert variables["u"].shape == (3, 2)
    assert variables["u"].unit == "m"
    assert variables["u"].description == "what is filtered"
    assert variables["u"].variability == "continuous"
    assert variables["tau"].variability == "fixed"
    assert variables["mode"].dtype == "Enumeration"
    assert variables["mode"].items == {"mean": 1, "largest": 2}
    assert variables["enabled"].start == (True,)
    assert variables["label"].start == ("filter",)
    assert variables["x"].causality == "output"
    assert variables["x"].dependencies == ()
    assert variables["sampled"].dependencies == ()
    assert variables["twice"].dependencies is None
    assert variables["twice"].initial == "calculated"


@pytest.mark.parametrize(("cls", "interfaces"), [(Filter, (ME,)), (Counter, (CS,)), (Gain, (ME, CS))], ids=str)
def test_interfaces_follow_from_the_methods(cls: type[PythonComponent], interfaces: tuple[Interface, ...]) -> None:
    assert describe_python(dotted(cls)).interfaces == interfaces


def test_a_subclass_inherits_variables() -> None:
    class Narrow(Filter):
        tau = Parameter(0.1, unit="s")

    sys.modules[Narrow.__module__].Narrow = Narrow  # type: ignore[attr-defined]
    variables = describe_python(dotted(Narrow)).variables
    assert variables["tau"].start == (0.1,)
    assert variables["x"].shape == (2,)


def test_a_declaration_is_found_on_the_class() -> None:
    assert isinstance(Filter.tau, Parameter)


# --- life cycle -----------------------------------------------------------------------------------------------------
def test_model_exchange() -> None:
    c = opened(Filter, ME, n=2, tau=0.25)
    c.enter_initialization(0.0, 1.0)
    assert get(c, "twice") == [0.0, 0.0]
    put(c, "u", 1.0, 2.0, 3.0, 4.0)
    assert get(c, "twice") == [4.0, 6.0]
    c.exit_initialization()
    assert c.update_discrete_states() == 0.1
    c.enter_continuous_time_mode()
    assert c.n_states == 2
    assert c.get_states().tolist() == [2.0, 3.0]
    c.set_time(0.35)
    c.set_states(np.array([1.0, 1.0]))
    assert c.derivatives().tolist() == [4.0, 8.0]
    assert get(c, "sampled") == [2.0, 3.0]
    assert not c.completed_step()
    c.enter_event_mode()
    assert c.update_discrete_states() == pytest.approx(0.4)
    assert get(c, "sampled") == [1.0, 1.0]
    put(c, "u", 5.0, 5.0, 5.0, 5.0)
    assert get(c, "x") == [1.0, 1.0], "initialise is over"
    c.terminate()
    c.terminate()


def test_start_values_of_every_kind() -> None:
    c = opened(Filter, ME, n=2, mode="largest", enabled=False, label="ruhig", u=(1.0, 2.0, 3.0, 4.0))
    c.enter_initialization(0.0, 1.0)
    c.exit_initialization()
    assert get(c, "x") == [3.0, 4.0]
    assert c.derivatives().tolist() == [0.0, 0.0]


def test_co_simulation() -> None:
    c = opened(Counter, CS)
    c.enter_initialization(0.0, 1.0)
    c.exit_initialization()
    c.step(0.0, 0.25)
    c.step(0.25, 0.5)
    assert get(c, "count") == [2.0]
    assert get(c, "until") == [0.75]


@pytest.mark.parametrize("interface", [ME, CS])
def test_a_function_of_time_and_inputs(interface: Interface) -> None:
    c = opened(Gain, interface)
    c.enter_initialization(0.0, 1.0)
    c.exit_initialization()
    put(c, "u", 2.0)
    if interface is CS:
        c.step(0.0, 0.5)
    else:
        c.set_time(0.5)
        assert c.get_states().size == c.derivatives().size == 0
    assert get(c, "y") == [6.5]


def test_inputs_of_whole_numbers_are_rounded() -> None:
    c = opened_hold()
    put(c, "stamp", 1.6, -1.0)
    put(c, "values", 5.0, 6.0)
    assert get(c, "stamp") == [2.0, -1.0]


# --- the library ----------------------------------------------------------------------------------------------------
def opened_hold(count: int = 2, width: int = 1) -> PythonInstance:
    sizes = {"count": count, "width": width}
    description = describe_python("cosim.components.library:Hold", sizes)
    c = PythonInstance("hold", "cosim.components.library:Hold", ME, description)
    for name, size in sizes.items():
        c.start(description.variables[name], (size,))
    c.enter_initialization(0.0, 1.0)
    c.exit_initialization()
    return c


def test_hold_gives_the_freshest_value() -> None:
    c = opened_hold(count=3, width=2)
    put(c, "values", 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    assert get(c, "value") == [0.0, 0.0]
    put(c, "stamp", -1.0, 4.0, -1.0)
    assert get(c, "value") == [3.0, 4.0]
    put(c, "stamp", 7.0, 4.0, 7.0)
    assert get(c, "value") == [1.0, 2.0]


def test_hold_without_neighbours() -> None:
    assert get(opened_hold(count=0), "value") == [0.0]


def test_sine() -> None:
    c = PythonInstance("s", "cosim.components.library:Sine", CS, describe_python("cosim.components.library:Sine"))
    c.enter_initialization(0.0, 1.0)
    c.exit_initialization()
    c.step(0.0, 0.75)
    assert get(c, "phi") == [2.0 * math.sin(0.75)]


# --- mistakes -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("raise", "ZeroDivisionError: no friction (test_python_component.py, line "),
        ("shape", "ValueError: could not broadcast"),
        ("missing", "derivatives returned nothing, not x"),
        ("slope", "ValueError: "),
    ],
)
def test_what_a_method_does_wrong(wrong: str, said: str) -> None:
    c = opened(Fragile, ME, wrong=wrong)
    c.enter_initialization(0.0, 1.0)
    with pytest.raises(ComponentError) as caught:
        c.derivatives()
    assert caught.value.component == "c"
    assert caught.value.message.startswith(said)


def test_an_assignment_in_init() -> None:
    with pytest.raises(ComponentError, match="y has no value in __init__ yet; use initialise"):
        opened(EarlyBird, CS)


def test_wrong_start_values() -> None:
    with pytest.raises(ComponentError, match="mode has no item 'men'"):
        opened(Filter, ME, mode="men")
    with pytest.raises(ComponentError, match="u takes 2 values, not 1"):
        opened(Filter, ME, u=(1.0,))


def test_a_size_that_was_not_described() -> None:
    description = describe_python(dotted(Filter), {"n": 2})
    c = PythonInstance("c", dotted(Filter), ME, description)
    with pytest.raises(ComponentError, match="n must be known when the component is described"):
        c.start(description.variables["n"], (3,))


def refusal(name: str) -> str:
    with pytest.raises(ConfigError) as caught:
        describe_python(name)
    (problem,) = caught.value.problems
    return problem.message


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("cosim.components.library", "'cosim.components.library' names no Python class; write package.module:Class"),
        (
            "cosim.components.libary:Sine",
            "there is no Python module 'cosim.components.libary' (did you mean 'cosim.components.library'?)",
        ),
        ("cosmi.library:Sine", "there is no Python module 'cosmi' (did you mean 'cosim'?)"),
        ("cosim.components.library:Sin", "module cosim.components.library has no class 'Sin' (did you mean 'Sine'?)"),
        ("cosim.components.library:math", "cosim.components.library:math is no PythonComponent: derive it from"),
        (
            "decimal:Decimal",
            "decimal:Decimal is no PythonComponent: derive it from cosim.components.python.PythonComponent",
        ),
    ],
)
def test_what_cannot_be_loaded(name: str, said: str) -> None:
    assert refusal(name).startswith(said)


@pytest.mark.parametrize(
    ("cls", "said"),
    [
        (NoEquation, "declares a State but implements neither derivatives nor step"),
        (NoState, "implements derivatives but declares no State"),
        (BadShape, "unknown dtype or size 'm'"),
        (BadMode, "declares a variable that cannot be: 'mode' has no item 'slo' (did you mean 'slow'?)"),
        (BadStart, "declares a variable that cannot be: 'gain': could not convert string to float: 'high'"),
    ],
)
def test_declarations_that_cannot_be(cls: type[PythonComponent], said: str) -> None:
    assert said in refusal(dotted(cls))


def test_items_by_name() -> None:
    variables = describe_python(dotted(Modes)).variables
    assert variables["mode"].start == (3,)
    assert variables["modes"].start == (-8, 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero (broken_module.py, line 1)"),
        ("def f(:", "SyntaxError: "),
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package' (broken_module.py, line 1)"),
    ],
)
def test_a_module_that_cannot_be_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "broken_module.py").write_text(text)
    message = refusal("broken_module:Thing")
    assert message.startswith("broken_module cannot be imported: ")
    assert said in message


def test_a_class_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    source = "from cosim.components.python import PythonComponent\nclass Mine(PythonComponent): pass\n"
    (tmp_path / "module_of_mine.py").write_text(source)
    assert load("module_of_mine:Mine").cls.__name__ == "Mine"


RISING = """\
from cosim.components.python import Output, PythonComponent

class Rising(PythonComponent):
    y = Output(depends_on=())
    def outputs(self, time):
        self.y = {factor} * time
"""
RISING_NET = """\
period: 100 ms
duration: 1 s
agents: {a: {components: {c: {python: "rising_part:Rising"}}, record: [c.y]}}
"""


def test_runs_of_one_process_are_of_the_code_that_their_manifests_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The module is edited, and then another one of its name is in another folder."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    digests = []
    for run, (folder, factor) in enumerate([("here", 1), ("here", 2), ("there", 3), ("here", 2)]):
        where = tmp_path / folder
        where.mkdir(exist_ok=True)
        monkeypatch.chdir(where)
        text = RISING.format(factor=factor)
        (where / "rising_part.py").write_text(text)
        (where / "net.yaml").write_text(RISING_NET)
        assert main(["run", "net.yaml", "--out", f"run{run}", "--no-report"]) == 0
        found = results.load(where / f"run{run}")
        assert found.array("c.y")[-1, 0] == factor
        (component,) = found.manifest["components"]
        assert component["sha256"] == hashlib.sha256(text.encode()).hexdigest()
        digests.append(found.manifest["digest"])
    assert digests[1] == digests[3]
    assert len(set(digests)) == 3


def test_a_class_that_was_edited_since_it_was_described(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "rising_part.py").write_text(RISING.format(factor=4))
    description = describe_python("rising_part:Rising")
    (tmp_path / "rising_part.py").write_text(RISING.format(factor=5))
    with pytest.raises(ComponentError, match=r"rising_part.py has changed since rising_part:Rising was described"):
        PythonInstance("c", "rising_part:Rising", CS, description)
