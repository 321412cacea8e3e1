"""Fits: likelihoods against their definition, and known parameters found again with the confidence that is stated.

Statistical tests have fixed seeds. Each would fail for a perfect fit with probability `FALSE_ALARM` at most.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from network.fitting import delays as delay_fits
from network.fitting.delays import NAMES, correlation, fit_delays
from network.fitting.losses import _gilbert, _Runs, fit_losses, wilson
from network.impairments.distributions import Name, Quantile
from network.messages import NEVER
from network.netem import Netem
from network.profile import Profile
from tests.network.test_impairments import _setting

FALSE_ALARM = 1e-6
MS = 1_000_000


def sent(written: dict[str, Any], edges: int, ticks: int) -> np.ndarray:
    """(edges, ticks) delays in nanoseconds, `NEVER` where lost."""
    channel = Profile.open(Netem.model_validate(written), _setting(edges))
    return np.array([channel.transmit(tick).delay_ns for tick in range(ticks)]).T


def assert_covers(inside: list[bool]) -> None:
    """95 % intervals contain the truth that often; a few per cent less where they are approximate."""
    assert stats.binomtest(sum(inside), len(inside), 0.92, alternative="less").pvalue > FALSE_ALARM


# --- losses ----------------------------------------------------------------------------------------------------------
def _forward(lost: list[bool], p: float, r: float, bad: float, good: float) -> float:
    """The probability of a log, state by state."""
    share = {False: r / (p + r), True: p / (p + r)}
    for is_lost in lost:
        step = {False: share[False] * (1 - p) + share[True] * r, True: share[False] * p + share[True] * (1 - r)}
        share = {s: step[s] * ((bad if s else good) if is_lost else 1 - (bad if s else good)) for s in step}
    return sum(share.values())


shares = st.floats(0.01, 0.99)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.booleans(), min_size=1, max_size=60), shares, shares, shares, shares)
def test_the_likelihood_is_that_of_the_forward_algorithm(
    lost: list[bool], p: float, r: float, bad: float, good: float
) -> None:
    cost = _Runs.of(np.array(lost)).cost(p, r, bad, good)
    assert cost == pytest.approx(-math.log(_forward(lost, p, r, bad, good)), rel=1e-9, abs=1e-12)


def test_a_long_log_does_not_underflow() -> None:
    lost = np.arange(300_000) % 100 < 3
    assert np.isfinite(_Runs.of(lost).cost(0.01, 0.3, 0.9, 0.001))


def test_the_visible_chain_is_found_again_with_the_stated_confidence() -> None:
    inside = []
    for delays in sent({"loss": {"gemodel": {"p": 0.02, "r": 0.2}}}, 60, 4000):
        lost = delays == NEVER
        fit = _gilbert(lost, _Runs.of(lost))
        assert fit is not None
        inside += [fit.intervals[key][0] <= value <= fit.intervals[key][1] for key, value in (("p", 0.02), ("r", 0.2))]
    assert_covers(inside)


def test_a_hidden_chain_is_found_again_with_the_stated_confidence() -> None:
    truth = {"p": 0.02, "r": 0.2, "1-h": 0.7}
    inside = []
    for delays in sent({"loss": {"gemodel": truth}}, 6, 4000):
        best = fit_losses(delays == NEVER)[0]
        assert best.name == "gemodel p r 1-h"
        inside += [best.intervals[name][0] <= value <= best.intervals[name][1] for name, value in truth.items()]
    assert_covers(inside)


@pytest.mark.parametrize(("loss", "name"), [({"random": 0.05}, "random"), ({"gemodel": [0.02, 0.2]}, "gemodel p r")])
def test_the_smallest_model_that_will_do_is_chosen(loss: dict[str, Any], name: str) -> None:
    (delays,) = sent({"loss": loss}, 1, 4000)
    assert fit_losses(delays == NEVER)[0].name == name


def test_four_parameters_are_found_again() -> None:
    truth = {"p": 0.01, "r": 0.1, "1-h": 0.6, "1-k": 0.01}
    (delays,) = sent({"loss": {"gemodel": truth}}, 1, 40_000)
    best = fit_losses(delays == NEVER)[0]
    assert best.name == "gemodel p r 1-h 1-k"
    for name, value in truth.items():
        low, high = best.intervals[name]
        assert low - (high - low) < value < high + (high - low)


def test_a_larger_model_is_never_less_likely() -> None:
    (delays,) = sent({"loss": {"gemodel": {"p": 0.05, "r": 0.3, "1-h": 0.8}}}, 1, 3000)
    by_size = sorted(fit_losses(delays == NEVER), key=lambda fit: len(fit.values))
    likelihoods = [fit.log_likelihood for fit in by_size]
    assert all(later > earlier - 1e-3 for earlier, later in itertools.pairwise(likelihoods))


def test_what_has_no_losses_or_nothing_else_is_refused() -> None:
    for lost in (np.zeros(30, np.bool_), np.ones(30, np.bool_)):
        with pytest.raises(ValueError, match="some messages must be lost"):
            fit_losses(lost)


def test_wilson_s_interval_is_scipy_s() -> None:
    for successes, n in ((0, 10), (3, 50), (49, 50)):
        expected = stats.binomtest(successes, n).proportion_ci(method="wilson")
        assert wilson(successes, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


# --- delays ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", NAMES)
def test_distribution_functions_invert_the_quantile_functions(name: Name) -> None:
    u = np.linspace(0.001, 0.98, 500)
    quantiles = Quantile(name, 40 * MS, 9 * MS)(u) / 1e9
    assert np.abs(delay_fits._CDFS[name](quantiles, 0.04, 0.009) - u).max() < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_a_distribution_is_recognised(name: Name) -> None:
    (delays,) = sent({"delay": {"time": "40 ms", "jitter": "8 ms", "distribution": name}}, 1, 3000)
    best = fit_delays(delays / 1e9)[0]
    assert best.name == name
    assert best.time == pytest.approx(0.040, rel=0.02)
    assert best.jitter == pytest.approx(0.008, rel=0.06)


@pytest.mark.parametrize("name", ["normal", "lognormal", "gamma"])
def test_delays_are_found_again_with_the_stated_confidence(name: Name) -> None:
    inside = []
    for delays in sent({"delay": {"time": "40 ms", "jitter": "8 ms", "distribution": name}}, 15, 400):
        fit = next(one for one in fit_delays(delays / 1e9) if one.name == name)
        inside += [abs(fit.time - 0.040) < fit.time_error, abs(fit.jitter - 0.008) < fit.jitter_error]
    assert_covers(inside)


def test_delays_that_were_rounded_are_found_again() -> None:
    (delays,) = sent({"delay": {"time": "3 ms", "jitter": "1 ms", "distribution": "gamma"}}, 1, 2000)
    best = fit_delays(np.rint(delays / 1e5) / 1e4)[0]  # to 0.1 ms
    assert best.name == "gamma"
    assert abs(best.time - 0.003) < 2 * best.time_error


def test_one_delay_is_fixed_and_few_are_refused() -> None:
    (fixed,) = fit_delays(np.full(30, 0.02))
    assert (fixed.name, fixed.time, fixed.cdf(np.array((0.01, 0.03))).tolist()) == (None, 0.02, [0.0, 1.0])
    for delays in (np.array([0.1]), np.array([0.0, 0.1])):
        with pytest.raises(ValueError, match="more than 0"):
            fit_delays(delays)


@pytest.mark.parametrize("c", [0.0, 0.6])
def test_the_correlation_of_delays_is_found_again(c: float) -> None:
    delay = {"time": "40 ms", "jitter": "8 ms", "distribution": "gamma", "correlation": c}
    (delays,) = sent({"delay": delay}, 1, 5000)
    assert correlation(fit_delays(delays / 1e9)[0], delays / 1e9) == pytest.approx(c, abs=0.05)
