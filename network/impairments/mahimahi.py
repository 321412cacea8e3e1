"""A link as a packet-delivery trace of Mahimahi's: what a cellular modem could have sent, opportunity by opportunity.

Each line of a trace is a time in milliseconds at which 1500 bytes can leave; the trace begins anew at its last time.
An opportunity takes as many bytes of waiting messages as fit, of several messages or of part of one; what it does not
use is gone (Netravali et al.: "Mahimahi: accurate record-and-replay for HTTP", USENIX ATC 2015; mm-link's LinkQueue).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from network.channel import Setting, Transmission
from network.files import file_read_by
from network.impairments.impairment import Impairment, Stage, Stepwise, under_way
from network.messages import NEVER, Ints
from network.units import Duration, Size

OPPORTUNITY_BYTES = 1500
_MS = 1_000_000
_MOST_LINES = 20_000_000


def read_trace(path: Path) -> Ints:
    """(m,) times of the opportunities in milliseconds, not decreasing.

    Raises:
        ValueError: it cannot be read, is empty, or a line is malformed; the message has the line.
    """
    try:
        lines = path.read_text(encoding="ascii").split("\n")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: this is no trace, but a binary file") from None
    times: list[int] = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text:
            continue
        if not re.fullmatch(r"\d{1,12}", text):
            raise ValueError(f"{path}:{number}: {text!r} is no whole number of milliseconds")
        times.append(int(text))
        if len(times) > 1 and times[-1] < times[-2]:
            raise ValueError(f"{path}:{number}: {text} comes after {times[-2]}: times must not decrease")
        if len(times) > _MOST_LINES:
            raise ValueError(f"{path}: more than {_MOST_LINES} lines")
    if not times:
        raise ValueError(f"{path}: the trace is empty: it would deliver nothing")
    if times[-1] == 0:
        raise ValueError(f"{path}: the last time is 0: the trace has no duration after which it could begin anew")
    return np.array(times, np.int64)


class Mahimahi(Impairment):
    """A trace file, or a mapping with more."""

    short_form: ClassVar[dict[str, Any]] = {"type": "string"}
    short_field = "file"

    file: file_read_by(read_trace) = Field(  # type: ignore[valid-type]
        description="milliseconds, one opportunity of 1500 bytes per line"
    )
    overhead: Size = Field(0, ge=0, description="bytes that the network adds to every message")
    limit: int | None = Field(None, ge=1, le=100_000, description="messages in the queue; more are lost")
    start: Duration = Field(0, description="where in the trace the run begins")
    spread: bool = Field(False, description="whether each edge begins elsewhere in the trace, drawn from the seed")

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value

    def open(self, setting: Setting) -> Stage:
        return _Mahimahi(self, setting)

    def max_delay_ns(self) -> int | None:
        return None


class _Mahimahi(Stepwise):
    """Per edge: the next opportunity that has room, how much, and when the last messages left."""

    def __init__(self, model: Mahimahi, setting: Setting) -> None:
        n = len(setting.links)
        times = read_trace(Path(model.file)) * _MS
        self._cycle = int(times[-1])
        self._times = times
        self._bytes = max(1, setting.message_bytes + model.overhead)
        self._period_ns = setting.period_ns
        phase = setting.draws.uniform("trace", 0) if model.spread else np.zeros(n)
        # Time of the trace at the beginning of the run.
        self._phase = (model.start + (phase * self._cycle).astype(np.int64)) % self._cycle
        self._next = np.searchsorted(times, self._phase)  # opportunities counted on through all cycles
        self._room = np.full(n, OPPORTUNITY_BYTES)
        self._departures = None if model.limit is None else np.full((n, model.limit), NEVER, np.int64)
        self._count = np.zeros(n, np.int64)

    def step(self, tick: int, messages: Transmission) -> Transmission:
        delay = messages.delay_ns.copy()
        now = tick * self._period_ns
        for _, offered in under_way(messages):
            index = offered
            if self._departures is not None:
                link = messages.link[index]
                oldest = self._departures[link, self._count[link] % self._departures.shape[1]]
                full = oldest > now + messages.delay_ns[index]
                delay[index[full]] = NEVER
                index = index[~full]
            link = messages.link[index]
            leaves = self._send(link, now + messages.delay_ns[index])
            if self._departures is not None:
                self._departures[link, self._count[link] % self._departures.shape[1]] = leaves
                self._count[link] += 1
            delay[index] = leaves - now
        return messages.with_delay(delay)

    def _send(self, link: Ints, arrives: Ints) -> Ints:
        """When one message each of the edges `link` has left, all of its bytes."""
        self._skip(link, arrives)
        left = np.full(len(link), self._bytes)
        waiting = np.arange(len(link))
        leaves = np.empty(len(link), np.int64)
        while len(waiting):
            here = link[waiting]
            used = np.minimum(left[waiting], self._room[here])
            left[waiting] -= used
            self._room[here] -= used
            done = left[waiting] == 0
            leaves[waiting[done]] = self._time(here[done])
            exhausted = here[self._room[here] == 0]
            self._next[exhausted] += 1
            self._room[exhausted] = OPPORTUNITY_BYTES
            waiting = waiting[~done]
        return leaves

    def _skip(self, link: Ints, arrives: Ints) -> None:
        """Opportunities before a message arrived are gone."""
        # Cycles include their end, not their beginning: there lies the last opportunity of the cycle before.
        cycles, since = np.divmod(arrives + self._phase[link] - 1, self._cycle)
        first = cycles * len(self._times) + np.searchsorted(self._times, since + 1)
        behind = self._next[link] < first
        self._next[link[behind]] = first[behind]
        self._room[link[behind]] = OPPORTUNITY_BYTES

    def _time(self, link: Ints) -> Ints:
        cycles, which = np.divmod(self._next[link], len(self._times))
        return cycles * self._cycle + self._times[which] - self._phase[link]
