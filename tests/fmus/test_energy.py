"""Without friction and drive the plants conserve their energy, whatever their parameters and start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fmus.driver import CS, Driver, Floats
from tests.fmus.theory import energy
from tests.reference.arm import Arm

Pair = tuple[float, float]
positive = st.floats(0.2, 3.0)
length = st.floats(0.1, 1.0)
pair = st.tuples(st.floats(-3, 3), st.floats(-3, 3))


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    arm=st.builds(Arm, m1=positive, m2=positive, l1=length, l2=length, lc1=length, lc2=length, I1=length, I2=length),
    p=pair,
    v=pair,
)
def test_of_the_arm(open_fmu: Callable[[str, str], Driver], arm: Arm, p: Pair, v: Pair) -> None:
    fmu = open_fmu("TwoLinkArm.fmi3", CS)
    fmu.initialize(p=p, v=v, solver_step=0.0005, **vars(arm))
    before = energy(arm, np.array(p), np.array(v))
    largest = before + 9.81 * (arm.theta[3] + arm.theta[4])  # above the lowest position: the scale of the motion
    for _ in range(10):
        fmu.step(0.1)
        assert abs(energy(arm, fmu.get("p"), fmu.get("v")) - before) <= 1e-7 * largest


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(m=st.tuples(positive, positive), k=st.tuples(positive, positive), p=pair, v=pair)
def test_of_masses_on_springs(open_fmu: Callable[[str, str], Driver], m: Pair, k: Pair, p: Pair, v: Pair) -> None:
    fmu = open_fmu("MassSpringDamper.fmi3", CS)
    fmu.initialize(m=m, k=k, d=0.0, p=p, v=v, solver_step=0.001)
    assert_kept(fmu, lambda p, v: np.array(m) * v**2 / 2 + np.array(k) * p**2 / 2)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(m=st.tuples(positive, positive), rods=st.tuples(length, length), p=pair, v=pair)
def test_of_pendulums(open_fmu: Callable[[str, str], Driver], m: Pair, rods: Pair, p: Pair, v: Pair) -> None:
    fmu = open_fmu("Pendulum.fmi3", CS)
    fmu.initialize(m=m, l=rods, d=0.0, p=p, v=v, solver_step=0.001)
    M, L = np.array(m), np.array(rods)
    assert_kept(fmu, lambda p, v: M * (L * v) ** 2 / 2 + M * 9.81 * L * (1 - np.cos(p)))


def assert_kept(fmu: Driver, energy_of: Callable[[Floats, Floats], Floats]) -> None:
    """Axis by axis, over a second."""
    before = energy_of(fmu.get("p"), fmu.get("v"))
    for _ in range(10):
        fmu.step(0.1)
        np.testing.assert_allclose(energy_of(fmu.get("p"), fmu.get("v")), before, rtol=1e-7, atol=1e-12)
