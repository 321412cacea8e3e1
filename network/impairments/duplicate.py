"""Duplicates: a message arrives twice; each copy then goes its own way through rate and delay."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from network.channel import Setting, Transmission
from network.impairments.impairment import Impairment, Stage, Stepwise, Sticky, schema_of
from network.messages import NEVER
from network.units import Probability, parse_probability


class Duplicate(Impairment):
    """tc's `duplicate PERCENT [CORRELATION]`."""

    short_form = schema_of(Probability)
    short_field = "random"
    from_short = parse_probability

    random: Probability = Field(description="every message with this probability")
    correlation: Probability = Field(0.0, description="from one message to the next; the rate stays")

    def open(self, setting: Setting) -> Stage:
        return _Duplicate(self, setting)


class _Duplicate(Stepwise):
    def __init__(self, model: Duplicate, setting: Setting) -> None:
        self._rate = model.random
        self._numbers = Sticky(setting, "duplicate", model.correlation)

    def step(self, tick: int, messages: Transmission) -> Transmission:
        alive = np.flatnonzero(messages.delay_ns != NEVER)
        twice = alive[self._numbers.next(tick, 0, messages.link[alive]) < self._rate]
        copy = np.concatenate((messages.copy, np.ones(len(twice), np.int64)))
        link, stamp, delay = (
            np.concatenate((column, column[twice])) for column in (messages.link, messages.stamp, messages.delay_ns)
        )
        return Transmission(link, stamp, delay, copy)
