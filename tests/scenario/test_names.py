"""Names of agents: what a range stands for, and how many agents are named in short."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.scenario.names import agent_names, in_short


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("1..3", ["1", "2", "3"]),
        ("1, 4", ["1", "4"]),
        ("hub", ["hub"]),
        ("arm1..3, hub", ["arm1", "arm2", "arm3", "hub"]),
        ("a1b7..8", ["a1b7", "a1b8"]),
        ("08..11", ["08", "09", "10", "11"]),
        ("left-arm, right_arm", ["left-arm", "right_arm"]),
    ],
)
def test_ranges_and_lists(text: str, names: list[str]) -> None:
    assert list(agent_names(text)) == names


@pytest.mark.parametrize(
    "text", ["", "1,", "a.b", "3..1", "1..99999999999", "a b", "1...3", "..3", "1..", "-a", "a/b", "*"]
)
def test_what_names_no_agent(text: str) -> None:
    with pytest.raises(ValueError, match=r"names no agent|must run upwards"):
        list(agent_names(text))


@given(st.lists(st.integers(0, 30).map(str) | st.integers(0, 12).map("arm{}".format) | st.just("hub")))
def test_in_short_says_the_same(names: list[str]) -> None:
    text = in_short(names)
    assert (list(agent_names(text)) if text else []) == names


def test_in_short_is_short() -> None:
    assert in_short([*map(str, range(1, 101)), "hub", "a1", "a2"]) == "1..100, hub, a1, a2"
