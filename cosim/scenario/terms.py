"""Where the docs explain a part of a channel: every parameter has its own place in docs/channels.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, get_args

from pydantic import BaseModel

from cosim.scenario.source import Node
from network.models import CHANNEL_MODELS
from network.profile import Profile


@cache
def terms() -> frozenset[str]:
    """Every parameter of every model, such as `loss.gemodel.p` or `window.depth`, and every part, such as `loss`."""
    found = {"model", *(name for name in CHANNEL_MODELS if name != "netem")}
    found |= set(_below(Profile, ""))
    for name, model in CHANNEL_MODELS.items():
        found |= {
            f"{name}.{field.alias or own}"
            for own, field in model.model_fields.items()
            if own != "model" and own not in Profile.model_fields
        }
    return frozenset(found)


def term(channel: Node | None, path: Sequence[str | int]) -> str:
    """What to look up for a mistake at `path` in a channel: the parameter, else the part in which it is."""
    model = channel.child("model") if channel is not None else None
    name = str(model.value) if model is not None else ""
    names = [str(step) for step in path]
    for length in range(len(names), 0, -1):
        part = ".".join(names[:length])
        for candidate in (part, f"{name}.{part}"):
            if candidate in terms():
                return candidate
    return name if name in terms() else "model"


def _below(model: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in model.model_fields.items():
        written = f"{prefix}{field.alias or name}"
        yield written
        for part in _models(field.annotation):
            yield from _below(part, f"{written}.")


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in an annotation, such as that in `Loss | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)
