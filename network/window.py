"""The paper's intermittent channel (Section 5): old samples picked at random, each sent at most once, then delayed.

At every tick k an edge draws k̄ uniformly from {k - depth, …, k}. If k̄ < 0, or if the sample of tick k̄ was sent on this
edge before, nothing leaves; otherwise that sample leaves at kT and arrives after a uniformly distributed delay.

Long-run facts. A sample is picked at none of its depth + 1 chances, and so never sent, with probability
(depth/(depth+1))^(depth+1): 0.3505 for a depth of 10. With T = 100 ms and delays from 150 to 250 ms the mean age of
information is 0.535 s.

Why the age is bounded, although many ticks send nothing. Let `high` be the largest delay. At any tick k ≥ depth the
draw is a k̄ ≥ k - depth; either it leaves now, or it left at an earlier tick. In both cases it has arrived by kT + high.
Hence at any time t the freshest stamp is at least k - depth, where k = ⌊(t - high)/T⌋ is the last tick whose message
must be there by t, and

- read at a tick t = σT, the age is at most (depth + ⌈high/T⌉)·T. For the paper: (10 + 3)·0.1 s = 1.3 s, its h*;
- at any time, as k > (t - high)/T - 1, the age is less than (depth + 1)·T + high. For the paper: 1.35 s.

Where k < depth nothing need have arrived, but until then the age counts from the start of the run, and with
k - depth ≤ 0 it is within the same bounds. Both are sharp: the first is attained (for the paper, by an edge at one tick
in 14,000), the second approached.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from network.channel import Batch, Channel, Setting
from network.draws import Draws
from network.impairments.delay import Delay
from network.messages import Ints
from network.profile import Profile, Source

MAX_DEPTH = 10_000  # the state has two to four times as many bytes per edge
_TICKS_AT_ONCE = 64
_PICKS_AT_ONCE = 2**14


class Window(Profile):
    """A sample of the last `depth` ticks, picked at random, never the same one twice; then the impairments."""

    model: Literal["window"] = "window"
    depth: int = Field(ge=0, le=MAX_DEPTH, description="how many ticks back the sample may lie")
    delay: Delay = Field(description="the paper's is uniform: [150 ms, 250 ms]")

    @field_validator("depth", mode="before")
    @classmethod
    def _whole_number(cls, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_DEPTH:
            raise ValueError(f"{value!r} is no depth: write a whole number of ticks from 0 to {MAX_DEPTH}, such as 10")
        return value

    def source(self, setting: Setting) -> Channel:
        return _WindowChannel(len(setting.links), self.depth, setting.draws)

    def source_age_ns(self, period_ns: int) -> int | None:
        """With the longest delay added, the first of the two bounds that the module's text derives."""
        return self.depth * period_ns


class _WindowChannel(Source):
    def __init__(self, n_links: int, depth: int, draws: Draws) -> None:
        self.history = depth
        self._draws = draws
        self._n = n_links
        self._ticks_at_once = max(1, min(_TICKS_AT_ONCE, _PICKS_AT_ONCE // max(1, n_links)))
        # sent[s & mask, link]: whether the sample of tick s left. Rows are reused once no draw can pick s again.
        self._rows = 1 << (depth + self._ticks_at_once - 1).bit_length()
        self._sent = np.zeros((self._rows, n_links), np.bool_)
        self._first = np.zeros(self._rows * n_links, np.uint8)  # of the ticks done at once, the first that picked it

    def transmit_many(self, ticks: range) -> Batch:
        step = self._ticks_at_once
        parts = [self._transmit(range(i, min(i + step, ticks.stop))) for i in range(ticks.start, ticks.stop, step)]
        if len(parts) == 1:
            return parts[0]
        columns = (np.concatenate([getattr(part, name) for part in parts]) for name in ("sent", "link", "stamp"))
        return self._at_once(ticks, *columns)

    def _transmit(self, ticks: range) -> Batch:
        n = self._n
        for row in range(len(ticks)):
            self._sent[(ticks.start + row) & (self._rows - 1)] = False
        back = (self._draws.uniforms("window", ticks) * (self.history + 1)).astype(np.int64)
        picked = (np.asarray(ticks)[:, None] - back).reshape(-1)
        cell = (picked & (self._rows - 1)) * n + np.tile(np.arange(n), len(ticks))
        which = np.repeat(np.arange(len(ticks), dtype=np.uint8), n)
        possible = None if ticks.start >= self.history else np.flatnonzero(picked >= 0)
        if possible is not None:
            cell, which = cell[possible], which[possible]
        # Of several ticks that pick one sample, the first sends it: assigned last, it holds.
        self._first[cell[::-1]] = which[::-1]
        sent = self._sent.reshape(-1)
        leaves = np.flatnonzero((self._first[cell] == which) & ~sent[cell])
        sent[cell[leaves]] = True
        chosen = leaves if possible is None else possible[leaves]
        tick, link = np.divmod(chosen, n)
        return self._at_once(ticks, tick + ticks.start, link, picked[chosen])

    @staticmethod
    def _at_once(ticks: range, sent: Ints, link: Ints, stamp: Ints) -> Batch:
        zeros = np.zeros(len(link), np.int64)
        return Batch(ticks, sent, link, stamp, zeros, zeros)
