"""What an impairment is: a part of a profile as users write it, and the live stage that it becomes.

A stage sees the messages that leave at a tick and says which of them are lost, when they arrive at its far end, and
whether there are copies. It keeps its state edge by edge, and draws its random numbers by edge, tick and copy
(`network.draws`), so that no edge's fate depends on another's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    GetJsonSchemaHandler,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    model_serializer,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from network.channel import Batch, Setting, Transmission
from network.draws import Draws
from network.messages import NEVER, Floats, Ints


def schema_of(type_: Any) -> dict[str, Any]:
    """The JSON schema of what a type is written as, for the short form of a part."""
    return TypeAdapter(type_).json_schema()


class Part(BaseModel):
    """A part of a profile, which may have a short form."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_by_name=True, validate_by_alias=True)
    short_form: ClassVar[dict[str, Any] | None] = None
    """Its JSON schema."""
    short_field: ClassVar[str | None] = None
    """The field that it stands for, if all others have their defaults."""
    from_short: ClassVar[Callable[[Any], object] | None] = None
    """Reads it, if a number or a text: a mistake in it is then the part's, not that of a field which nobody wrote."""

    @model_validator(mode="before")
    @classmethod
    def _from_short_form(cls, value: Any) -> Any:
        if cls.from_short is not None and isinstance(value, (int, float, str)) and not isinstance(value, bool):
            return {cls.short_field: cls.from_short(value)}
        return value

    @model_serializer(mode="wrap")
    def _as_short_as_can_be(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = handler(self)
        return written[self.short_field] if [*written] == [self.short_field] else written

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        whole = handler(schema)
        return whole if cls.short_form is None else {"anyOf": [cls.short_form, whole]}


class Stage(ABC):
    """A live impairment over the `n` edges of a profile."""

    @abstractmethod
    def apply(self, batch: Batch) -> Batch:
        """What becomes of the messages of several ticks. Called for all ticks in order from 0, however many at once.

        Args:
            batch: its `delay_ns` is the time from the tick until a message reaches this stage; `NEVER` if it does not.
                There is at most one message per tick, edge and copy.
        """


class Stepwise(Stage):
    """A stage in which a message depends on those before it: it is asked tick by tick."""

    def apply(self, batch: Batch) -> Batch:
        steps = [self.step(tick, sent) for tick, sent in zip(batch.ticks, batch.by_tick(), strict=True)]
        return Batch.of(batch.ticks, steps, whole=batch.whole and sum(len(s.link) for s in steps) == len(batch.link))

    @abstractmethod
    def step(self, tick: int, messages: Transmission) -> Transmission:
        """What becomes of a tick's messages, which are ordered by copy, then by edge."""


class Impairment(Part, ABC):
    """A part of a profile that becomes a stage."""

    @abstractmethod
    def open(self, setting: Setting) -> Stage:
        """The live stage."""

    def min_delay_ns(self) -> int:
        """No message takes less time from one end to the other."""
        return 0

    def max_delay_ns(self) -> int | None:
        """No message takes more time, and none is lost; None where that cannot be promised."""
        return 0


Selection = Ints | slice
"""Some messages, or all of them."""


def under_way(messages: Transmission) -> Iterator[tuple[int, Ints]]:
    """Copy by copy, the messages that are not lost: the copy's number, and indices into the arrays."""
    alive = messages.delay_ns != NEVER
    if not messages.copy.any():
        yield 0, np.flatnonzero(alive)
        return
    for copy in range(int(messages.copy.max()) + 1):
        yield copy, np.flatnonzero(alive & (messages.copy == copy))


def under_way_in(batch: Batch) -> Iterator[tuple[int, Selection]]:
    """As `under_way`, in several ticks."""
    alive = batch.delay_ns != NEVER
    if batch.whole or not batch.copy.any():
        yield 0, slice(None) if alive.all() else np.flatnonzero(alive)
        return
    for copy in range(int(batch.copy.max()) + 1):
        yield copy, np.flatnonzero(alive & (batch.copy == copy))


def uniform(draws: Draws, purpose: str, tick: int, copy: int) -> Floats:
    """(n,) one number in [0, 1) per edge for a message, or for a duplicate of it."""
    return draws.uniform(of_copy(purpose, copy), tick)


def of_copy(purpose: str, copy: int) -> str:
    """The purpose of a draw for a message, or for a duplicate of it."""
    return f"{purpose}/{copy}" if copy else purpose


def uniforms(draws: Draws, purpose: str, batch: Batch, copy: int, which: Selection) -> Floats:
    """(m,) `uniform` of some messages of one copy number."""
    table = draws.uniforms(of_copy(purpose, copy), batch.ticks)
    if batch.whole:
        return table.reshape(-1)[which]
    row = batch.sent[which] - batch.ticks.start
    return np.asarray(table.reshape(-1).take(row * table.shape[1] + batch.link[which]))


class Sticky:
    """Uniform numbers of which each repeats the one before with a given probability.

    The marginal distribution stays uniform, whatever the correlation, and the autocorrelation of the numbers, and of
    every event `number < p`, is `correlation ** lag`. (netem's recurrence, x' = c x + (1 - c) u, narrows the
    distribution, so that at a correlation of 50 % a stated loss of 10 % becomes one in a thousand.)
    """

    def __init__(self, setting: Setting, purpose: str, correlation: float) -> None:
        self._draws = setting.draws
        self._purpose = purpose
        self._correlation = correlation
        self._last = np.full(len(setting.links), np.nan)

    def next(self, tick: int, copy: int, link: Ints) -> Floats:
        """The next number of each of the edges `link`."""
        fresh = uniform(self._draws, self._purpose, tick, copy)[link]
        if self._correlation == 0.0:
            return fresh
        repeat = uniform(self._draws, f"{self._purpose} again", tick, copy)[link] < self._correlation
        last = self._last[link]
        numbers = np.where(repeat & ~np.isnan(last), last, fresh)
        self._last[link] = numbers
        return numbers
