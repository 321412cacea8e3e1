"""The model of losses that fits a log best: independent losses, or Gilbert-Elliott with two to four parameters.

`random` and `gilbert` (netem's gemodel with p and r alone: every message is lost in the bad state, none in the good
one) need no search: their states can be seen, and the shares of the transitions are the most likely parameters. With
losses in both states the chain is hidden. Its likelihood is that of the forward algorithm, a product of one matrix per
message; runs of equal fates are powers, so that a long log costs no more than its losses do. It is maximised directly,
from several starts, by a quasi-Newton method: the maximum is the one that Baum-Welch creeps towards, and its curvature
gives the confidence of the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from network.fitting.likelihood import CONFIDENCE_SIGMAS, aic, bic, half_widths
from network.messages import Floats, Ints

_EDGE = 1e-6  # probabilities stay so far away from 0 and 1 in the search
_FAR = 14.0  # the same as logit
_CLOSE = 1e-8  # relative, of the log-likelihood
_NAMES = ("p", "r", "1-h", "1-k")


@dataclass(frozen=True)
class LossFit:
    """A model with the parameters under which the log is most likely.

    Attributes:
        name: `random`, or `gemodel` with the names of the parameters that were fitted.
        values: of its parameters by name: `random`, or `p`, `r`, `1-h`, `1-k`.
        intervals: (low, high) of each, with 95 % confidence; NaN where it is not known.
        n: messages.
    """

    name: str
    values: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    log_likelihood: float
    n: int

    @property
    def aic(self) -> float:
        """Akaike's criterion."""
        return aic(self.log_likelihood, len(self.values))

    @property
    def bic(self) -> float:
        """Schwarz's criterion."""
        return bic(self.log_likelihood, len(self.values), self.n)


def fit_losses(lost: NDArray[np.bool_]) -> list[LossFit]:
    """Every model fitted, the best by BIC first.

    Args:
        lost: (n,) whether each message was lost, in the order of sending; some were, some were not.

    Raises:
        ValueError: all, or none, were lost.
    """
    n, losses = len(lost), int(lost.sum())
    if not 0 < losses < n:
        raise ValueError("some messages must be lost, and some arrive")
    rate = losses / n
    likelihood = losses * math.log(rate) + (n - losses) * math.log1p(-rate)
    fits = [LossFit("random", {"random": rate}, {"random": wilson(losses, n)}, likelihood, n)]
    runs = _Runs.of(lost)
    gilbert = _gilbert(lost, runs)
    if gilbert is not None:
        p, r = gilbert.values.values()
        # Beside what the visible chain says: a bad state that is rarer, lasts longer, and does not lose everything.
        three = _hidden(runs, _NAMES[:3], [(p, r, 0.9), (p / 3, r / 3, 0.5)])
        four = _hidden(runs, _NAMES, [(*three.values.values(), 0.3 * rate), (p / 3, r / 3, 0.7, 0.1 * rate)])
        fits += [gilbert, three, four]
    return sorted(fits, key=lambda fit: fit.bic)


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a share."""
    z2 = CONFIDENCE_SIGMAS**2
    share = successes / n
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = CONFIDENCE_SIGMAS * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    return max(0.0, middle - half), min(1.0, middle + half)


def _gilbert(lost: NDArray[np.bool_], runs: _Runs) -> LossFit | None:
    """The shares of the transitions; None where one of the two states is never left."""
    before, after = lost[:-1], lost[1:]
    good, bad = int((~before).sum()), int(before.sum())
    begins, ends = int((~before & after).sum()), int((before & ~after).sum())
    if not begins or not ends:
        return None
    values = {"p": begins / good, "r": ends / bad}
    intervals = {"p": wilson(begins, good), "r": wilson(ends, bad)}
    return LossFit("gemodel p r", values, intervals, -runs.cost(values["p"], values["r"], 1.0, 0.0), len(lost))


def _hidden(runs: _Runs, names: Sequence[str], starts: Sequence[Sequence[float]]) -> LossFit:
    """The maximum over the first of the four parameters, the others having netem's defaults."""
    from scipy.optimize import minimize

    cost = partial(_logit_cost, runs)
    bounds = [(-_FAR, _FAR)] * len(names)
    found = min(
        (minimize(cost, _logit(start), method="L-BFGS-B", bounds=bounds, options={"ftol": _CLOSE}) for start in starts),
        key=lambda result: float(result.fun),
    )
    point = np.asarray(found.x, np.float64)
    half = half_widths(cost, point)
    values = _probability(point).tolist()
    low, high = _probability(point - half).tolist(), _probability(point + half).tolist()
    intervals = dict(zip(names, zip(low, high, strict=True), strict=True))
    fitted = dict(zip(names, values, strict=True))
    if fitted["1-h"] < fitted.get("1-k", 0.0):  # the states' names are ours to give
        for one, other in (("p", "r"), ("1-h", "1-k")):
            fitted[one], fitted[other] = fitted[other], fitted[one]
            intervals[one], intervals[other] = intervals[other], intervals[one]
    return LossFit(f"gemodel {' '.join(names)}", fitted, intervals, -float(found.fun), runs.n)


