"""The bodies of messages: little-endian arrays, and JSON for what is sent once. Whatever arrives is checked before use.

Every `encode_…` gives the parts for `Endpoint.send`; the `decode_…` of the same name takes the envelope and what the
receiver knows anyway, and raises `WireError`, which names the sender, where a body does not fit that. Arrays that come
out are read only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from network.envelope import Envelope, Part, WireError
from network.messages import NEVER, Deliveries, Fate, Fates, Floats, Ints

_LARGEST_OBJECT = 2**26  # bytes of JSON
_LATEST_NS = 2**62
_MOST_TICKS = 2**20  # in one message


@dataclass(frozen=True)
class Block:
    """The agents of one worker, in the order of the file; known to both ends of a stream.

    Attributes:
        neighbours: per agent, how many in-neighbours it has.
        widths: per agent, how many numbers a recorded row has.
        width: numbers in a message.
        period_ns: T.
    """

    neighbours: tuple[int, ...]
    widths: tuple[int, ...]
    width: int
    period_ns: int

    def __len__(self) -> int:
        return len(self.neighbours)

    @cached_property
    def row_ends(self) -> tuple[int, ...]:
        """Where each agent's row begins in the row of the block, and the end."""
        return tuple(accumulate(self.widths, initial=0))

    @cached_property
    def agents(self) -> Ints:
        """0, 1, … for the agents."""
        return np.arange(len(self))

    @cached_property
    def slots(self) -> NDArray[np.uint64]:
        """`neighbours` as an array."""
        return np.asarray(self.neighbours, np.uint64)


# --- every tick --------------------------------------------------------------------------------------------------
def encode_samples(block: Block, messages: Sequence[Floats]) -> list[Part]:
    """Samples of a tick: (width,) per agent of the block, or empty where nobody hears the agent."""
    silent = np.zeros(block.width)
    return _joined([message if len(message) else silent for message in messages], "<f8")


def decode_samples(block: Block, envelope: Envelope) -> Floats:
    """(n, width): one row per agent of the block, zero where nobody hears it."""
    return _Reader(envelope).rest(len(block) * block.width).reshape(len(block), block.width)


def encode_mail(block: Block, deliveries: Sequence[Deliveries]) -> list[Part]:
    """Deliveries of a tick, one per agent of the block."""
    counts = np.fromiter([len(mail.stamp) for mail in deliveries], "<i8", len(block))
    full = [mail for mail in deliveries if len(mail.stamp)]
    return [
        counts.data,
        *_joined([mail.arrival_ns for mail in full], "<i8"),
        *_joined([mail.slot for mail in full], "<i8"),
        *_joined([mail.stamp for mail in full], "<i8"),
        *_joined([mail.values for mail in full], "<f8"),
    ]


