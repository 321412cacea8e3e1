"""Units of variables: what they measure in the SI's base units, and the conversion from one unit to another.

A unit is known where a model description defines it (FMI 2.0.5, section 2.2.2; FMI 3.0, section 2.4.4) or where it is
written as Modelica writes units (Modelica Language Specification 3.6, chapter 19), such as `kg.m2/s2`, `mm`, `deg/s`.
As in FMI, the radian is a base unit: `rad/s` and `Hz` do not convert.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""FMI's base units, in the order of `Measure.exponents`."""


class Scale(NamedTuple):
    """y = gain x + offset."""

    gain: float = 1.0
    offset: float = 0.0

    def __call__(self, value: float) -> float:
        return self.gain * value + self.offset

    def after(self, first: Scale) -> Scale:
        """This one applied to what `first` gives."""
        return Scale(self.gain * first.gain, self.gain * first.offset + self.offset)

    def inverse(self) -> Scale:
        """X from y."""
        return Scale(1.0 / self.gain, -self.offset / self.gain)


IDENTITY = Scale()


@dataclass(frozen=True)
class Measure:
    """A unit in base units: base value = factor value + offset.

    Attributes:
        exponents: of the base units.
        relative: of a difference (FMI: `relativeQuantity`), of which the offset does not count.
    """

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0
    relative: bool = False

    def __str__(self) -> str:
        powers = [f"{base}{n if n != 1 else ''}" for base, n in zip(BASE, self.exponents, strict=True) if n]
        return ".".join(powers) or "1"


def conversion(source: Measure, target: Measure) -> Scale | None:
    """From values in one unit to values in another; None where they measure different things."""
    if source.exponents != target.exponents:
        return None
    offset = 0.0 if source.relative or target.relative else (source.offset - target.offset) / target.factor
    return Scale(source.factor / target.factor, offset)


_WRITTEN = str.maketrans("·*⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "..-0123456789")


def measure(unit: str | None) -> Measure | None:
    """What a unit that is written as Modelica writes units measures; None where that cannot be told."""
    if unit is None:
        return None
    tokens = re.findall(r"\d+|[^\W\d_]+|\S", unit.strip().translate(_WRITTEN))
    try:
        found, rest = _product(tokens)
    except (KeyError, IndexError, ValueError):
        return None
    return None if rest else found


# --- Modelica's unit expressions --------------------------------------------------------------------------------------


def _product(tokens: list[str]) -> tuple[Measure, list[str]]:
    """Factors up to the end or a closing bracket, and what follows them."""
    total, rest = _factor(tokens)
    while rest and rest[0] in (".", "/"):
        factor, after = _factor(rest[1:])
        total = _times(total, factor, 1 if rest[0] == "." else -1)
        rest = after
    return total, rest


def _factor(tokens: list[str]) -> tuple[Measure, list[str]]:
    if tokens[0] == "(":
        inner, rest = _product(tokens[1:])
        if rest[0] != ")":
            raise ValueError(tokens)
        return inner, rest[1:]
    if tokens[0] in ("1", "-") and (len(tokens) == 1 or tokens[1] in ("/", ".", ")")):
        return _ONE, tokens[1:]
    symbol, rest = _symbol(tokens[0]), tokens[1:]
    if rest[:1] == ["^"]:
        rest = rest[1:]
    sign = rest[0] if rest and rest[0] in "+-" else ""
    digits = rest[len(sign) :]
    if sign or (digits and digits[0].isdigit()):
        return _times(_ONE, symbol, int(sign + digits[0])), digits[1:]
    return symbol, rest


def _times(one: Measure, other: Measure, power: int) -> Measure:
    if power == 1 and one == _ONE:
        return other  # keeps its offset: a temperature by itself
    exponents = tuple(a + power * b for a, b in zip(one.exponents, other.exponents, strict=True))
    return Measure(exponents, one.factor * other.factor**power)


def _symbol(text: str) -> Measure:
    if text in _UNITS:
        return _UNITS[text]
    prefix = "da" if text.startswith("da") else text[0]
    unit = _UNITS[text[len(prefix) :]]
    return Measure(unit.exponents, _PREFIXES[prefix] * unit.factor)


def _si(factor: float = 1.0, offset: float = 0.0, **exponents: int) -> Measure:
    return Measure(tuple(exponents.get(base, 0) for base in BASE), factor, offset)


_ONE = _si()
_PREFIX_SYMBOLS = "Y Z E P T G M k h da d c m u µ n p f a"
_PREFIX_POWERS = (24, 21, 18, 15, 12, 9, 6, 3, 2, 1, -1, -2, -3, -6, -6, -9, -12, -15, -18)
_PREFIXES = {symbol: float(f"1e{power}") for symbol, power in zip(_PREFIX_SYMBOLS.split(), _PREFIX_POWERS, strict=True)}
_UNITS = {
    **{base: Measure(tuple(int(other == base) for other in BASE)) for base in BASE},
    "g": _si(1e-3, kg=1),
    "t": _si(1e3, kg=1),
    "Hz": _si(s=-1),
    "N": _si(kg=1, m=1, s=-2),
    "Pa": _si(kg=1, m=-1, s=-2),
    "bar": _si(1e5, kg=1, m=-1, s=-2),
    "J": _si(kg=1, m=2, s=-2),
    "W": _si(kg=1, m=2, s=-3),
    "C": _si(A=1, s=1),
    "V": _si(kg=1, m=2, s=-3, A=-1),
    "F": _si(kg=-1, m=-2, s=4, A=2),
    "Ohm": _si(kg=1, m=2, s=-3, A=-2),
    "S": _si(kg=-1, m=-2, s=3, A=2),
    "Wb": _si(kg=1, m=2, s=-2, A=-1),
    "T": _si(kg=1, s=-2, A=-1),
    "H": _si(kg=1, m=2, s=-2, A=-2),
    "l": _si(1e-3, m=3),
    "L": _si(1e-3, m=3),
    "min": _si(60.0, s=1),
    "h": _si(3600.0, s=1),
    "d": _si(86400.0, s=1),
    "deg": _si(math.pi / 180, rad=1),
    "rev": _si(2 * math.pi, rad=1),
    "rpm": _si(2 * math.pi / 60, rad=1, s=-1),
    "degC": _si(1.0, 273.15, K=1),
    "degF": _si(5 / 9, 273.15 - 32 * 5 / 9, K=1),
    "%": _si(0.01),
}
