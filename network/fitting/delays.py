"""The distribution of one-way delays that fits a log best, of those that a profile can have.

What is measured is rounded: to a tenth of a millisecond by `ping`, say. So a value stands for an interval, and its
likelihood is the probability of that; which also holds for the points at which `pareto` is cut off and for the least
delay, `min`, at which all distributions are cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from network.fitting.likelihood import aic, bic, half_widths
from network.impairments import distributions
from network.impairments.distributions import to_normal
from network.messages import Floats

NAMES: tuple[distributions.Name, ...] = ("uniform", "normal", "lognormal", "gamma", "pareto", "paretonormal")
_MOST_VALUES = 20_000
_TINY = 1e-300
_CANCELLED = 1e-13  # differences of distribution functions that small are rounding errors


@dataclass(frozen=True)
class DelayFit:
    """A distribution with the parameters under which the log is most likely; times in seconds.

    Attributes:
        name: of the distribution; None where all delays are equal.
        time, jitter: as of a profile's `delay`.
        time_error, jitter_error: half of the 95 % confidence interval, NaN where it is not known.
        least: `min`.
        n: messages.
    """

    name: distributions.Name | None
    time: float
    jitter: float
    time_error: float
    jitter_error: float
    least: float
    log_likelihood: float
    n: int

    @property
    def parameters(self) -> int:
        """How many were fitted, `min` not counted."""
        return 1 if self.name is None else 2

    @property
    def aic(self) -> float:
        """Akaike's criterion."""
        return aic(self.log_likelihood, self.parameters)

    @property
    def bic(self) -> float:
        """Schwarz's criterion."""
        return bic(self.log_likelihood, self.parameters, self.n)

    def cdf(self, x: Floats) -> Floats:
        """The share of the delays that are at most `x` seconds, (n,)."""
        if self.name is None:
            return np.asarray(x >= self.time, np.float64)
        return np.where(x < self.least, 0.0, _CDFS[self.name](x, self.time, self.jitter))


def fit_delays(delays: Floats) -> list[DelayFit]:
    """Every distribution fitted, the best by BIC first.

    Args:
        delays: (n,) in seconds, more than 0; at least two.

    Raises:
        ValueError: they are too few, or not positive.
    """
    if len(delays) < 2 or not delays.min() > 0:
        raise ValueError("two delays at least are needed, all of them more than 0")
    least, largest = float(delays.min()), float(delays.max())
    if least == largest:
        return [DelayFit(None, least, 0.0, 0.0, 0.0, least, 0.0, len(delays))]
    data = _Data.of(delays)
    fits = [_uniform_fit(data), *(_fit(name, data) for name in NAMES[1:])]
    return sorted(fits, key=lambda fit: fit.bic)


def correlation(fit: DelayFit, delays: Floats) -> float:
    """That of a delay with the one before, in a profile's terms: of their normal scores. 0 where it is not clear.

    Args:
        fit: the distribution.
        delays: (n,) in seconds, in the order of sending.
    """
    if fit.name is None or len(delays) < 10:
        return 0.0
    scores = to_normal(np.clip(fit.cdf(delays), 1e-12, 1 - 1e-12))
    if scores[:-1].std() == 0 or scores[1:].std() == 0:
        return 0.0
    found = float(np.corrcoef(scores[:-1], scores[1:])[0, 1])
    return found if found > max(0.05, 3 / math.sqrt(len(delays))) else 0.0


@dataclass(frozen=True)
class _Data:
    """Delays by value: (m,) in seconds, how often each occurs, and how finely they were measured."""

    values: Floats
    counts: Floats
    resolution: float
    mean: float
    deviation: float

    @classmethod
    def of(cls, delays: Floats) -> _Data:
        values, counts = np.unique(delays, return_counts=True)
        finest = float(np.diff(values).min())
        resolution = max(finest, float(values[-1] - values[0]) / _MOST_VALUES)
        if resolution > finest:
            values, counts = np.unique(np.rint(delays / resolution), return_counts=True)
            values = values * resolution
        return cls(values, counts.astype(np.float64), resolution, float(delays.mean()), float(delays.std()))

    @property
    def n(self) -> int:
        return int(self.counts.sum())

    def cost(self, cdf: Callable[[Floats], Floats]) -> float:
        """Minus the log-likelihood; what would be less than the least value is that."""
        return -float(self.counts @ np.log(np.maximum(self.probabilities(cdf), _TINY)))

    def probabilities(self, cdf: Callable[[Floats], Floats]) -> Floats:
        """(m,) of the interval for which each value stands."""
        half = self.resolution / 2
        below, up_to = cdf(self.values - half), cdf(self.values + half)
        below[0] = 0.0
        return up_to - below


