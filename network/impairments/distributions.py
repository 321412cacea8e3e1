"""Distributions of delays, as quantile functions: the delay of a message is q(u) for a uniform u.

Those with netem's names are netem's, and say how many jitters a delay lies above or below `time`: `uniform` reaches one
jitter to each side; `pareto` has the shape 3, shifted to the mean 0, scaled by 4/3 and cut off at 4 jitters, as its
tables are; `paretonormal` is a quarter of normal and three quarters of pareto at the same u. `lognormal` and
`gamma` have the mean `time` and the standard deviation `jitter`, and are never negative.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from network.messages import Floats

Name = Literal["uniform", "normal", "pareto", "paretonormal", "lognormal", "gamma"]
TABLE_SCALE = 8192
"""One jitter in a table of iproute2's."""
_MOST_ENTRIES = 1 << 20
CUT = 4.0
"""Jitters above `time` at which `pareto` ends."""


@dataclass(frozen=True)
class Quantile:
    """Delay in nanoseconds as a function of numbers in [0, 1).

    Attributes:
        name: of the distribution; not used where there is a table.
        time_ns, jitter_ns: its two parameters, of which the jitter is more than 0.
        table: (m,) jitters above `time`, each as likely as any other.
    """

    name: Name
    time_ns: int
    jitter_ns: int
    table: Floats | None = None

    def __call__(self, u: Floats) -> Floats:
        """(n,) delays for (n,) numbers."""
        if self.table is not None:
            jitters = self.table[(u * len(self.table)).astype(np.int64)]
        elif self.name == "lognormal":
            return _lognormal(u, self.time_ns, self.jitter_ns)
        elif self.name == "gamma":
            return _gamma(u, self.time_ns, self.jitter_ns)
        else:
            jitters = _STANDARD[self.name](u)
        return self.time_ns + self.jitter_ns * jitters


def support(name: Name) -> tuple[float, float]:
    """Lowest and highest value in jitters above `time`; infinite where there is no bound."""
    bounds = {"uniform": (-1.0, 1.0), "pareto": (-2 / 3, CUT)}
    return bounds.get(name, (-math.inf, math.inf))


def read_table(path: Path) -> Floats:
    """A file of iproute2's format: whole numbers in units of 1/8192 jitter, in rising order; `#` begins a comment.

    Raises:
        ValueError: it cannot be read, or a line is malformed; the message has the line.
    """
    try:
        text = path.read_text(encoding="ascii")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: this is no table of a distribution, but a binary file") from None
    entries: list[int] = []
    for number, line in enumerate(text.splitlines(), 1):
        for word in line.partition("#")[0].split():
            if not re.fullmatch(r"[+-]?\d{1,6}", word):
                raise ValueError(f"{path}:{number}: {word!r} is no whole number of 1/{TABLE_SCALE} jitter")
            entries.append(int(word))
    if not 2 <= len(entries) <= _MOST_ENTRIES:
        raise ValueError(
            f"{path}: it has {len(entries)} entries; 2 to {_MOST_ENTRIES} are needed, iproute2's have 4096"
        )
    return np.array(entries, np.float64) / TABLE_SCALE


def to_normal(u: Floats) -> Floats:
    """Standard normal numbers from uniform ones in [0, 1)."""
    from scipy.special import ndtri

    # Half a step up: never 0, where the inverse is infinite.
    return np.asarray(ndtri(u + 2.0**-54), np.float64)


def from_normal(z: Floats) -> Floats:
    """Uniform numbers in [0, 1) from standard normal ones."""
    from scipy.special import ndtr

    return np.minimum(np.asarray(ndtr(z), np.float64), 1 - 2.0**-53)


def _uniform(u: Floats) -> Floats:
    return 2 * u - 1


def _pareto(u: Floats) -> Floats:
    return np.minimum(4 / 3 * ((1 - u) ** (-1 / 3) - 1.5), CUT)


def _paretonormal(u: Floats) -> Floats:
    return np.asarray(0.25 * to_normal(u) + 0.75 * _pareto(u))


_STANDARD = {"uniform": _uniform, "normal": to_normal, "pareto": _pareto, "paretonormal": _paretonormal}


def _lognormal(u: Floats, mean: float, deviation: float) -> Floats:
    variance = math.log1p((deviation / mean) ** 2)
    return np.exp(math.log(mean) - variance / 2 + math.sqrt(variance) * to_normal(u))


def _gamma(u: Floats, mean: float, deviation: float) -> Floats:
    from scipy.special import gammaincinv

    shape = (mean / deviation) ** 2
    return np.asarray(gammaincinv(shape, u) * (mean / shape), np.float64)
