"""Algebraic loops: what Newton's method finds, and agents whose outputs feed each other directly."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.agents.algebraic import Solver, UnsolvedError
from cosim.components.component import Floats
from cosim.components.python import Input, Output, Parameter, PythonComponent, State
from cosim.plan import Loop
from tests.components.probe import probe_library, probes
from tests.distributed.networks import in_process, planned

__all__ = ["probe_library", "probes"]


class Store(PythonComponent):
    """x' = -y, and y = x + gain z feeds through."""

    gain = Parameter(0.5)
    z = Input()
    x = State(1.0)
    y = Output(depends_on=("z",))

    def outputs(self, time: float) -> None:
        self.y = self.x + self.gain * self.z

    def derivatives(self, time: float) -> Mapping[str, Any]:
        return {"x": -self.y}


class Curve(PythonComponent):
    """z = u + bend u^2."""

    slope = Parameter(0.6)
    bend = Parameter(0.0)
    u = Input()
    z = Output(depends_on=("u",))

    def outputs(self, time: float) -> None:
        self.z = self.slope * self.u + self.bend * self.u * self.u


class Held(PythonComponent):
    """y = gain u + offset, and x keeps what u was at the start."""

    gain = Parameter(1.0)
    offset = Parameter(0.0)
    u = Input()
    x = State(0.0)
    y = Output(depends_on=("u",))

    def initialise(self, time: float) -> None:
        self.x = self.u

    def outputs(self, time: float) -> None:
        self.y = self.gain * self.u + self.offset

    def derivatives(self, time: float) -> Mapping[str, Any]:
        return {"x": 0.0}

    def step(self, time: float, step: float) -> None: ...


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """pytest imports this file under a name of its own."""
    monkeypatch.setitem(sys.modules, "algebraic_agent", sys.modules[Store.__module__])


def scenario(gain: float = 0.5, bend: float = 0.0, integrator: str = "rk4") -> str:
    return f"""\
period: 100 ms
duration: 1 s
agents:
  1:
    components:
      store: {{python: "algebraic_agent:Store", start: {{gain: {gain}}}}}
      curve: {{python: "algebraic_agent:Curve", start: {{bend: {bend}}}}}
    connections: [store.y -> curve.u, curve.z -> store.z]
    record: [store.x, curve.u]
coupling: {{method: joint, step: 5 ms, integrator: {integrator}}}
"""


# --- the solver -------------------------------------------------------------------------------------------------------
numbers = st.floats(-10, 10, allow_nan=False).map(lambda x: round(x, 3))


@given(data=st.data(), n=st.integers(1, 6))
def test_linear_loops_of_any_size(data: st.DataObject, n: int) -> None:
    matrix = np.array(data.draw(st.lists(numbers, min_size=n * n, max_size=n * n))).reshape(n, n)
    offset = np.array(data.draw(st.lists(numbers, min_size=n, max_size=n)))
    if np.linalg.cond(matrix - np.eye(n)) > 1e4:
        return
    y = Solver(n).solve(lambda y: matrix @ y + offset, np.zeros(n))
    assert np.allclose(y, np.linalg.solve(np.eye(n) - matrix, offset), rtol=1e-8, atol=1e-10)


def test_a_loop_that_no_iteration_of_its_own_would_settle() -> None:
    """y = cos(4 y): the iteration y <- G(y) does not converge, its slope is about -3.6."""
    (y,) = Solver(1).solve(lambda y: np.cos(4.0 * y), np.array([0.3]))
    assert abs(y - math.cos(4.0 * y)) < 1e-13


@given(scale=st.sampled_from([1e-12, 1e-9, 1e-3, 1.0, 1e9]), gain=st.floats(-100.0, 0.99), others=st.booleans())
def test_the_size_of_the_values_does_not_matter(scale: float, gain: float, others: bool) -> None:
    """y = gain y + scale, alone or by way of z = y / scale, which is of another size."""
    exact = scale / (1.0 - gain)
    if others:
        y, z = Solver(2).solve(lambda y: np.array([gain * scale * y[1] + scale, y[0] / scale]), np.zeros(2))
        assert z == pytest.approx(exact / scale, rel=1e-9)
    else:
        (y,) = Solver(1).solve(lambda y: gain * y + scale, np.zeros(1))
    assert y == pytest.approx(exact, rel=1e-9)


def test_a_current_of_nanoamperes() -> None:
    """A diode behind 100 MOhm at 0.1 V: by bisection 9.2e-10 A or so."""

    def current(y: Floats) -> Floats:
        diode: Floats = 1e-9 * (np.exp((0.1 - 1e8 * y) / 0.025) - 1.0)
        return diode

    low, high = 0.0, 1e-9
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if current(np.array([middle]))[0] > middle else (low, middle)
    (y,) = Solver(1).solve(current, np.zeros(1))
    assert y == pytest.approx(low, rel=1e-9)


