"""The kit for people's own channels: it passes what keeps the rules, and names what does not."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from network.channel import ChannelError, ChannelModel, Setting
from network.conformance import Rule, main, violations
from network.custom import Custom
from network.draws import Draws
from network.models import AnyChannelModel
from tests.network import own_channels as own
from tests.network.networks import T, links_of
from tests.network.test_impairments import ONE_BY_ONE

ANY: TypeAdapter[ChannelModel] = TypeAdapter(AnyChannelModel)
OWN = "tests.network.own_channels"
PROFILES = sorted((Path(__file__).parents[2] / "configs" / "channels").glob("*.yaml"))


@pytest.mark.parametrize(
    "written",
    [
        *ONE_BY_ONE,
        {"model": "ideal"},
        {"model": "window", "depth": 10, "delay": ["150 ms", "250 ms"]},
        {"model": "python", "class": f"{OWN}:Tired", "options": {"loss": "30 %"}},
    ],
)
def test_what_is_shipped_keeps_the_rules(written: dict[str, Any]) -> None:
    assert violations(ANY.validate_python({"model": "netem"} | written), n_ticks=100) == []


@pytest.mark.parametrize("path", PROFILES, ids=lambda path: path.stem)
def test_the_library_of_profiles_keeps_the_rules(path: Path) -> None:
    import yaml

    assert violations(ANY.validate_python(yaml.safe_load(path.read_text())["channel"]), n_ticks=60) == []


@pytest.mark.parametrize(
    ("model", "rule", "said"),
    [
        (own.GlobalDraws, Rule.REPEATABLE, "played again, beside another channel"),
        (own.Clock, Rule.REPEATABLE, "played again, beside another channel"),
        (own.ClassState, Rule.REPEATABLE, "it sends something else at tick 0"),
        (own.FirstEdgesDraw, Rule.OTHER_EDGES, "the edges in another order, it sends something else"),
        (own.SharedMedium, Rule.OTHER_EDGES, "the edges in another order, it sends something else"),
        (own.Hurried, Rule.MESSAGES, "at tick 0 `delay_ns` has -30000000; it must be 0 or more, or NEVER"),
        (own.Prophet, Rule.MESSAGES, "at tick 0 `stamp` has 1; it must be 0 or more"),
        (own.Floating, Rule.MESSAGES, "`delay_ns` is no flat array of int64, but float64 array of shape (6,)"),
        (own.Failing, Rule.WORKS, "transmit(7) raised ZeroDivisionError: my mistake (own_channels.py, line"),
        (own.Promising, Rule.BOUNDS, "a message takes 20 ms, less than min_delay_ns(), 40 ms"),
        (own.AgePromising, Rule.BOUNDS, "was seen, more than age_bound_ns(), 200 ms"),
        (own.Unpicklable, Rule.PICKLABLE, "saved and loaded half way raised"),
        (own.Recycling, Rule.OWN_ARRAYS, "what was returned at tick"),
        (own.Hasty, Rule.TICKS, "asked for several ticks at once"),
        (own.Forgetful, Rule.WRITTEN, "what as_written() gives makes another model"),
    ],
)
def test_what_breaks_a_rule_is_caught(model: type[ChannelModel], rule: Rule, said: str) -> None:
    found = violations(model())
    assert rule in [violation.rule for violation in found]
    assert any(said in str(violation) for violation in found), found


def test_the_kit_leaves_the_global_random_numbers_alone() -> None:
    import random

    random.seed(5)
    expected = random.random()
    random.seed(5)
    violations(own.Tired())
    assert random.random() == expected


def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"{OWN}:Tired", "{loss: 30 %}"]) == 0
    assert capsys.readouterr().out == f"{OWN}:Tired keeps the rules (200 ticks, 6 edges)\n"
    assert main([f"{OWN}:Hurried"]) == 2
    assert "`delay_ns` has -30000000" in capsys.readouterr().out
    assert main([f"{OWN}:Tird"]) == 2
    assert "has no class 'Tird' (did you mean 'Tired'?)" in capsys.readouterr().err
    assert main([f"{OWN}:Tired", "{los: 30 %}"]) == 2
    assert "there is no field 'los'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("cls", "options", "said"),
    [
        ("nowhere", {}, "'nowhere' names no Python class; write package.module:Class"),
        ("nowhere:Mine", {}, "there is no Python module 'nowhere'"),
        (f"{OWN[:-1]}:Tired", {}, f"there is no Python module '{OWN[:-1]}' (did you mean '{OWN}'?)"),
        (f"{OWN}:Radio", {}, "Radio is no ChannelModel: derive it from network.channel.ChannelModel"),
        (f"{OWN}:Tired", {"loss": "130 %"}, f"options of {OWN}:Tired: loss: '130 %' is no probability"),
        ("broken_channel:Mine", {}, "broken_channel cannot be imported: SyntaxError"),
    ],
)
def test_mistakes_with_a_class(
    cls: str, options: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_channel.py").write_text("def f(:\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)  # where classes are looked for as well
    with pytest.raises(ValidationError) as caught:
        Custom.model_validate({"class": cls, "options": options})
    assert said in str(caught.value)


def test_a_class_that_fails_is_named_with_the_time_and_the_line() -> None:
    links = links_of("ab", [(0, 1)])
    for name, said in (("Failing", "ZeroDivisionError: my mistake (own_channels.py, line"), ("Hurried", "`delay_ns`")):
        channel = Custom.model_validate({"class": f"{OWN}:{name}"}).open(Setting(links, T, Draws(1, ["a"], ["b"]), 8))
        with pytest.raises(ChannelError, match=rf"channel {OWN}:{name}, at tick . \(t = 0(\.7)? s\): ") as caught:
            channel.transmit_many(range(10))
        assert said in str(caught.value)
