"""Coupled oscillators, split in two ways, against the whole: orders of convergence, and a stiff coupling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.accuracy.coupled_oscillators import SPLITS, STIFF, Oscillators, build_models, error, simulate


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_models(tmp_path_factory.mktemp("oscillators"))


def test_the_whole_is_newtons_law() -> None:
    """The matrix exponential against the second difference of its own positions, on a fine grid around a tick."""
    pair = Oscillators()
    times = np.array([0.9999, 1.0, 1.0001])
    before, at, after = (pair.solution([t])[0] for t in times)
    velocity, acceleration = (after - before) / 2e-4, (after - 2 * at + before) / 1e-8
    force = pair.k_c * (at[1] - at[0]) + pair.d_c * (velocity[1] - velocity[0])
    own = np.array(pair.k) * at + np.array(pair.d) * velocity
    np.testing.assert_allclose(np.array(pair.m) * acceleration, np.array([force, -force]) - own, atol=1e-5)


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize(
    ("method", "steps_us", "order"),
    [
        ("joint", (5000, 2500), 4),
        ("midpoint", (5000, 2500), 2),
        ("gauss-seidel", (1250, 625), 1),
        ("jacobi", (1250, 625), 1),
    ],
)
def test_order_of_convergence(
    split: str, method: str, steps_us: tuple[float, float], order: int, built: Path, tmp_path: Path
) -> None:
    pair = Oscillators()
    errors = [
        error(simulate(pair, split, method, step, built, tmp_path / f"run{i}", until="5 s"), pair)
        for i, step in enumerate(steps_us)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1 * order)


@pytest.mark.parametrize("split", SPLITS)
def test_stiff_coupling(split: str, built: Path, tmp_path: Path) -> None:
    """At 2.5 ms a force that is held drives the masses apart; midpoint and joint stay with the exact solution."""
    largest = np.abs(STIFF.solution(np.arange(101) * 0.1)).max()
    for method, bound in (("joint", 1e-4), ("midpoint", 0.02)):
        run = simulate(STIFF, split, method, 2500, built, tmp_path / method)
        assert error(run, STIFF) < bound < largest
    for method in ("gauss-seidel", "jacobi"):
        run = simulate(STIFF, split, method, 2500, built, tmp_path / method)
        assert np.abs(run).max() > 10 * largest
