"""docs/channels.md and the models say the same, and every mistake in a channel leads to its place there."""

from typing import Any

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cosim import cli
from cosim.channel.explaining import entries, explain
from cosim.errors import ConfigError
from cosim.scenario.terms import _models, terms
from network.models import CHANNEL_MODELS

SECTIONS = {"fit"}


def fields(model: type[BaseModel], prefix: str = "") -> dict[str, FieldInfo]:
    """Every field below a model, by its path as users write it."""
    found = {}
    for name, field in model.model_fields.items():
        path = f"{prefix}{field.alias or name}"
        found[path] = field
        for part in _models(field.annotation):
            found |= fields(part, f"{path}.")
    return found


def field_of(term: str) -> FieldInfo | None:
    """The field that a term names; None for parts and models."""
    model, _, rest = term.partition(".")
    if model in CHANNEL_MODELS and rest:
        return fields(CHANNEL_MODELS[model]).get(rest)
    return fields(CHANNEL_MODELS["netem"]).get(term)


def test_every_parameter_of_every_model_has_its_place_and_nothing_else_has() -> None:
    assert entries().keys() - SECTIONS == terms()
    for name, model in CHANNEL_MODELS.items():
        for path in fields(model):
            assert {path, f"{name}.{path}"} & entries().keys(), f"{name}: {path}"


@pytest.mark.parametrize("term", sorted(term for term in terms() if "." in term))
def test_the_docs_have_the_default_of_the_code(term: str) -> None:
    field, text = field_of(term), entries()[term].text
    assert field is not None
    if not text.startswith(f"{term}: "):  # a section
        return
    said = next(line.removeprefix("  Default").strip() for line in text.splitlines() if line.startswith("  Default"))
    assert (said == "needed") == field.is_required()
    default: Any = field.default
    if isinstance(default, bool):
        assert said == str(default).lower()
    elif isinstance(default, (int, float)) and not (default == 0 and said == "none"):
        assert float(said) == default
    elif isinstance(default, str):
        assert said == f"`{default}`"


@pytest.mark.parametrize(
    ("channel", "term"),
    [
        ("{model: netem, loss: {gemodel: [1 %, 200 %]}}", "loss.gemodel.r"),
        ("{model: netem, loss: {gemodel: {p: 1 %, r: 0}}}", "loss.gemodel"),
        ("{model: netem, loss: 3}", "loss"),
        ("{model: netem, loss: {state: {p13: 60 %, p14: 60 %}}}", "loss.state"),
        ("{model: netem, duplicate: -1 %}", "duplicate"),
        ("{model: netem, schedule: {down: [[2 s, 1 s]]}}", "schedule.down"),
        ("{model: netem, schedule: {outage: {every: 1 s, for: 2 s}}}", "schedule.outage"),
        ("{model: netem, rate: 0 bit/s}", "rate"),
        ("{model: netem, rate: {rate: 1 kbit/s, limit: none}}", "rate.limit"),
        ("{model: netem, slot: {every: 1 ms, packets: 0}}", "slot.packets"),
        ("{model: netem, delay: {time: 1 ms, jitter: -1 ms}}", "delay.jitter"),
        ("{model: netem, delay: {time: 1 ms, distribution: gaussian}}", "delay.distribution"),
        ("{model: netem, delay: 1 ms, reorder: {random: 1 %, gap: 0}}", "reorder.gap"),
        ("{model: netem, mahimahi: gone.trace}", "mahimahi.file"),
        ("{model: netem, recorded: {file: gone.csv}}", "recorded.file"),
        ("{model: netem, delai: 1 ms}", "model"),
        ("{model: window, depth: -1, delay: 1 ms}", "window.depth"),
        ("{model: window, depth: 3}", "delay"),
        ("{model: replay, file: gone.parquet}", "replay.file"),
        ("{model: python, class: nothing}", "python"),
        ("{model: nettem}", "model"),
    ],
)
def test_a_mistake_names_its_place(channel: str, term: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["channel", channel]) == 2
    first = capsys.readouterr().err.splitlines()[0]
    assert first.endswith(f"(cosim channel --explain {term})"), first
    assert cli.main(["channel", "--explain", term]) == 0
    assert capsys.readouterr().out.startswith((f"{term}: ", "#"))


def test_explain_takes_the_end_of_a_name_and_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert [entry.term for entry in explain("1-h")] == ["loss.gemodel.1-h"]
    assert [entry.term for entry in explain("gap")] == ["reorder.gap"]
    assert len(list(explain("correlation"))) == 4
    with pytest.raises(ConfigError, match="did you mean 'depth'"):
        list(explain("depht"))
    assert cli.main(["channel", "--explain"]) == 0
    assert set(capsys.readouterr().out.split()) == entries().keys()
