"""The envelope of every message between processes: who, to whom, what, which tick, which number; checked on arrival.

Layout, little endian (docs/protocol.md): a head of 40 bytes, the names of run, sender and receiver, zeros up to a
multiple of 8 bytes, the body. Magic number, version and checksum keep their place in every version of the protocol, so
that damage is told from a foreign version.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

VERSION: Final = 1
"""Of the protocol: processes that speak another one are refused."""

Part = bytes | bytearray | memoryview
"""A piece of a body; the memory of an array is its `data`, which must be contiguous."""

Tamper = Callable[[str, str, bytes], Sequence[bytes]]
"""For tests: (sender, receiver, frame) -> what arrives instead of that frame, in order."""

_MAGIC: Final = b"nCoS"
_HEAD = struct.Struct(
    "<4sHBBIBBBBqQQ"
)  # magic, version, kind, 0, checksum, lengths of the names, 0, tick, sequence, size
_CHECKSUM_AT, _AFTER_CHECKSUM = 8, 12
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class Kind(IntEnum):
    """What a message is; the numbers are the wire's."""

    HELLO = 1  # process -> orchestrator: asks to join; answered by WELCOME or FAILURE
    WELCOME = 2
    SCENARIO = 3  # orchestrator -> process: what to run
    READY = 4  # process -> orchestrator: components are initialised
    GRANT = 5  # orchestrator -> all: run up to this tick
    SAMPLES = 6  # worker -> emulator: its agents' messages of a tick
    MAIL = 7  # emulator -> worker: deliveries of a tick for its agents
    ROWS = 8  # worker -> orchestrator: recorded values, several ticks at once
    FATES = 9  # emulator -> orchestrator: fates of messages, several ticks at once
    FAILURE = 10  # anybody -> orchestrator: what went wrong; orchestrator -> all: the run is over
    DONE = 11  # process -> orchestrator: the last tick is behind it
    BYE = 12  # the sender leaves in good order: its absence is no loss
    PING = 13  # answered by PONG
    PONG = 14
    REPLACE = 15  # orchestrator -> emulator, and back: a process takes the place of a lost worker
    EXTERNAL = 16  # orchestrator -> emulator: values from outside, taken at a tick; passed on with its mail
    CLAIM = 20  # process -> orchestrator, in runs started by hand: who it is, and which agents it wants to carry
    OFFER = 21  # orchestrator -> process: what will be run; FAILURE instead says why the claim is refused
    FETCH = 22  # process -> orchestrator: asks for the part of a file that the tick counts
    CHUNK = 23  # orchestrator -> process: that part
    PREPARED = 24  # process -> orchestrator: it has all it needs


class WireError(RuntimeError):
    """A message that must not be used: damaged, foreign, out of order, or not what was expected.

    Attributes:
        sender: the process whose message it is.
        what: what is wrong with it.
    """

    def __init__(self, sender: str, what: str) -> None:
        self.sender = sender
        self.what = what
        super().__init__(f"message from {sender}: {what}")


@dataclass(frozen=True)
class Envelope:
    """A message that has been checked, except for its body, which `network.codec` checks.

    Attributes:
        sequence: number in the stream from sender to receiver, from 0.
        body: read only.
    """

    sender: str
    receiver: str
    kind: Kind
    tick: int
    sequence: int
    body: memoryview

    def expect(self, kind: Kind, tick: int | None = None) -> Envelope:
        """This envelope, if it is of this kind (and this tick).

        Raises:
            WireError: it is not.
        """
        if self.kind is not kind or (tick is not None and tick != self.tick):
            wanted = kind.name if tick is None else f"{kind.name} of tick {tick}"
            raise WireError(self.sender, f"{self.kind.name} of tick {self.tick} came instead of {wanted}")
        return self