def _logit_cost(runs: _Runs, point: Floats) -> float:
    p, r, bad, *rest = _probability(point).tolist()
    return runs.cost(p, r, bad, rest[0] if rest else 0.0)


def _logit(values: Sequence[float]) -> Floats:
    clipped = np.clip(np.asarray(values, np.float64), _EDGE, 1 - _EDGE)
    return np.asarray(np.log(clipped / (1 - clipped)), np.float64)


def _probability(point: Floats) -> Floats:
    from scipy.special import expit

    return np.asarray(expit(point), np.float64)


@dataclass(frozen=True)
class _Runs:
    """A log as runs of equal fates.

    Attributes:
        first: whether the first run is one of losses.
        lengths: (m,) of the runs, in turn received and lost, or the other way round.
        kinds: of the even and of the odd runs, the lengths that occur, and which of them each run has.
        n: messages.
    """

    first: bool
    lengths: Ints
    kinds: tuple[tuple[Ints, Ints], tuple[Ints, Ints]]
    n: int

    @classmethod
    def of(cls, lost: NDArray[np.bool_]) -> _Runs:
        changes = np.flatnonzero(lost[1:] != lost[:-1]) + 1
        lengths = np.diff(np.concatenate(([0], changes, [len(lost)])))
        one, other = (np.unique(lengths[offset::2], return_inverse=True) for offset in (0, 1))
        return cls(bool(lost[0]), lengths, (one, other), len(lost))

    def cost(self, p: float, r: float, bad: float, good: float) -> float:
        """Minus the log-likelihood of the Gilbert-Elliott model; the chain begins in its stationary distribution."""
        step = np.array(((1 - p, p), (r, 1 - r)))
        loss = np.array((good, bad))
        matrices = np.empty((len(self.lengths), 2, 2))
        scales = np.empty(len(self.lengths))
        for offset, is_loss in ((0, self.first), (1, not self.first)):
            lengths, which = self.kinds[offset]
            powers, logs = _powers(step * (loss if is_loss else 1 - loss), lengths)
            matrices[offset::2], scales[offset::2] = powers[which], logs[which]
        whole, log = _product(matrices)
        start = np.array((r, p)) / (p + r)
        probability = float((start @ whole).sum())
        return math.inf if probability <= 0 else -(math.log(probability) + log + float(scales.sum()))


def _powers(matrix: Floats, exponents: Ints) -> tuple[Floats, Floats]:
    """(m, 2, 2) powers of a matrix, each scaled to a largest entry of 1; (m,) logarithms of the scales."""
    result = np.tile(np.eye(2), (len(exponents), 1, 1))
    logs = np.zeros(len(exponents))
    square, square_log = matrix, 0.0
    left = exponents.copy()
    while left.any():
        largest = float(square.max()) or 1.0
        square, square_log = square / largest, square_log + math.log(largest)
        odd = left % 2 == 1
        result[odd] = result[odd] @ square
        logs[odd] += square_log
        left //= 2
        square, square_log = square @ square, 2 * square_log
    return _scaled(result, logs)


def _product(matrices: Floats) -> tuple[Floats, float]:
    """The product of (n, 2, 2) in their order, pair by pair; scaled, and the logarithm of the scale."""
    log = 0.0
    while len(matrices) > 1:
        if len(matrices) % 2:
            matrices = np.concatenate((matrices, np.eye(2)[None]))
        matrices, logs = _scaled(matrices[0::2] @ matrices[1::2], np.zeros(len(matrices) // 2))
        log += float(logs.sum())
    return matrices[0], log


def _scaled(matrices: Floats, logs: Floats) -> tuple[Floats, Floats]:
    largest = matrices.max(axis=(1, 2))
    largest = np.where(largest > 0, largest, 1.0)
    return matrices / largest[:, None, None], logs + np.log(largest)
