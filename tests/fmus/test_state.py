"""Saving, restoring and serializing the FMU's state; instances that know nothing of each other."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fmpy import extract
from fmpy.fmi1 import FMICallException

from tests.fmus.driver import CS, ME, Driver
from tests.fmus.inputs import START, T, messages, own, play, record
from tests.fmus.theory import runge_kutta

OpenFmu = Callable[[str, str], Driver]
CONTROLLERS = pytest.mark.parametrize("model", ["ArmSyncController", "AxisSyncController"])
VERSIONS = pytest.mark.parametrize("version", ["fmi2", "fmi3"])


@VERSIONS
@CONTROLLERS
@pytest.mark.parametrize("extrapolation", [1, 2, 3, 4])
def test_round_trip_reproduces_bits(open_fmu: OpenFmu, model: str, version: str, extrapolation: int) -> None:
    fmu = open_fmu(f"{model}.{version}", CS).initialize(extrapolation=extrapolation, **START)
    play(fmu, 0, 10)
    saved, time = fmu.save(), fmu.time
    first = play(fmu, 10, 20)
    fmu.restore(saved)
    fmu.time = time
    assert fmu.save() == saved
    assert play(fmu, 10, 20).tobytes() == first.tobytes()


@VERSIONS
@CONTROLLERS
def test_state_moves_to_another_instance(open_fmu: OpenFmu, model: str, version: str) -> None:
    """Bytes written by one instance continue in another, mode and array sizes included."""
    fmu = open_fmu(f"{model}.{version}", CS).initialize(extrapolation=2, **START)
    play(fmu, 0, 10)
    other = open_fmu(f"{model}.{version}", CS)
    other.restore(fmu.save())
    other.sizes, other.time = dict(fmu.sizes), fmu.time
    assert play(other, 10, 15).tobytes() == play(fmu, 10, 15).tobytes()


@VERSIONS
def test_model_exchange_round_trip(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", ME).initialize(extrapolation=3, **START)

    def run() -> bytes:
        rows = []
        for tick in range(5):
            p, v = own(fmu.time)
            fmu.event(p=p, v=v, **messages(tick))
            fmu.integrate((tick + 1) * T, runge_kutta(0.02))
            rows.append(record(fmu))
        return np.array(rows).tobytes()

    saved = fmu.save()
    first = run()
    fmu.restore(saved)
    fmu.time, fmu.next_event = 0.0, T
    assert run() == first


@VERSIONS
def test_reset_starts_over(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", CS).initialize(**START)
    first = play(fmu, 0, 5)
    fmu.fmu.reset()
    fmu.sizes["n_neighbours"] = 1
    assert fmu.get("T") == 0.1
    np.testing.assert_array_equal(fmu.get("weight"), [1.0])
    assert play(fmu.initialize(**START), 0, 5).tobytes() == first.tobytes()


@VERSIONS
def test_instances_of_one_library_are_independent(built: dict[str, Path], version: str) -> None:
    path = built[f"ArmSyncController.{version}"]
    unpacked = Path(extract(str(path)))
    alone, first, second = (Driver(path, CS, unpacked).instantiate() for _ in range(3))
    try:
        alone.initialize(**START)
        first.initialize(**START)
        second.initialize(**{**START, "k_e": 3.0, "n_neighbours": 1, "weight": 1.0})
        expected = play(alone, 0, 5)
        rows = []
        for tick in range(5):
            rows.append(play(first, tick, tick + 1))
            second.step_to((tick + 1) * T)
        assert np.vstack(rows).tobytes() == expected.tobytes()
    finally:
        for driver in (alone, first, second):
            driver.close()
        shutil.rmtree(unpacked)


@VERSIONS
def test_foreign_bytes_are_refused(open_fmu: OpenFmu, version: str) -> None:
    fmu = open_fmu(f"ArmSyncController.{version}", CS).initialize(**START)
    data = fmu.save()
    arm = open_fmu(f"TwoLinkArm.{version}", CS).initialize().save()
    for wrong in (b"", data[:-1], data + b"\0", arm, data[:100], data[:32] + b"\xff" * 40 + data[72:]):
        fmu.log.clear()
        with pytest.raises(FMICallException):
            fmu.restore(wrong)
        assert fmu.log == [f"these {len(wrong)} bytes are not a serialized state of this FMU"]
    fmu.restore(data)


def test_history_does_not_grow_without_bound(open_fmu: OpenFmu) -> None:
    """What is kept reaches back to the oldest stamp in use, not to the start."""
    fmu = open_fmu("ArmSyncController.fmi3", CS).initialize(extrapolation=3, solver_step=0.1, **START)
    sizes = []
    for tick in range(1000):
        fmu.set(**messages(tick))
        fmu.step_to((tick + 1) * T)
        sizes.append(len(fmu.save()))
    assert max(sizes[500:]) == max(sizes[:500])


def test_resizing_keeps_what_it_does_not_resize(open_fmu: OpenFmu) -> None:
    """Structural parameters are set one after the other, with start values between them."""
    fmu = open_fmu("AxisSyncController.fmi3", CS)
    fmu.resize("n_axes", 3)
    fmu.set(p=[1.0, 2.0, 3.0], theta_hat_start=0.5, weight=[7.0])
    fmu.resize("n_neighbours", 2)
    np.testing.assert_array_equal(fmu.get("p"), [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(fmu.get("theta_hat_start"), np.full(15, 0.5))
    np.testing.assert_array_equal(fmu.get("weight"), [1.0, 1.0])
    fmu.resize("n_axes", 2)
    np.testing.assert_array_equal(fmu.get("p"), [0.0, 0.0])
