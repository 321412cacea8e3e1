"""The same calls give the same bits in FMI 2.0 and 3.0, in either interface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.fmus.driver import CS, ME, Driver, Floats
from tests.fmus.inputs import START, T, messages, own, play, record
from tests.fmus.theory import runge_kutta

OpenFmu = Callable[[str, str], Driver]
CONTROLLERS = pytest.mark.parametrize("model", ["ArmSyncController", "AxisSyncController"])


def arm(fmu: Driver) -> Floats:
    fmu.initialize(p=[0.4, -0.7], v=[0.3, 0.6], u=[3.0, 0.5], m2=1.3)
    rows = []
    for k in range(20):
        fmu.set(u=[3.0, 0.1 * k])
        if fmu.interface == CS:
            fmu.step(0.03)
        else:
            fmu.integrate(0.03 * (k + 1), runge_kutta(0.005))
        rows.append(np.concatenate([fmu.get(name) for name in ("p", "v", "der(v)", "time")]))
    return np.array(rows)


def controller_exchange(fmu: Driver) -> Floats:
    fmu.initialize(**START)
    rows = []
    for tick in range(15):
        p, v = own(fmu.time)
        fmu.event(p=p, v=v, **messages(tick))
        fmu.integrate((tick + 0.37) * T, runge_kutta(0.01))
        fmu.event(weight=[0.2, 0.3, 0.5])
        fmu.integrate((tick + 1) * T, runge_kutta(0.01))
        rows.append(record(fmu))
    return np.array(rows)


@pytest.mark.parametrize("interface", [ME, CS])
@pytest.mark.parametrize("n_axes", [1, 3])
@pytest.mark.parametrize("model", ["DoubleIntegrator", "MassSpringDamper", "Pendulum"])
def test_plants_on_axes(open_fmu: OpenFmu, model: str, n_axes: int, interface: str) -> None:
    """FMI 2.0 has four axes, of which it uses some."""

    def rows(fmu: Driver) -> Floats:
        fmu.initialize(n_axes=n_axes, p=np.arange(n_axes) - 0.7, v=0.3)
        taken = []
        for k in range(20):
            fmu.set(u=np.arange(n_axes) * 0.1 * k)
            if fmu.interface == CS:
                fmu.step(0.03)
            else:
                fmu.integrate(0.03 * (k + 1), runge_kutta(0.005))
            taken.append(np.concatenate([fmu.get(name) for name in ("p", "v", "der(v)", "time")]))
        return np.array(taken)

    second, third = (rows(open_fmu(f"{model}.{version}", interface)) for version in ("fmi2", "fmi3"))
    assert second.shape == (20, 3 * n_axes + 1)
    assert second.tobytes() == third.tobytes()


@pytest.mark.parametrize("interface", [ME, CS])
def test_arm(open_fmu: OpenFmu, interface: str) -> None:
    second, third = (arm(open_fmu(f"TwoLinkArm.{version}", interface)) for version in ("fmi2", "fmi3"))
    assert second.tobytes() == third.tobytes()


@CONTROLLERS
@pytest.mark.parametrize("extrapolation", [1, 2, 3, 4])
def test_controller_in_co_simulation(open_fmu: OpenFmu, model: str, extrapolation: int) -> None:
    second, third = (
        play(open_fmu(f"{model}.{version}", CS).initialize(extrapolation=extrapolation, **START), 0, 15)
        for version in ("fmi2", "fmi3")
    )
    assert second.tobytes() == third.tobytes()
    assert np.ptp(second, axis=0).min() > 0


@CONTROLLERS
def test_controller_in_model_exchange(open_fmu: OpenFmu, model: str) -> None:
    second, third = (controller_exchange(open_fmu(f"{model}.{version}", ME)) for version in ("fmi2", "fmi3"))
    assert second.tobytes() == third.tobytes()
