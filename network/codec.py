"""The bodies of messages: little-endian arrays, and JSON for what is sent once. Whatever arrives is checked before use.

Every `encode_…` gives the parts for `Endpoint.send`; the `decode_…` of the same name takes the envelope and what the
receiver knows anyway, and raises `WireError`, which names the sender, where a body does not fit that. Arrays that come
out are read only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from network.envelope import Envelope, Part, WireError
from network.messages import NEVER, Fate, Fates, Floats, Ints, Mail

_LARGEST_OBJECT = 2**26  # bytes of JSON
_LATEST_NS = 2**62
_MOST_TICKS = 2**20  # in one message
_REMEMBERED = 64


@dataclass(frozen=True)
class Receivers:
    """Agents of a block at ticks that follow each other, tick by tick; (n_ticks x n_agents,) each.

    Attributes:
        number: 0, 1, …
        tick: from the first one.
        start_ns: of the tick, from the start of the first one.
        slots: how many in-neighbours there are.
    """

    number: Ints
    tick: Ints
    start_ns: Ints
    slots: NDArray[np.uint64]


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
    def row_width(self) -> int:
        """Numbers in the recorded row of the block: those of its agents, one after the other."""
        return sum(self.widths)

    def receivers(self, n_ticks: int) -> Receivers:
        """The agents, tick by tick; remembered for a few numbers of ticks."""
        known = self._receivers.get(n_ticks)
        if known is None:
            if len(self._receivers) >= _REMEMBERED:
                self._receivers.clear()
            tick = np.arange(n_ticks).repeat(len(self))
            slots = np.tile(np.asarray(self.neighbours, np.uint64), n_ticks)
            known = Receivers(np.arange(len(tick)), tick, tick * self.period_ns, slots)
            self._receivers[n_ticks] = known
        return known

    @cached_property
    def _receivers(self) -> dict[int, Receivers]:
        return {}


# --- ticks that follow each other, the first being the envelope's ----------------------------------------------------
def encode_samples(block: Block, pieces: Sequence[Floats]) -> list[Part]:
    """Samples in pieces of some ticks each, (n_ticks, n, width): one row per agent, zero where nobody hears it.

    Raises:
        ValueError: samples of another shape.
    """
    if any(piece.shape[1:] != (len(block), block.width) for piece in pieces):
        raise ValueError(f"samples must have the shape {(len(block), block.width)} at every tick")
    return [sum(map(len, pieces)).to_bytes(8, "little"), *(_as("<f8", piece) for piece in pieces)]


def decode_samples(block: Block, envelope: Envelope) -> Floats:
    """(n_ticks, n, width), one tick at least: one row per agent of the block, zero where nobody hears it."""
    reader = _Reader(envelope)
    n_ticks = reader.count(1)
    return reader.rest(n_ticks * len(block) * block.width).reshape(n_ticks, len(block), block.width)


def encode_mail(mail: Mail, n_ticks: int) -> list[Part]:
    """Mail of some ticks for the agents of a block."""
    columns = [_as("<i8", column) for column in (np.diff(mail.ends), mail.arrival_ns, mail.slot, mail.stamp)]
    return [n_ticks.to_bytes(8, "little"), *columns, _as("<f8", mail.values)]


def decode_mail(block: Block, envelope: Envelope) -> tuple[int, Mail]:
    """How many ticks, one at least, and their mail for the agents of the block, tick by tick in the total order."""
    reader = _Reader(envelope)
    n_ticks = reader.count(1)
    counts, n = reader.counts(n_ticks * len(block))
    arrival, slot, stamp = reader.ints(3 * n).reshape(3, n)
    values = reader.rest(n * block.width).reshape(n, block.width)
    if n:
        first, period = reader.tick(_LATEST_NS // block.period_ns - n_ticks), block.period_ns
        receivers = block.receivers(n_ticks)
        receiver = receivers.number.repeat(counts)
        since = arrival - receivers.start_ns[receiver] - first * period
        due = since + receiver * period  # the receivers' periods one after the other
        outside = _magnitude(since) >= period
        foreign = _magnitude(slot) >= receivers.slots[receiver]
        impossible = _magnitude(stamp) > _magnitude(receivers.tick[receiver] + first)
        if (outside | foreign | impossible).any() or (due[1:] < due[:-1]).any():
            reader.check(~outside, "arrives outside its tick")
            reader.check(~foreign, "is from no in-neighbour")
            reader.check(~impossible, "has an impossible stamp")
            reader.check(due[1:] >= due[:-1], "arrives before the one ahead of it")
    ends = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=ends[1:])
    return n_ticks, Mail(ends, arrival, slot, stamp, values)


def encode_rows(block: Block, pieces: Sequence[Floats]) -> list[Part]:
    """Recorded rows in pieces of some ticks each: (n_ticks, row_width).

    Raises:
        ValueError: rows of another size than the block's.
    """
    if any(piece.shape[1:] != (block.row_width,) for piece in pieces):
        raise ValueError(f"rows must have {block.row_width} numbers")
    return [sum(map(len, pieces)).to_bytes(8, "little"), *(_as("<f8", piece) for piece in pieces)]


def decode_rows(block: Block, envelope: Envelope) -> Floats:
    """(n_ticks, row_width)."""
    reader = _Reader(envelope)
    n_ticks = reader.count()
    return reader.rest(n_ticks * block.row_width).reshape(n_ticks, block.row_width)


def encode_fates(counts: Sequence[int], pieces: Sequence[Fates]) -> list[Part]:
    """Fates, in pieces one after the other.

    Args:
        counts: of each tick, how many became known in it.
        pieces: of any number of ticks each.
    """
    columns = [_joined(column, "<i8") for column in zip(*(piece.columns for piece in pieces), strict=True)]
    head = np.array([len(counts), *counts], "<i8")
    return [head.data, *chain.from_iterable(columns)]


def decode_fates(n_agents: int, envelope: Envelope) -> tuple[list[int], Fates]:
    """Of each tick, how many fates became known in it; and all of them."""
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
    return counts.tolist(), Fates(sender, receiver, stamp, sent, arrival, fate)


# --- values from outside ---------------------------------------------------------------------------------------
def encode_external(taken: Mapping[int, Floats]) -> list[Part]:
    """Values by the index of their subscription."""
    indices = sorted(taken)
    head = np.array([len(indices), *indices], "<i8")
    return [head.data, *_joined([taken[index] for index in indices], "<f8")]


def decode_external(sizes: Sequence[int], envelope: Envelope) -> tuple[dict[int, Floats], Envelope]:
    """Values from outside at the beginning of a body, and the envelope with what follows them.

    Args:
        sizes: how many numbers each subscription has.
        envelope: whose tick is that at which the values were taken.
    """
    reader = _Reader(envelope)
    indices = reader.indices(len(sizes))
    values = {index: reader.floats(sizes[index]) for index in indices}
    for value in values.values():
        reader.check(np.isfinite(value), "is not finite")
    return values, replace(envelope, body=reader.left())


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
def _as(dtype: str, array: NDArray[Any]) -> Part:
    """The memory of an array as the wire has it."""
    return np.ascontiguousarray(array, dtype).data


def _joined(arrays: Sequence[NDArray[Any]], dtype: str) -> list[Part]:
    """The memory of all arrays one after the other, as the wire has it."""
    return [np.concatenate(arrays, dtype=dtype).data] if arrays else []


def _magnitude(values: Ints) -> NDArray[np.uint64]:
    """The values as unsigned: negative ones become larger than all others, so that one comparison serves both ends."""
    return values.view(np.uint64)


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

    def indices(self, n: int) -> list[int]:
        """A count and as many indices below `n`, in their order."""
        count = int(self.ints(1)[0])
        indices: list[int] = self.ints(count).tolist() if 0 <= count <= n else [-1]
        if any(not 0 <= index < n for index in indices) or sorted(set(indices)) != indices:
            raise self._fail("names something that does not exist, or twice")
        return indices

    def floats(self, count: int) -> Floats:
        """The next `count` numbers."""
        values: Floats = self._take(count, "<f8")
        return values

    def left(self) -> memoryview:
        """What was not read."""
        return self._envelope.body[self._at :]

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

    def count(self, least: int = 0) -> int:
        """A number of ticks."""
        count = int(self.ints(1)[0])
        if not least <= count <= _MOST_TICKS:
            raise self._fail(f"announces {count} ticks")
        return count

    def counts(self, n: int) -> tuple[Ints, int]:
        """(n,) numbers of things, each of which takes at least 8 bytes of what follows, and their sum."""
        counts = self.ints(n)
        most = len(self._envelope.body) // 8
        if n and _magnitude(counts).max() > most:  # so that their sum does not overflow
            raise self._fail("announces more than it holds")
        total = int(counts.sum())
        if total > most:
            raise self._fail("announces more than it holds")
        return counts, total

    def check(self, good: NDArray[np.bool_], what: str) -> None:
        """Every message must be `good`."""
        if not good.all():
            raise self._fail(f"has a message that {what}")
