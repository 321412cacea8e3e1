"""YAML to a tree: values of YAML 1.2, every place right, equal keys and nonsense refused."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import ConfigError, Location
from cosim.scenario.source import Node, dump, parse
from tests.scenario.scenarios import FILE, marked

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**30), 10**30)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]) | st.sampled_from("\n\t"))
    | st.sampled_from(["on", "yes", "010", "12:30", "1e5", "1e-3", "0o17", "1_000", "~", "<<", "null", "-", "a: b"])
)
KEYS = st.text("abcxyz019 .,->é", max_size=4)
TREES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3))


def nodes(node: Node) -> Iterator[Node]:
    yield node
    for child in [*node.mapping.values(), *node.items]:
        yield from nodes(child)


def refusal(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(text, FILE)
    return [str(problem) for problem in caught.value.problems]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("on", "on"),
        ("yes", "yes"),
        ("true", True),
        ("010", 10),
        ("0o10", 8),
        ("0x1F", 31),
        ("12:30", "12:30"),
        ("1_000", "1_000"),
        ("1e-3", 0.001),
        ("1.", 1.0),
        (".5", 0.5),
        ("-.inf", -math.inf),
        ("+12", 12),
        ("~", None),
        ("2001-01-01", "2001-01-01"),
        ("'1'", "1"),
        ("!!str 1", "1"),
        ("!!float 1", 1.0),
        ("=", "="),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: Any) -> None:
    plain = parse(f"a: {text}", FILE).plain()["a"]
    assert plain == value
    assert type(plain) is type(value)


def test_keys_are_text_as_written() -> None:
    tree = parse("1: a\n1..10: b\n1, 4: c\n010: d\ntrue: e\n~: f\n'1.0': g", FILE)
    assert list(tree.mapping) == ["1", "1..10", "1, 4", "010", "true", "~", "1.0"]


def test_locations_of_keys_and_values() -> None:
    tree = parse("a: 1\nb:\n  - x\n  - {c: [2, 3]}\n", FILE)
    assert tree.locate("b", 1, "c", 1) == Location(FILE, 4, 13)
    assert tree.locate("b", 1, "c", key=True) == Location(FILE, 4, 6)
    assert tree.locate("b", 1, "gone", "deeper") == Location(FILE, 4, 5)
    assert tree.find("b", 0) == Node("x", Location(FILE, 3, 5))


@given(TREES)
def test_what_is_written_reads_back_to_the_last_bit(tree: Any) -> None:
    assert repr(parse(dump({"tree": tree}), FILE).plain()["tree"]) == repr(tree)


@given(TREES)
def test_every_location_points_into_the_text(tree: Any) -> None:
    text = dump({"tree": tree})
    lines = text.split("\n")
    for node in nodes(parse(text, FILE)):
        for place in [node.where, *([node.key] if node.key else [])]:
            assert 1 <= place.line <= len(lines)
            assert 1 <= place.column <= len(lines[place.line - 1]) + 1
        if isinstance(node.value, (int, float)) and not isinstance(node.value, bool):
            rest = lines[node.where.line - 1][node.where.column - 1 :]
            assert rest.startswith(("-", "+", ".", "0", "1", "2", "3", "4", "5", "6", "7", "8", "9"))


@given(st.lists(st.text("abc", min_size=1, max_size=2), min_size=1), st.sampled_from(["{}: 1", "  {}: [1]", "'{}': x"]))
def test_equal_keys_are_always_found(keys: list[str], form: str) -> None:
    text = "\n".join(form.format(key) for key in keys)
    repeated = len(keys) - len(set(keys))
    if repeated:
        messages = refusal(text)
        assert len(messages) == repeated
        assert all("duplicate key" in message for message in messages)
    else:
        assert list(parse(text, FILE).mapping) == keys


def test_an_alias_keeps_the_place_of_its_anchor() -> None:
    tree = parse("a: &x {p: 1}\nb: *x\n", FILE)
    assert tree.plain() == {"a": {"p": 1}, "b": {"p": 1}}
    assert tree.locate("b", "p") == Location(FILE, 1, 11)


def test_merge_keys() -> None:
    text = "a: &a {p: 1, q: 2}\nb: &b {q: 3, r: 4}\nc:\n  q: 9\n  <<: [*a, *b]\n"
    assert parse(text, FILE).plain()["c"] == {"p": 1, "q": 9, "r": 4}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a: 1\n§\tb: 2\n", "a tab in the indentation; YAML wants spaces"),
        ("a: b§: c\n", "a second ': ' on this line"),
        ("a: §@x\n", "text that begins with '@' must be in quotes"),
        ("a: §%x\n", "text that begins with '%' must be in quotes"),
        ("a: [1, 2\nb§: 3\n", "while parsing a flow sequence that begins at line 1: expected ',' or ']'"),
        ("a: é, ü\nb: §'x\n", "not valid YAML"),
        ("a: \u20ac§\x00\n", "a control character"),
        ("a: 1\n§---\nb: 2\n", "a second document"),
        ("a: §*x\n", "undefined alias 'x'"),
        ("a: §&x {b: *x}\n", "an alias inside the very value that it stands for"),
        ("a: 1\n? §[1, 2]\n: 3\n", "a key must be text"),
        ("a: §!!python/name:os.system x\n", "the tag !!python/name:os.system means nothing here"),
        ("a: §!thing {b: 1}\n", "the tag !thing means nothing here"),
        ("a: §!!int x\n", "'x' is no !!int"),
        ("a: {b: 1, §b: 2}\n", "duplicate key 'b', first at line 1"),
        ("a: 1\n§a: 2\n", "duplicate key 'a', first at line 1"),
        ("1: x\n§'1': y\n", "duplicate key '1', first at line 1"),
        ("a: {<<: §1}\n", "'<<' takes a mapping"),
        ("a: {<<: {b: 1}, §<<: {c: 1}}\n", "duplicate key '<<'"),
        ("§", "the file is empty"),
        ("§# nothing but a comment\n", "the file is empty"),
    ],
)
def test_refused_texts(text: str, sentence: str) -> None:
    text, place = marked(text)
    (message,) = refusal(text)
    if "not valid YAML" not in sentence:
        assert message.startswith(f"{place}: error: ")
    assert message.startswith(f"{FILE}:")
    assert sentence in message


def test_all_equal_keys_are_reported_at_once() -> None:
    assert len(refusal("a: 1\na: {b: 1, b: 2}\na: 3\nc: !x 1\n")) == 4


def test_nested_too_deeply() -> None:
    assert "levels deep" in refusal("[" * 500 + "]" * 500)[0]


def test_aliases_that_expand_without_bound() -> None:
    layers = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    layers += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    assert "counting those behind aliases" in refusal("\n".join(layers))[0]


def test_without_the_c_parser_the_tree_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "a: {b: [1, 'é'], c: &x {d: 1e-3}}\ne: *x\nf: |\n  text\n"
    fast = parse(text, FILE)
    import cosim.scenario.source

    assert issubclass(cosim.scenario.source._Loader, yaml.CSafeLoader)
    monkeypatch.setattr(cosim.scenario.source, "_Loader", cosim.scenario.source._PythonLoader)
    assert parse(text, FILE) == fast
