"""What goes between an agent and its component in another process: calls and results, in numbered frames.

A request is a header (its number, how many calls, how many bytes follow) and the calls: each the call, a variable and
how many numbers follow, or how many bytes of JSON. The reply has the request's number, and either, per call that
returns something, how many numbers, and these; or what went wrong, as JSON.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from cosim.components.component import Floats

MOST_BYTES = 1 << 26
"""A longer frame is a fault."""

_HEADER = struct.Struct("<III")
_CALL = struct.Struct("<HHI")
_COUNT = struct.Struct("<I")
_CHUNK = 1 << 16

FAULT = 0xFFFFFFFF
"""The count of a reply that says what went wrong."""

NO_VARIABLE = 0xFFFF


class Call(IntEnum):
    """What is asked for, by the methods of `Component`; those below `GET` return nothing."""

    OPEN = 1
    DECLARE = 2
    START = 3
    SET = 4
    ENTER_INITIALIZATION = 5
    EXIT_INITIALIZATION = 6
    STEP = 7
    SET_TIME = 8
    SET_STATES = 9
    ENTER_EVENT_MODE = 10
    ENTER_CONTINUOUS_TIME_MODE = 11
    ENTER_STEP_MODE = 12
    STEP_IN_HALVES = 13
    TERMINATE = 14
    SAVE = 15
    RESTORE = 16
    FORGET = 17
    GET = 20
    GET_STATES = 21
    DERIVATIVES = 22
    EVENT_INDICATORS = 23
    COMPLETED_STEP = 24
    UPDATE_DISCRETE_STATES = 25
    SIZES = 26


WITH_JSON = frozenset({Call.OPEN, Call.DECLARE, Call.START})


class ProtocolError(Exception):
    """The other side says what it must not."""


class Closed(Exception):  # noqa: N818 - it is what happens at the end
    """The other side is gone."""


class TooLate(Exception):  # noqa: N818 - what happened, not what is wrong
    """The deadline has passed."""


# --- frames -----------------------------------------------------------------------------------------------------------
class Channel:
    """One end of the pair of sockets."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._rest = b""

    def send(self, number: int, count: int, body: bytes, deadline: float | None = None) -> None:
        """Send a frame.

        Raises:
            Closed: nobody reads any more.
            TooLate: the other side has not read it within `deadline` seconds.
        """
        try:
            self._socket.settimeout(deadline)
            self._socket.sendall(_HEADER.pack(number & 0xFFFFFFFF, count, len(body)) + body)
        except TimeoutError as error:
            raise TooLate from error
        except OSError as error:
            raise Closed from error

    def receive(self, deadline: float | None = None) -> tuple[int, int, bytes]:
        """Number, count and body of the next frame.

        Raises:
            Closed: there is none any more.
            TooLate: it has not come within `deadline` seconds.
            ProtocolError: it is too long.
        """
        end = None if deadline is None else time.monotonic() + deadline
        self._fill(_HEADER.size, end)
        number, count, length = _HEADER.unpack_from(self._rest)
        if length > MOST_BYTES:
            raise ProtocolError(f"a frame of {length} bytes")
        size = _HEADER.size + length
        self._fill(size, end)
        frame, self._rest = self._rest[_HEADER.size : size], self._rest[size:]
        return number, count, frame

    def _fill(self, size: int, end: float | None) -> None:
        while len(self._rest) < size:
            left = None if end is None else end - time.monotonic()
            if left is not None and left <= 0:
                raise TooLate
            try:
                self._socket.settimeout(left)
                data = self._socket.recv(max(_CHUNK, size - len(self._rest)))
            except TimeoutError as error:
                raise TooLate from error
            except OSError as error:
                raise Closed from error
            if not data:
                raise Closed
            self._rest = self._rest + data if self._rest else data

    def close(self) -> None:
        """The other side sees its end."""
        self._socket.close()


# --- calls ------------------------------------------------------------------------------------------------------------
def call(what: Call, variable: int = NO_VARIABLE, values: Floats | tuple[float, ...] = ()) -> bytes:
    """A call with numbers."""
    if not len(values):
        return _CALL.pack(what, variable, 0)
    numbers = values.tobytes() if isinstance(values, np.ndarray) else struct.pack(f"<{len(values)}d", *values)
    return _CALL.pack(what, variable, len(numbers) // 8) + numbers


def call_with_json(what: Call, tree: Mapping[str, Any], variable: int = NO_VARIABLE) -> bytes:
    """A call with anything else."""
    text = json.dumps(tree).encode()
    return _CALL.pack(what, variable, len(text)) + text


def calls(count: int, body: bytes) -> Iterator[tuple[Call, int, Any]]:
    """Call, variable, and numbers or JSON of each.

    Raises:
        ProtocolError: the body does not hold so many.
    """
    at = 0
    try:
        for _ in range(count):
            what, variable, n = _CALL.unpack_from(body, at)
            at += _CALL.size
            if what in WITH_JSON:
                yield Call(what), variable, json.loads(body[at : at + n])
                at += n
            else:
                yield Call(what), variable, np.frombuffer(body, np.float64, n, at)
                at += 8 * n
    except (struct.error, ValueError) as error:
        raise ProtocolError(f"no such call: {error}") from error


# --- results ----------------------------------------------------------------------------------------------------------
def result(values: Floats) -> bytes:
    """One result."""
    return _COUNT.pack(len(values)) + values.tobytes()


def results(count: int, body: bytes) -> list[Floats]:
    """All of them.

    Raises:
        ProtocolError: the body does not hold so many, or more.
    """
    at, found = 0, []
    try:
        for _ in range(count):
            (n,) = _COUNT.unpack_from(body, at)
            found.append(np.frombuffer(body, np.float64, n, at + _COUNT.size))
            at += _COUNT.size + 8 * n
    except (struct.error, ValueError) as error:
        raise ProtocolError(f"results are cut off: {error}") from error
    if at != len(body):
        raise ProtocolError("more than the results")
    return found


def fault(body: bytes) -> Mapping[str, Any]:
    """What went wrong.

    Raises:
        ProtocolError: it does not say.
    """
    try:
        tree = json.loads(body)
    except ValueError as error:
        raise ProtocolError("a fault that cannot be read") from error
    if not isinstance(tree, dict) or not isinstance(tree.get("message"), str):
        raise ProtocolError("a fault without a message")
    return tree
