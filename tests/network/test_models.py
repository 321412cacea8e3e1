from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from network.channel import ChannelModel
from network.models import CHANNEL_MODELS, AnyChannelModel
from network.netem import Ideal, Netem
from network.window import Window

MS = 1_000_000
T = 100 * MS
ANY: TypeAdapter[ChannelModel] = TypeAdapter(AnyChannelModel)


def test_the_registry_knows_each_model_by_its_yaml_name() -> None:
    assert set(CHANNEL_MODELS) == {"ideal", "netem", "window", "replay", "python"}
    assert CHANNEL_MODELS["window"] is Window


@pytest.mark.parametrize(
    ("written", "kind", "min_delay_ns", "age_bound_ns"),
    [
        ({"model": "ideal"}, Ideal, 0, 0),
        ({"model": "netem", "delay": "20 ms"}, Netem, 20 * MS, 100 * MS),
        ({"model": "netem", "delay": "0 s"}, Netem, 0, 0),
        ({"model": "netem", "delay": ["10 ms", "200 ms"]}, Netem, 10 * MS, 200 * MS),
        ({"model": "netem", "delay": ["10 ms", "201 ms"]}, Netem, 10 * MS, 300 * MS),
        ({"model": "netem", "delay": "20 ms", "loss": "2 %"}, Netem, 20 * MS, None),
        ({"model": "window", "depth": 10, "delay": ["150 ms", "250 ms"]}, Window, 150 * MS, 1300 * MS),
    ],
)
def test_profiles(written: dict[str, Any], kind: type, min_delay_ns: int, age_bound_ns: int | None) -> None:
    model = ANY.validate_python(written)
    assert type(model) is kind
    assert model.min_delay_ns() == min_delay_ns
    assert model.age_bound_ns(T) == age_bound_ns
    assert ANY.validate_python(model) == model
    assert ANY.validate_python(model.as_written()) == model


@pytest.mark.parametrize(
    ("written", "where", "message"),
    [
        (
            "ideal",
            (),
            "a channel is a mapping with its kind under `model`, one of ideal, netem, window, replay, python",
        ),
        ({"delay": "20 ms"}, (), "a channel is a mapping with its kind under `model`"),
        ({"model": "windw"}, (), "'windw' is no channel model (did you mean 'window'?)"),
        ({"model": ["window"]}, (), "is no channel model (did you mean 'window'?)"),
        ({"model": 3}, (), "3 is no channel model (one of ideal, netem, window, replay, python)"),
        ({"model": "netem", "delay": "20 ms", "los": 1}, ("netem", "los"), "Extra inputs are not permitted"),
        ({"model": "window", "depth": -1, "delay": 0}, ("window", "depth"), "write a whole number of ticks from 0 to"),
        ({"model": "window", "depth": 1.5, "delay": 0}, ("window", "depth"), "1.5 is no depth"),
        ({"model": "window", "depth": True, "delay": 0}, ("window", "depth"), "True is no depth"),
        ({"model": "window", "depth": 10**9, "delay": 0}, ("window", "depth"), "is no depth"),
    ],
)
def test_mistakes_get_a_sentence(written: Any, where: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        ANY.validate_python(written)
    (error,) = caught.value.errors()
    assert error["loc"] == where
    assert message in error["msg"]


def test_the_schema_tells_the_models_apart() -> None:
    schema = ANY.json_schema()
    assert schema["discriminator"]["propertyName"] == "model"
    assert set(schema["discriminator"]["mapping"]) == set(CHANNEL_MODELS)
