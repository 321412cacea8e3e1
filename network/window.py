"""The paper's intermittent channel (Section 5): old samples picked at random, each sent at most once, then delayed.

At every tick k an edge draws k̄ uniformly from {k - depth, …, k}. If k̄ < 0, or if the sample of tick k̄ was sent on this
edge before, nothing leaves; otherwise that sample leaves at kT and arrives after a uniformly distributed delay.

The paper leaves some of this open. The readings that it admits can be selected; the defaults are those above:

- `again`, when the sample picked was sent before: nothing leaves (`skip`); another of the window is picked, evenly
  among those that were not picked yet (`redraw`); or it is sent once more (`send`). With `redraw`, each sample that
  grows too old without being picked leaves one fewer to pick from, for good: in the long run there is only the newest.
- `before_start`, when k̄ < 0: nothing leaves (`skip`), or the pick counts as one of tick 0 (`first`).
- `draw`: every edge picks for itself (`edge`), or a sender picks once for all its receivers (`sender`); delays are
  drawn by edge in any case.
- `arrival`: in continuous time (`exact`), or noticed at the first tick from then on (`tick`).

Long-run facts, with these defaults. A sample is picked at none of its depth + 1 chances, and so never sent, with
probability (depth/(depth+1))^(depth+1): 0.3505 for a depth of 10. With T = 100 ms and delays from 150 to 250 ms the
mean age of information is 0.535 s.

Why the age is bounded, although many ticks send nothing. Let `high` be the largest delay. At any tick k ≥ depth the
draw is a k̄ ≥ k - depth; either it leaves now, or it left at an earlier tick. In both cases it has arrived by kT + high.
Hence at any time t the freshest stamp is at least k - depth, where k = ⌊(t - high)/T⌋ is the last tick whose message
must be there by t, and

- read at a tick t = σT, the age is at most (depth + ⌈high/T⌉)·T. For the paper: (10 + 3)·0.1 s = 1.3 s, its h*;
- at any time, as k > (t - high)/T - 1, the age is less than (depth + 1)·T + high. For the paper: 1.35 s.

Each of the readings keeps the first bound. It keeps the second if arrivals are not rounded up to ticks.

Where k < depth nothing need have arrived, but until then the age counts from the start of the run, and with
k - depth ≤ 0 it is within the same bounds. Both are sharp: the first is attained (for the paper, by an edge at one tick
in 14,000), the second approached.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from network.channel import Batch, Channel, Setting, Transmission
from network.draws import Draws
from network.impairments.delay import Delay
from network.messages import NEVER, Ints
from network.profile import Profile, Source

MAX_DEPTH = 10_000  # the state has two to four times as many bytes per edge
_TICKS_AT_ONCE = 64
_PICKS_AT_ONCE = 2**14


class Window(Profile):
    """A sample of the last `depth` ticks, picked at random, never the same one twice; then the impairments."""

    model: Literal["window"] = "window"
    depth: int = Field(ge=0, le=MAX_DEPTH, description="how many ticks back the sample may lie")
    delay: Delay = Field(description="the paper's is uniform: [150 ms, 250 ms]")
    again: Literal["skip", "redraw", "send"] = Field("skip", description="what if the sample picked was sent before")
    before_start: Literal["skip", "first"] = Field("skip", description="what if the pick lies before tick 0")
    draw: Literal["edge", "sender"] = Field("edge", description="who picks: every edge, or a sender for all of its")
    arrival: Literal["exact", "tick"] = Field("exact", description="when it arrives, or the first tick from then on")

    @field_validator("depth", mode="before")
    @classmethod
    def _whole_number(cls, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_DEPTH:
            raise ValueError(f"{value!r} is no depth: write a whole number of ticks from 0 to {MAX_DEPTH}, such as 10")
        return value

    def source(self, setting: Setting) -> Channel:
        draws = setting.draws if self.draw == "edge" else setting.draws.of_senders()
        if self.again == "redraw":
            return _Redraw(len(setting.links), self, draws)
        return _Window(len(setting.links), self, draws)

    def open(self, setting: Setting) -> Channel:
        opened = super().open(setting)
        return opened if self.arrival == "exact" else _AtTicks(opened, setting.period_ns)

    def source_age_ns(self, period_ns: int) -> int | None:
        """With the longest delay added, the first of the two bounds that the module's text derives."""
        return self.depth * period_ns


class _Window(Source):
    def __init__(self, n_links: int, model: Window, draws: Draws) -> None:
        depth = self.history = model.depth
        self._once, self._first_counts = model.again == "skip", model.before_start == "first"
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
        if self._first_counts and ticks.start < self.history:
            cell[picked < 0] %= n  # that of tick 0
            np.maximum(picked, 0, out=picked)
        possible = None if ticks.start >= self.history else np.flatnonzero(picked >= 0)
        if possible is not None:
            cell, which = cell[possible], which[possible]
        if self._once:
            # Of several ticks that pick one sample, the first sends it: assigned last, it holds.
            self._first[cell[::-1]] = which[::-1]
            sent = self._sent.reshape(-1)
            leaves = np.flatnonzero((self._first[cell] == which) & ~sent[cell])
            sent[cell[leaves]] = True
        else:
            leaves = np.arange(len(cell))
        chosen = leaves if possible is None else possible[leaves]
        tick, link = np.divmod(chosen, n)
        return self._at_once(ticks, tick + ticks.start, link, picked[chosen])

    @staticmethod
    def _at_once(ticks: range, sent: Ints, link: Ints, stamp: Ints) -> Batch:
        zeros = np.zeros(len(link), np.int64)
        return Batch(ticks, sent, link, stamp, zeros, zeros)


class _Redraw(Channel):
    """Picks among the samples of the window that were not picked yet."""

    def __init__(self, n_links: int, model: Window, draws: Draws) -> None:
        self.history = model.depth
        self._draws = draws
        # (depth + 1, n) of ticks k - depth, …, k: those before tick 0 can be picked, or there are none.
        self._picked = np.full((model.depth + 1, n_links), model.before_start == "first")

    def transmit(self, tick: int) -> Transmission:
        self._picked[:-1] = self._picked[1:]
        self._picked[-1] = False
        left = np.cumsum(~self._picked, axis=0)  # how many up to each; the newest is always among them
        wanted = (self._draws.uniform("window", tick) * left[-1]).astype(np.int64) + 1
        row = np.argmax(left == wanted, axis=0)
        self._picked[row, np.arange(len(row))] = True
        stamp = tick - self.history + row
        link = np.flatnonzero(stamp >= 0)
        zeros = np.zeros(len(link), np.int64)
        return Transmission(link, stamp[link], zeros, zeros)


class _AtTicks(Source):
    """Another channel whose messages are noticed at ticks."""

    def __init__(self, channel: Channel, period_ns: int) -> None:
        self.history = channel.history
        self._channel, self._period_ns = channel, period_ns

    def transmit_many(self, ticks: range) -> Batch:
        batch = self._channel.transmit_many(ticks)
        rounded = -(-batch.delay_ns // self._period_ns) * self._period_ns
        return batch.with_delay(np.where(batch.delay_ns == NEVER, NEVER, rounded))
