"""The gain condition as the paper publishes it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.theory import mu, published_bound


@given(st.floats(0.01, 100), st.floats(0.01, 100))
def test_mu_is_the_slowest_root(k_eta: float, lambda_: float) -> None:
    assert mu(k_eta, lambda_) == pytest.approx(-np.roots([1, k_eta, lambda_]).real.max(), rel=1e-6)


def test_mu_without_cancellation() -> None:
    assert mu(1e8, 1.0) == pytest.approx(1e-8, rel=1e-12)


def test_gains_of_section_5() -> None:
    """λ = 13 and k_η = 2 √λ give μ = √13, just enough for h* = 1.3 s."""
    value = mu(2 * math.sqrt(13), 13)
    assert value == pytest.approx(math.sqrt(13))
    assert published_bound(value) - 1.3 == pytest.approx(0.003, abs=3e-4)