def _uniform_fit(data: _Data) -> DelayFit:
    """The narrowest range that holds all of them."""
    low, high = float(data.values[0]), float(data.values[-1])
    likelihood = -data.n * math.log((high - low) / data.resolution + 1)
    return DelayFit("uniform", (low + high) / 2, (high - low) / 2, math.nan, math.nan, low, likelihood, data.n)


def _fit(name: distributions.Name, data: _Data) -> DelayFit:
    from scipy.optimize import minimize

    cdf = _CDFS[name]
    least = float(data.values[0])
    unit = data.deviation or data.resolution

    def cost(point: Floats) -> float:
        time, jitter = float(point[0]) * unit, math.exp(min(float(point[1]), 50.0)) * unit
        if time <= 0:
            return math.inf
        return data.cost(lambda x: cdf(x, time, jitter))

    start = (data.mean / unit, math.log(data.deviation / unit))
    if name == "pareto":  # its range ends on both sides: where the data do, or beyond
        jitter = (float(data.values[-1]) - least + data.resolution) / (distributions.CUT + 2 / 3)
        start = ((least + 2 / 3 * jitter) / unit, math.log(jitter / unit))
    found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6})
    time, jitter = float(found.x[0]) * unit, math.exp(float(found.x[1])) * unit
    # The curvature says nothing where the ends of a range decide, or where a value could hardly be.
    known = name != "pareto" and data.probabilities(lambda x: cdf(x, time, jitter)).min() > _CANCELLED
    time_error, jitter_error = (half_widths(cost, found.x) * (unit, jitter)).tolist() if known else (math.nan, math.nan)
    return DelayFit(name, time, jitter, time_error, jitter_error, least, -float(found.fun), data.n)


# --- distribution functions of network.impairments.distributions' quantile functions --------------------------------
def _uniform(x: Floats, time: float, jitter: float) -> Floats:
    return np.clip((x - time + jitter) / (2 * jitter), 0.0, 1.0)


def _normal(x: Floats, time: float, jitter: float) -> Floats:
    from scipy.special import ndtr

    return np.asarray(ndtr((x - time) / jitter), np.float64)


def _lognormal(x: Floats, time: float, jitter: float) -> Floats:
    from scipy.special import ndtr

    variance = math.log1p((jitter / time) ** 2)
    log = np.log(np.maximum(x, _TINY))
    return np.asarray(ndtr((log - math.log(time) + variance / 2) / math.sqrt(variance)), np.float64)


def _gamma(x: Floats, time: float, jitter: float) -> Floats:
    from scipy.special import gammainc

    shape = (time / jitter) ** 2
    return np.asarray(gammainc(shape, np.maximum(x, 0.0) * shape / time), np.float64)


def _pareto(x: Floats, time: float, jitter: float) -> Floats:
    jitters = np.maximum((x - time) / jitter, -2 / 3)
    return np.where(jitters >= distributions.CUT, 1.0, 1 - (0.75 * jitters + 1.5) ** -3.0)


def _paretonormal(x: Floats, time: float, jitter: float) -> Floats:
    u = _normal(np.linspace(-8, 8, 4001), 0.0, 1.0)
    jitters = (distributions.Quantile("paretonormal", 0, 1)(u)).astype(np.float64)
    return np.interp((x - time) / jitter, jitters, u, left=0.0, right=1.0)


_CDFS: dict[distributions.Name, Callable[[Floats, float, float], Floats]] = {
    "uniform": _uniform,
    "normal": _normal,
    "lognormal": _lognormal,
    "gamma": _gamma,
    "pareto": _pareto,
    "paretonormal": _paretonormal,
}
