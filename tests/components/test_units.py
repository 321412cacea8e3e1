"""Units: as a model description defines them, as Modelica writes them, and the conversion between two."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.components.fmu import describe
from cosim.components.units import Measure, Scale, conversion, measure
from tests.mapping.foreign import renamed

SAME = [
    ("m/s²", "m.s⁻²", 1.0),
    ("N.m", "kg.m2/s2", 1.0),
    ("N.m", "J", 1.0),
    ("kg*m^2/s^2", "kg.m2.s-2", 1.0),
    ("mm", "m", 1e-3),
    ("km/h", "m/s", 1 / 3.6),
    ("deg/s", "rad/s", math.pi / 180),
    ("rpm", "rad/s", math.pi / 30),
    ("rev/min", "rad/s", math.pi / 30),
    ("W/(m2.K)", "kg/(s3.K)", 1.0),
    ("1/min", "Hz", 1 / 60),
    ("%", "1", 0.01),
    ("dam", "m", 10.0),
    ("min", "s", 60.0),
    ("g", "kg", 1e-3),
    ("µs", "s", 1e-6),
    ("hPa", "bar", 1e-3),
]


@pytest.mark.parametrize(("one", "other", "factor"), SAME)
def test_units_that_convert(one: str, other: str, factor: float) -> None:
    first, second = measure(one), measure(other)
    assert first is not None
    assert second is not None
    scale = conversion(first, second)
    assert scale is not None
    assert scale.gain == pytest.approx(factor, rel=1e-15)
    assert scale.offset == 0


@pytest.mark.parametrize(("one", "other"), [("rad/s", "Hz"), ("N", "N.m"), ("m", "rad"), ("K", "J")])
def test_units_that_do_not_convert(one: str, other: str) -> None:
    first, second = measure(one), measure(other)
    assert first is not None
    assert second is not None
    assert conversion(first, second) is None


@pytest.mark.parametrize("text", ["furlong", "", "m s", "m/", "(m", "m)", "2m", "m.", "/s", "^2", "1e3", "€"])
def test_what_is_no_unit(text: str) -> None:
    assert measure(text) is None


@given(st.text(max_size=12))
def test_any_text_is_a_unit_or_none(text: str) -> None:
    assert measure(text) is None or isinstance(measure(text), Measure)


def test_temperatures() -> None:
    celsius, fahrenheit = measure("degC"), measure("degF")
    assert celsius is not None
    assert fahrenheit is not None
    scale = conversion(fahrenheit, celsius)
    assert scale is not None
    assert scale(212) == pytest.approx(100)
    assert scale(-40) == pytest.approx(-40)


@given(*[st.floats(0.01, 100)] * 2, *[st.floats(-100, 100)] * 3)
def test_scales(gain: float, other: float, offset: float, second: float, x: float) -> None:
    first, then = Scale(gain, offset), Scale(other, second)
    assert then.after(first)(x) == pytest.approx(then(first(x)), abs=1e-9)
    assert first.inverse()(first(x)) == pytest.approx(x, abs=1e-9)


def test_the_model_description_has_the_last_word(tmp_path: Path) -> None:
    """A unit of its own, and a name that would mean something else."""
    defined = renamed(tmp_path / "one.fmu", {"rad": "turn"})
    assert describe(defined).variables["p"].measure == measure("rad")
    other = renamed(tmp_path / "other.fmu", {"N.m": "deg"})
    assert describe(other).variables["u"].measure == measure("N.m")
