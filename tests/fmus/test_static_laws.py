"""The controllers without states against their formulas, in both versions and interfaces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.fmus.driver import CS, ME, Driver

OpenFmu = Callable[[str, str], Driver]
KINDS = pytest.mark.parametrize(
    ("version", "interface"), [(version, interface) for version in ("fmi2", "fmi3") for interface in (ME, CS)]
)


def apply(fmu: Driver, **inputs: object) -> None:
    """New inputs at the present time, and a step of no importance in Co-Simulation."""
    if fmu.interface == ME:
        fmu.event(**inputs)
    else:
        fmu.set(**inputs)
        fmu.step(0.1)


@KINDS
def test_consensus_of_three_axes(open_fmu: OpenFmu, version: str, interface: str) -> None:
    """Rows of three numbers in arrays of four columns; the second neighbour has not been heard."""
    rng = np.random.default_rng(1)
    fmu = open_fmu(f"ConsensusController.{version}", interface)
    fmu.initialize(n_axes=3, n_neighbours=3, k_p=1.5, k_v=0.7, k_d=0.2, weight=[0.5, 2.0, 0.25])
    for _ in range(5):
        p, v, their_p, their_v = (
            rng.normal(size=3),
            rng.normal(size=3),
            rng.normal(size=(3, 3)),
            rng.normal(size=(3, 3)),
        )
        apply(fmu, p=p, v=v, neighbour_p=their_p, neighbour_v=their_v, neighbour_stamp=[4, -1, 0])
        pull = 1.5 * (their_p - p) + 0.7 * (their_v - v)
        np.testing.assert_allclose(fmu.get("u"), 0.5 * pull[0] + 0.25 * pull[2] - 0.2 * v, rtol=1e-13, atol=1e-13)


@KINDS
def test_consensus_alone_only_damps(open_fmu: OpenFmu, version: str, interface: str) -> None:
    fmu = open_fmu(f"ConsensusController.{version}", interface).initialize(n_neighbours=0, k_d=0.5)
    apply(fmu, p=[1.0, 2.0], v=[3.0, -4.0])
    np.testing.assert_array_equal(fmu.get("u"), [-1.5, 2.0])


@KINDS
def test_proportional_and_derivative(open_fmu: OpenFmu, version: str, interface: str) -> None:
    rng = np.random.default_rng(2)
    k_p, k_d = rng.uniform(0, 5, 3), rng.uniform(0, 5, 3)
    fmu = open_fmu(f"PDController.{version}", interface).initialize(n_axes=3, k_p=k_p, k_d=k_d)
    for _ in range(5):
        p, v, p_ref, v_ref, u_ref = rng.normal(size=(5, 3))
        apply(fmu, p=p, v=v, p_ref=p_ref, v_ref=v_ref, u_ref=u_ref)
        np.testing.assert_allclose(fmu.get("u"), u_ref + k_p * (p_ref - p) + k_d * (v_ref - v), rtol=1e-13, atol=1e-13)