def decode_mail(block: Block, envelope: Envelope) -> tuple[Deliveries, ...]:
    """Deliveries of the envelope's tick, one per agent of the block, in the total order."""
    reader = _Reader(envelope)
    counts, n = reader.counts(len(block))
    arrival, slot, stamp = reader.ints(n), reader.ints(n), reader.ints(n)
    values = reader.rest(n * block.width).reshape(n, block.width)
    if n:
        tick, period = reader.tick(_LATEST_NS // block.period_ns), block.period_ns
        since = arrival - tick * period
        agent = block.agents.repeat(counts)
        reader.check(_magnitude(since) < period, "arrives outside its tick")
        reader.check(_magnitude(slot) < block.slots[agent], "is from no in-neighbour")
        reader.check(_magnitude(stamp) <= tick, "has an impossible stamp")
        due = since + agent * period  # the agents' periods one after the other
        reader.check(due[1:] >= due[:-1], "arrives before the one ahead of it")
    nothing = Deliveries(arrival[:0], slot[:0], stamp[:0], values[:0])
    return tuple(
        Deliveries(arrival[i:j], slot[i:j], stamp[i:j], values[i:j]) if i < j else nothing
        for i, j in pairwise(accumulate(counts.tolist(), initial=0))
    )


# --- several ticks at once ---------------------------------------------------------------------------------------
def encode_rows(block: Block, ticks: Sequence[Sequence[Floats]]) -> list[Part]:
    """Recorded rows of ticks that follow each other, the first being the envelope's: per tick, one row per agent.

    Raises:
        ValueError: rows of other sizes than the block's.
    """
    if any(tuple(map(len, rows)) != block.widths for rows in ticks):
        raise ValueError(f"rows must have {block.widths} numbers")
    return [len(ticks).to_bytes(8, "little"), *_joined(list(chain.from_iterable(ticks)), "<f8")]


def decode_rows(block: Block, envelope: Envelope) -> list[list[Floats]]:
    """Per tick, the first being the envelope's: one row per agent of the block."""
    reader = _Reader(envelope)
    n_ticks = reader.count()
    values = reader.rest(n_ticks * block.row_ends[-1]).reshape(n_ticks, block.row_ends[-1])
    return [[row[i:j] for i, j in pairwise(block.row_ends)] for row in values]


def encode_fates(ticks: Sequence[Fates]) -> list[Part]:
    """Fates of ticks that follow each other, the first being the envelope's."""
    counts = np.fromiter((len(fates) for fates in ticks), "<i8", len(ticks))
    rows = [(f.sender, f.receiver, f.stamp, f.sent, f.arrival_ns, f.fate) for f in ticks]
    columns = [_joined(column, "<i8") for column in zip(*rows, strict=True)]
    return [len(ticks).to_bytes(8, "little"), counts.data, *chain.from_iterable(columns)]


def decode_fates(n_agents: int, envelope: Envelope) -> list[Fates]:
    """Per tick, the first being the envelope's: the fates that became known in it."""
    reader = _Reader(envelope)
    counts, n = reader.counts(reader.count())
    sender, receiver, stamp, sent, arrival = (reader.ints(n) for _ in range(5))
    fate = reader.ints(n)
    reader.end()
    tick = reader.tick(_LATEST_NS) + np.arange(len(counts)).repeat(counts)
    reader.check((np.minimum(sender, receiver) >= 0) & (np.maximum(sender, receiver) < n_agents), "names no agent")
    reader.check((stamp >= 0) & (stamp <= sent) & (sent <= tick), "has an impossible stamp")
    reader.check((fate >= 0) & (fate < len(Fate)), "has an unknown fate")
    reader.check((arrival == NEVER) == (fate == Fate.LOST), "is lost and arrives, or neither")
    reader.check(arrival >= NEVER, "arrives before the run")
    return [
        Fates(sender[i:j], receiver[i:j], stamp[i:j], sent[i:j], arrival[i:j], fate[i:j])
        for i, j in pairwise(accumulate(counts.tolist(), initial=0))
    ]


# --- sent once ---------------------------------------------------------------------------------------------------
def encode_object(content: Mapping[str, object]) -> list[Part]:
    """A JSON object in UTF-8."""
    return [json.dumps(content, ensure_ascii=False, separators=(",", ":")).encode()]


def decode_object(envelope: Envelope) -> dict[str, object]:
    """A JSON object; its members are for the receiver to check."""
    if len(envelope.body) > _LARGEST_OBJECT:
        raise WireError(envelope.sender, f"{_what(envelope)} has {len(envelope.body)} bytes of JSON")
    try:
        content = json.loads(bytes(envelope.body))
    except (ValueError, RecursionError) as error:
        raise WireError(envelope.sender, f"{_what(envelope)} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise WireError(envelope.sender, f"{_what(envelope)} is not a JSON object")
    return content


# --- arrays ------------------------------------------------------------------------------------------------------
def _joined(arrays: Sequence[NDArray[Any]], dtype: str) -> list[Part]:
    """The memory of all arrays one after the other, as the wire has it."""
    return [np.concatenate(arrays, dtype=dtype).data] if arrays else []


def _magnitude(values: Ints) -> NDArray[np.uint64]:
    """The values as unsigned: negative ones become larger than all others, so that one comparison serves both ends."""
    return values.astype(np.uint64)


def _what(envelope: Envelope) -> str:
    return f"the body of {envelope.kind.name} of tick {envelope.tick}"


class _Reader:
    """Takes arrays off the beginning of a body."""

    def __init__(self, envelope: Envelope) -> None:
        self._envelope = envelope
        self._at = 0

    def _fail(self, what: str) -> WireError:
        return WireError(self._envelope.sender, f"{_what(self._envelope)} {what}")

    def _take(self, count: int, dtype: str) -> NDArray[Any]:
        begin, self._at = self._at, self._at + 8 * count
        if self._at > len(self._envelope.body):
            raise self._fail(f"has {len(self._envelope.body)} bytes, at least {self._at} were expected")
        return np.frombuffer(self._envelope.body, dtype, count, begin) if count else np.zeros(0, dtype)

    def ints(self, count: int) -> Ints:
        """The next `count` integers."""
        return self._take(count, "<i8")

    def rest(self, count: int) -> Floats:
        """The remaining numbers, of which there must be `count`."""
        values: Floats = self._take(count, "<f8")
        self.end()
        return values

    def end(self) -> None:
        """Nothing may be left."""
        if self._at != len(self._envelope.body):
            raise self._fail(f"has {len(self._envelope.body)} bytes, {self._at} were expected")

    def tick(self, latest: int) -> int:
        """The envelope's tick, which must lie between 0 and `latest`."""
        if not 0 <= self._envelope.tick <= latest:
            raise self._fail("is of no tick of any run")
        return self._envelope.tick

    def count(self) -> int:
        """A number of ticks."""
        count = int(self.ints(1)[0])
        if not 0 <= count <= _MOST_TICKS:
            raise self._fail(f"announces {count} ticks")
        return count

    def counts(self, n: int) -> tuple[Ints, int]:
        """(n,) numbers of things, each of which takes at least 8 bytes of what follows, and their sum."""
        counts = self.ints(n)
        most = len(self._envelope.body) // 8
        if n and (counts.min() < 0 or counts.max() > most or counts.sum() > most):
            raise self._fail("announces more than it holds")
        return counts, int(counts.sum())

    def check(self, good: NDArray[np.bool_], what: str) -> None:
        """Every message must be `good`."""
        if not good.all():
            raise self._fail(f"has a message that {what}")