def check_name(name: str, what: str) -> str:
    """`name`, if it can be part of a key: ASCII letters, digits, `.`, `_` and `-`, at most 128.

    Raises:
        ValueError: it cannot.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"{what} {name!r}: write letters, digits, '.', '_' and '-' only, at most 128 of them")
    return name


def _names(run: str, sender: str, receiver: str) -> bytes:
    """The names as they follow the head, padded so that the body begins at a multiple of 8 bytes."""
    names = (run + sender + receiver).encode("ascii")
    return names + bytes(-(_HEAD.size + len(names)) % 8)


def _checksum(frame: memoryview) -> int:
    """CRC-32 of everything but the checksum itself."""
    return zlib.crc32(frame[_AFTER_CHECKSUM:], zlib.crc32(frame[:_CHECKSUM_AT]))


class _Stream:
    """One direction between two processes: its constant names and the number of its next message."""

    def __init__(self, run: str, sender: str, receiver: str) -> None:
        self.lengths = (len(run), len(sender), len(receiver))
        self.names = _names(run, sender, receiver)
        self.body_at = _HEAD.size + len(self.names)
        self.next = 0


class Streams:
    """Numbers and encodes what one process sends, decodes and checks what it receives. Pure.

    Args:
        run: identifies the run.
        name: of this process.
    """

    def __init__(self, run: str, name: str) -> None:
        self.run = check_name(run, "run")
        self.name = check_name(name, "process")
        self._outgoing: dict[str, _Stream] = {}
        self._incoming: dict[str, _Stream] = {}

    def encode(self, receiver: str, kind: Kind, tick: int, parts: Sequence[Part]) -> bytes:
        """The next message to `receiver`."""
        stream = self._outgoing.get(receiver)
        if stream is None:
            stream = _Stream(self.run, self.name, check_name(receiver, "process"))
            self._outgoing[receiver] = stream
        frame = bytearray().join((bytes(_HEAD.size), stream.names, *parts))
        size = len(frame) - stream.body_at
        _HEAD.pack_into(frame, 0, _MAGIC, VERSION, kind, 0, 0, *stream.lengths, 0, tick, stream.next, size)
        frame[_CHECKSUM_AT:_AFTER_CHECKSUM] = _checksum(memoryview(frame)).to_bytes(4, "little")
        stream.next += 1
        return bytes(frame)

    def decode(self, sender: str, frame: Part) -> Envelope:
        """The next message of `sender`.

        Args:
            sender: whose it is, as known from the way it came.
            frame: as it came.

        Raises:
            WireError: it is damaged, of another run, version, sender or receiver, or not the next one.
        """
        view = memoryview(frame).toreadonly()
        _check_whole(sender, view)
        _, _, kind, zero, _, *lengths, also_zero, tick, sequence, size = _HEAD.unpack_from(view)
        stream = self._incoming.get(sender)
        if stream is None:
            stream = _Stream(self.run, sender, self.name)
        if tuple(lengths) != stream.lengths or bytes(view[_HEAD.size : stream.body_at]) != stream.names:
            raise WireError(sender, self._foreign(sender, view, lengths))
        if zero or also_zero:
            raise WireError(sender, "there are no zeros where the head has none of its fields")
        if size != len(view) - stream.body_at:
            raise WireError(sender, f"{len(view) - stream.body_at} bytes of body, not {size}")
        if kind not in Kind._value2member_map_:
            raise WireError(sender, f"unknown kind {kind}")
        if sequence != stream.next:
            raise WireError(sender, _out_of_order(sequence, stream.next))
        stream.next += 1
        self._incoming[sender] = stream
        return Envelope(sender, self.name, Kind(kind), tick, sequence, view[stream.body_at :])

    def forget(self, name: str) -> None:
        """Begin anew in both directions: another process takes the name."""
        self._outgoing.pop(name, None)
        self._incoming.pop(name, None)

    def _foreign(self, sender: str, view: memoryview, lengths: Sequence[int]) -> str:
        """What is wrong with the names."""
        found, begin = [], _HEAD.size
        for length in lengths:
            found.append(bytes(view[begin : begin + length]).decode("ascii", "replace"))
            begin += length
        for what, is_, should in zip(("run", "sender", "receiver"), found, (self.run, sender, self.name), strict=True):
            if is_ != should:
                return f"its {what} is {is_!r}, not {should!r}"
        return "zeros are missing after the names"


def _check_whole(sender: str, view: memoryview) -> None:
    """Magic number, checksum and version, which every version of the protocol has in the same place."""
    if len(view) < _HEAD.size:
        raise WireError(sender, f"cut off after {len(view)} bytes")
    if bytes(view[:4]) != _MAGIC:
        raise WireError(sender, "not a message of this protocol, or its beginning is damaged")
    if int.from_bytes(view[_CHECKSUM_AT:_AFTER_CHECKSUM], "little") != _checksum(view):
        raise WireError(sender, "damaged or cut off: the checksum does not match")
    version = int.from_bytes(view[4:6], "little")
    if version != VERSION:
        raise WireError(sender, f"it speaks version {version} of the protocol, this process version {VERSION}")


def _out_of_order(sequence: int, expected: int) -> str:
    if sequence < expected:
        return f"message {sequence} came again or too late, {expected} was next"
    if sequence == expected + 1:
        return f"message {expected} was lost or overtaken: {sequence} came in its place"
    return f"messages {expected} to {sequence - 1} were lost or overtaken: {sequence} came in their place"
