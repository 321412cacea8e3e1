"""Every channel model there is. To add one, name its class in the union below: the registry and the schema follow."""

from __future__ import annotations

from typing import Annotated, Any, get_args

from pydantic import BeforeValidator, Field

from network.channel import ChannelModel
from network.custom import Custom
from network.netem import Ideal, Netem
from network.replay import Replay
from network.window import Window

_Union = Ideal | Netem | Window | Replay | Custom

CHANNEL_MODELS: dict[str, type[ChannelModel]] = {cls.model_fields["model"].default: cls for cls in get_args(_Union)}
"""By the name that users write after `model:`."""


def _known_model(value: Any) -> Any:
    """Let only a mapping with a known `model` through to the union, whose own message lists Python types.

    Raises:
        ValueError: no `model`, or an unknown one.
    """
    if isinstance(value, ChannelModel):
        return value
    known = ", ".join(CHANNEL_MODELS)
    if not isinstance(value, dict) or "model" not in value:
        raise ValueError(
            f"a channel is a mapping with its kind under `model`, one of {known}; such as {{model: ideal}}, "
            "or the name of a profile"
        )
    model = value["model"]
    if not isinstance(model, str) or model not in CHANNEL_MODELS:
        import difflib

        nearest = difflib.get_close_matches(str(model), CHANNEL_MODELS, n=1)
        hint = f"did you mean {nearest[0]!r}?" if nearest else f"one of {known}"
        raise ValueError(f"{model!r} is no channel model ({hint})")
    return value


AnyChannelModel = Annotated[_Union, Field(discriminator="model"), BeforeValidator(_known_model)]
"""What a spec uses as the type of a profile."""