def test_a_start_beside_the_solution_is_not_good_enough() -> None:
    """Where y = (1 - 1e-6) y + 1e-6, a small G(y) - y says little of how far y is off."""
    (y,) = Solver(1).solve(lambda y: (1.0 - 1e-6) * y + 1e-6, np.array([1.0001]))
    assert y == pytest.approx(1.0, abs=1e-8)


def test_a_solution_is_its_own() -> None:
    """Solved again from there, the bits stay: else an event iteration would never settle."""
    solver = Solver(1)
    (y,) = solver.solve(lambda y: np.cos(4.0 * y), np.array([0.3]))
    assert solver.solve(lambda y: np.cos(4.0 * y), np.array([y])).tolist() == [y]


def test_values_that_pass_zero() -> None:
    """y = 0.5 y + s, where s is a difference of larger numbers that rounding leaves its traces in."""
    solver, y = Solver(1), np.zeros(1)
    for s in np.linspace(1.0, -1.0, 41) ** 3:
        y = solver.solve(lambda y, s=s: 0.5 * y + ((7.0 + s) - 7.0), y)
        assert y[0] == pytest.approx(2.0 * s, abs=1e-14)


@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        (lambda y: y + 1.0, "has no solution, or more than one"),
        (lambda y: y * y + 1.0 + y, "is not solved after 20 iterations"),
    ],
)
def test_what_has_no_solution(outputs: Any, said: str) -> None:
    with pytest.raises(UnsolvedError, match=said):
        Solver(1).solve(outputs, np.array([0.7]))


# --- agents -----------------------------------------------------------------------------------------------------------
def rows(text: str) -> Floats:
    record, error = in_process(planned(text))
    assert error is None
    return np.array([np.frombuffer(row) for _, row in record.ticks])


@pytest.mark.parametrize("gain", [0.5, -0.9, -2.0, 0.0173, 30.1, -169.3])
@pytest.mark.parametrize("integrator", ["rk4", "dormand-prince"])
def test_a_linear_loop_around_a_state(integrator: str, gain: float) -> None:
    """y = x + gain (0.6 y), so y = x / c and x = exp(-t / c) with c = 1 - 0.6 gain."""
    found = rows(scenario(gain, integrator=integrator))
    c = 1.0 - 0.6 * gain
    exact = np.exp(-np.linspace(0.0, 1.0, 11) / c)
    assert np.abs(found[:, 0] - exact).max() < 1e-8
    assert np.abs(found[:, 1] - exact / c).max() < 1e-8


def test_a_loop_that_is_not_linear() -> None:
    """y = x + 0.5 (0.6 y + 0.2 y^2)."""
    found = rows(scenario(bend=0.2))
    x, y = found.T
    assert np.abs(y - (x + 0.3 * y + 0.1 * y * y)).max() < 1e-12


def test_it_is_named_in_a_warning_and_runs_in_python() -> None:
    plan = planned(scenario())
    assert plan.agents[0].coupling.loop is Loop.PYTHON
    assert "loop: python" in plan.scenario


@pytest.mark.parametrize(("method", "gain"), [("joint", 0.5), ("joint", -2.0), ("midpoint", 0.5), ("midpoint", -0.9)])
def test_a_loop_at_the_start(method: str, gain: float) -> None:
    """What is read in Initialization Mode, where a start value takes it, solves the loop already: y = gain y + 1."""
    text = f"""\
period: 100 ms
duration: 100 ms
agents:
  1:
    components:
      one: {{python: "algebraic_agent:Held", start: {{gain: {gain}, offset: 1.0}}}}
      two: {{python: "algebraic_agent:Held"}}
    connections: [one.y -> two.u, two.y -> one.u]
    record: [one.x, two.x, one.y]
coupling: {{method: {method}}}
"""
    assert rows(text)[0] == pytest.approx([1.0 / (1.0 - gain)] * 3, rel=1e-9)


def test_one_without_a_solution_is_named() -> None:
    _, error = in_process(planned(scenario(gain=1.0 / 0.6)))
    assert str(error) == (
        "agent 1, component store, at t = 0 s: at the start, the outputs store.y, curve.z depend on each other, and "
        "that has no solution, or more than one"
    )


def test_one_that_loses_its_solution_is_named() -> None:
    """y = x + 3 y + 5 bend y^2, of which x grows: from x = 1 / (5 bend) on there is none."""
    _, error = in_process(planned(scenario(gain=5.0, bend=0.16)))
    assert "agent 1, component store, at t = 0." in str(error)
    assert "the algebraic loop store.y -> curve.z -> store.y " in str(error)


def test_fmus_in_a_circle(probes: dict[int, Path]) -> None:
    """Every probe gives what it gets: any value would do, and 0 is where it begins."""
    text = f"""\
period: 100 ms
duration: 300 ms
agents:
  1:
    components: {{one: {{fmu: {probes[3]}}}, two: {{fmu: {probes[2]}}}}}
    connections: [one.vector_out -> two.vector_in, two.vector_out -> one.vector_in]
    record: [one.x, two.x]
coupling: {{method: joint}}
"""
    found = rows(text)
    assert np.all(np.isfinite(found))
    assert found[:, 0].tolist() == found[:, 1].tolist()
