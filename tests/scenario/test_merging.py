"""Trees over trees, and single values from the command line."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import ConfigError, Location
from cosim.scenario.merging import Override, merge
from cosim.scenario.source import Node, dump, parse
from tests.scenario.test_source import nodes

LEAVES = st.integers(0, 9) | st.lists(st.integers(0, 9), max_size=2)
TREES = st.recursive(
    st.dictionaries(st.sampled_from("abcd"), LEAVES, max_size=3),
    lambda inner: st.dictionaries(st.sampled_from("abcd"), inner | LEAVES, max_size=3),
)


def merged(base: Any, over: Any) -> Any:
    """What merging means, on plain values."""
    if not isinstance(base, dict) or not isinstance(over, dict):
        return over
    return base | {key: merged(base[key], value) if key in base else value for key, value in over.items()}


@given(TREES, TREES)
def test_merge_is_deep_and_keeps_every_place(base: Any, over: Any) -> None:
    tree = merge(parse(dump(base), "base"), parse(dump(over), "over"))
    assert tree.plain() == merged(base, over)
    assert {node.where.file for node in nodes(tree)} <= {"base", "over"}
    for node in nodes(tree):
        if isinstance(node.value, int):
            text = dump({"base": base, "over": over}[node.where.file])
            line = text.split("\n")[node.where.line - 1]
            assert line[node.where.column - 1 :].startswith(str(node.value))


@given(TREES, TREES, TREES)
def test_merge_is_associative(a: Any, b: Any, c: Any) -> None:
    x, y, z = (parse(dump(tree), "f") for tree in (a, b, c))
    assert merge(merge(x, y), z).plain() == merged(merged(a, b), c)


@pytest.mark.parametrize(
    ("base", "over", "result"),
    [
        ("{fmu: A, start: {p: 1}}", "{python: m:C}", {"start": {"p": 1}, "python": "m:C"}),
        ("{p: {uniform: [0, 1]}}", "{p: {normal: [0, 1]}}", {"p": {"normal": [0, 1]}}),
        ("{p: {uniform: [0, 1]}}", "{p: {uniform: [2, 3]}}", {"p": {"uniform": [2, 3]}}),
        ("{p: {uniform: [0, 1]}}", "{p: 2}", {"p": 2}),
        ("{p: [1, 2]}", "{p: [3]}", {"p": [3]}),
    ],
)
def test_alternatives_and_lists_are_replaced(base: str, over: str, result: Any) -> None:
    assert merge(parse(base, "base"), parse(over, "over")).plain() == result


TREE = "a: {b: [1, {c: 2}]}\nagents: {1..3: {x: 1}}\n"


@pytest.mark.parametrize(
    ("setting", "path", "value"),
    [
        ("a.b=3", ["a", "b"], 3),
        ("a.b.1.c=[1, 2]", ["a", "b", 1, "c"], [1, 2]),
        ("a.new.deep=1 ms", ["a", "new", "deep"], "1 ms"),
        ("agents.1..3.x=2", ["agents", "1..3", "x"], 2),
        ("agents.7.x=a=b", ["agents", "7", "x"], "a=b"),
        ("a.b=", ["a", "b"], None),
        ("t.components.plant.start.arm.phi=1", ["t", "components", "plant", "start", "arm.phi"], 1),
        ("analysis.leaders.controller.role=x", ["analysis", "leaders", "controller.role"], "x"),
    ],
)
def test_an_override_sets_one_value(setting: str, path: list[str | int], value: Any) -> None:
    node = Override.from_setting(setting).apply(parse(TREE, "f")).find(*path)
    assert node is not None
    assert node.plain() == value
    assert node.where == Location(f"--set {setting.partition('=')[0]}")


@given(TREES, st.lists(st.sampled_from("abcd"), min_size=1, max_size=3), LEAVES)
def test_an_override_changes_nothing_else(tree: Any, path: list[str], value: Any) -> None:
    before = parse(dump(tree), "f")
    try:
        after = Override(".".join(path), dump(value)).apply(before)
    except ConfigError:
        return
    nested: Any = value
    for key in reversed(path):
        nested = {key: nested}
    assert after.plain() == merged(tree, nested)
    assert before.plain() == tree


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("a.b.9=1", "--set a.b.9: error: 'a.b' is a list of 2 elements; it has no '9'"),
        ("a.b.1.c.d=1", "--set a.b.1.c.d: error: 'a.b.1.c' is a single value; it has no 'd'"),
        ("a.b", "--set a.b: error: write --set KEY=VALUE"),
        ("=1", "write --set KEY=VALUE"),
        ("a.b=[1", "--set a.b: error: not valid YAML"),
        ("a.b={c: 1, c: 2}", "--set a.b: error: duplicate key 'c'"),
    ],
)
def test_overrides_that_cannot_be(setting: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Override.from_setting(setting).apply(parse(TREE, "f"))
    assert sentence in str(caught.value)


def test_merging_leaves_its_operands_alone() -> None:
    base, over = parse("{a: {b: 1}}", "base"), parse("{a: {c: 2}}", "over")
    merge(base, over)
    assert (base.plain(), over.plain()) == ({"a": {"b": 1}}, {"a": {"c": 2}})
    assert isinstance(base, Node)
