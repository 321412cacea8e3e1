"""Python components that steps are taken back of: all that they hold comes back, whatever it is."""

from __future__ import annotations

import random
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.components.component import Interface
from cosim.components.python import Discard, Input, Output, PythonComponent, PythonInstance, describe_python
from cosim.errors import ComponentError, ConfigError, DiscardedStepError
from tests.components.misbehaving import cosim


class Holder(PythonComponent):
    """Holds all kinds of things, some of them twice."""

    __slots__ = ("slotted",)
    u = Input()
    y = Output(depends_on=(), shape=(2,))
    count = Output(depends_on=(), dtype="Int64")

    def __init__(self) -> None:
        self.past: list[float] = []
        self.same = self.past
        self.noise = random.Random(3)
        self.call = self.add
        self.slotted = {"sum": 0.0}

    def initialise(self, time: float) -> None:
        self.memory = self.y

    def add(self, x: float) -> None:
        self.same.append(x)

    def step(self, time: float, step: float) -> None:
        self.call(self.u * step + self.noise.random())
        self.slotted["sum"] += time
        self.memory[0] = sum(self.past)
        self.y[1] = self.slotted["sum"]
        self.count = len(self.past)
        if len(self.past) == 2:
            self.late = True
        if len(self.past) > 4 and hasattr(self, "late"):
            del self.late
        self.y[1] += hasattr(self, "late")


class Own(Holder):
    """The same, with its own pair of methods."""

    def save(self) -> Any:
        return list(self.past), self.noise.getstate(), dict(self.slotted), hasattr(self, "late")

    def restore(self, saved: Any) -> None:
        self.past[:] = saved[0]
        self.noise.setstate(saved[1])
        self.slotted = dict(saved[2])
        self.__dict__.pop("late", None)
        if saved[3]:
            self.late = True


class Short(PythonComponent):
    """Steps of at most 3 ms; y is the time."""

    y = Output(depends_on=())

    def step(self, time: float, step: float) -> None:
        self.y = time + step
        if step > 0.003:
            raise Discard("too long for me")


class Locked(PythonComponent):
    """Cannot be copied, without knowing."""

    y = Output(depends_on=())

    def initialise(self, time: float) -> None:
        self.key = threading.Lock()

    def step(self, time: float, step: float) -> None:
        self.y = time


class Named(PythonComponent):
    save = Output()


class Half(PythonComponent):
    def save(self) -> int:
        return 0


def opened(cls: type, interface: Interface = Interface.CO_SIMULATION) -> PythonInstance:
    dotted = f"{cls.__module__}:{cls.__qualname__}"
    instance = PythonInstance("part", dotted, interface, describe_python(dotted))
    instance.enter_initialization(0.0, 10.0)
    instance.exit_initialization()
    return instance


def drive(instance: PythonInstance, time: float, course: list[float]) -> list[bytes]:
    """What comes out at every step."""
    variables, seen = instance.description.variables, []
    for u in course:
        instance.set(variables["u"], np.array([u]))
        instance.step(time, 0.01)
        time += 0.01
        seen.append(b"".join(instance.get(variables[name]).tobytes() for name in ("y", "count")))
    return seen


courses = st.lists(st.floats(-10, 10), max_size=4)


@pytest.mark.parametrize("cls", [Holder, Own])
@pytest.mark.parametrize("through_bytes", [False, True])
@settings(deadline=None, max_examples=25)
@given(before=courses, taken_back=courses, after=courses)
def test_what_is_taken_back_leaves_no_trace(
    cls: type, before: list[float], taken_back: list[float], after: list[float], *, through_bytes: bool
) -> None:
    one, twin = opened(cls), opened(cls)
    assert drive(one, 0.0, before) == drive(twin, 0.0, before)
    saved, time = one.save(), 0.01 * len(before)
    expected = drive(twin, time, after)
    for _ in range(2):
        drive(one, time, taken_back)
        one.restore(one.from_bytes(one.to_bytes(saved)) if through_bytes else saved)
        assert drive(one, time, after) == expected
    other = opened(cls)
    other.restore(other.from_bytes(one.to_bytes(saved)))
    assert drive(other, time, after) == expected


# --- steps that are discarded -----------------------------------------------------------------------------------------
def test_a_discarded_step_is_made_in_halves() -> None:
    part = opened(Short)
    part.step_in_halves(0.0, 0.01, 2)
    assert part.get(part.description.variables["y"])[0] == pytest.approx(0.01)
    with pytest.raises(DiscardedStepError, match="discarded the step: too long for me; it is the shortest step that"):
        part.step_in_halves(0.01, 0.01, 1)


SCENARIO = """\
period: 100 ms
duration: 500 ms
agents:
  1:
    components:
      part: {{python: "tests.components.test_python_saving:{cls}"}}
coupling: {{method: gauss-seidel, {coupling}}}
"""


@pytest.mark.parametrize("coupling", ["step: 10 ms, retries: 2", "tolerance: 1e-3"])
def test_a_run_with_steps_that_are_discarded(tmp_path: Path, coupling: str) -> None:
    done = cosim(tmp_path, "run", "net.yaml", "--no-report", text=SCENARIO.format(cls="Short", coupling=coupling))
    assert done.returncode == 0, done.stderr


def test_without_retries_a_discarded_step_ends_the_run(tmp_path: Path) -> None:
    done = cosim(tmp_path, "run", "net.yaml", "--no-report", text=SCENARIO.format(cls="Short", coupling="step: 10 ms"))
    assert done.returncode == 3
    assert "agent 1, component part, at t = 0 s: discarded the step: too long for me; `--set coupling.re" in done.stderr
    again = cosim(tmp_path, "run", "net.yaml", "--no-report", "--set", "coupling.retries=6")
    assert again.returncode == 0, again.stderr


# --- what cannot be saved ---------------------------------------------------------------------------------------------
def test_an_attribute_that_cannot_be_copied_is_named(tmp_path: Path) -> None:
    done = cosim(tmp_path, "run", "net.yaml", "--no-report", text=SCENARIO.format(cls="Locked", coupling="retries: 1"))
    assert done.returncode == 3
    assert (
        "component part, at t = 0 s: its state cannot be saved: TypeError: its attribute 'key' cannot be copied "
        "(cannot pickle '_thread.lock' object); implement save and restore, or write save = None"
    ) in done.stderr


def test_a_class_may_say_that_it_cannot(tmp_path: Path) -> None:
    text = SCENARIO.format(cls="Named", coupling="retries: 1").replace(
        "tests.components.test_python_saving:Named", "tests.accuracy.hand:Device"
    )
    done = cosim(tmp_path, "check", "net.yaml", text=text)
    assert done.returncode == 2
    assert "'retries' takes components that can save their state, and 'part' cannot" in done.stderr
    assert "a Python class: save = None" in done.stderr


@pytest.mark.parametrize(
    ("cls", "sentence"),
    [
        (Named, "declares a variable 'save', which is the name of a method"),
        (Half, "implements one of save and restore"),
    ],
)
def test_mistakes_of_the_author(cls: type, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        describe_python(f"{__name__}:{cls.__name__}")


def test_other_failures_are_not_tried_again() -> None:
    part = opened(Locked)
    with pytest.raises(ComponentError, match="its state cannot be saved"):
        part.step_in_halves(0.0, 0.01, 3)
