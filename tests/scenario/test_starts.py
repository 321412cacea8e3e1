"""Start values against every type and shape of a variable."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.components.component import Variable
from cosim.planning.starts import draw, elements, is_settable
from cosim.scenario.spec import Normal, Uniform


def variable(dtype: str = "Float64", shape: tuple[int, ...] = (), **changes: Any) -> Variable:
    options: dict[str, Any] = {"causality": "parameter", "variability": "fixed", "start": (0,)} | changes
    return Variable("x", dtype=dtype, shape=shape, **options)


@pytest.mark.parametrize(
    ("value", "shape", "flat"),
    [
        (1, (), (1.0,)),
        (1, (3,), (1.0, 1.0, 1.0)),
        ([1, 2], (2,), (1.0, 2.0)),
        ([[1, 2], [3, 4]], (2, 2), (1.0, 2.0, 3.0, 4.0)),
        ([1, 2, 3, 4], (2, 2), (1.0, 2.0, 3.0, 4.0)),
        ([1], (), (1.0,)),
        (1, (0, 2), ()),
        ([], (0, 2), ()),
    ],
)
def test_shapes(value: Any, shape: tuple[int, ...], flat: tuple[float, ...]) -> None:
    assert elements(value, variable(shape=shape)) == flat


@pytest.mark.parametrize(
    ("dtype", "value"),
    [("UInt8", 255), ("Int8", -128), ("Int64", 2**63 - 1), ("Boolean", True), ("String", "1"), ("Float32", 2)],
)
def test_types(dtype: str, value: Any) -> None:
    assert elements(value, variable(dtype)) == (value,)


@pytest.mark.parametrize(
    ("dtype", "value", "sentence"),
    [
        ("UInt8", 256, "'x' is a UInt8, from 0 to 255; 256 is not"),
        ("UInt8", -1, "from 0 to 255"),
        ("Int8", 128, "'x' is an Int8, from -128 to 127; 128 is not"),
        ("Int32", 2.0, "'x' is an Int32; 2.0 is not; write 2"),
        ("Int32", True, "'x' is an Int32; true is not"),
        ("String", 1, "'x' is a String; 1 is not; put it in quotes"),
        ("Boolean", "yes", "write true or false"),
        ("Binary", "0x0", "'x' takes bytes in hexadecimal digits, in quotes, such as '666f6f', not '0x0'"),
        ("Binary", 12, "in quotes"),
    ],
)
def test_wrong_types(dtype: str, value: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match="'x'") as caught:
        elements(value, variable(dtype))
    assert sentence in str(caught.value)


def test_enumeration_items_by_name_and_number() -> None:
    enumeration = variable("Enumeration", items={"off": 0, "on": 5})
    assert elements("on", enumeration) == elements(5, enumeration) == ("on",)


@pytest.mark.parametrize(
    ("changes", "settable"),
    [
        ({}, True),
        ({"causality": "input"}, True),
        ({"causality": "output", "initial": "exact"}, True),
        ({"causality": "output", "initial": "calculated"}, False),
        ({"causality": "calculatedParameter"}, False),
        ({"causality": "independent", "start": None}, False),
        ({"variability": "constant"}, False),
        ({"causality": "local", "start": None}, False),
        ({"causality": "parameter", "start": None}, True),  # an array of another size than its declared start values
        ({"causality": "input", "start": None}, True),
    ],
)
def test_what_takes_a_start_value(changes: dict[str, Any], settable: bool) -> None:
    assert is_settable(variable(**changes)) is settable


@given(st.integers(0, 2**63 - 1), st.lists(st.sampled_from(["u", "n", 1.5]), max_size=5))
def test_every_element_is_drawn_for_itself(seed: int, kinds: list[Any]) -> None:
    distributions = {"u": Uniform(uniform=[-2.0, 3.0]), "n": Normal(normal=[0.0, 1.0])}
    value = tuple(distributions.get(kind, kind) for kind in kinds)
    drawn = draw(value, seed, ["x", "a.b.c"])[1]
    assert len(drawn) == len(value)
    for i, kind in enumerate(kinds):
        assert kind != "u" or -2 <= float(drawn[i]) < 3
        assert kind != 1.5 or drawn[i] == 1.5
    assert draw(value, seed, ["x", "a.b.c"])[1] == drawn
