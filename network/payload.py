"""How numbers are written on plain Zenoh keys, for programs that are no part of a run: JSON, raw floats, CDR of ROS 2.

The formats are described for others in docs/bridge.md. Pure: bytes in, numbers out; what comes from outside is checked
before it is used, and nothing is ever unpickled.
"""

from __future__ import annotations

import json
import math
from enum import StrEnum
from typing import Any

import numpy as np

from network.messages import Floats
from network.units import to_seconds

DEEPEST = 8
"""How deep lists may be nested."""


class Encoding(StrEnum):
    """The format of a key's payloads."""

    JSON = "json"
    FLOAT64 = "float64"  # little endian
    CDR = "cdr"  # a std_msgs/Float64MultiArray, as ROS 2 writes it

    @property
    def mime(self) -> str:
        """What Zenoh's own field `encoding` says."""
        return _MIME[self]


_MIME = {
    Encoding.JSON: "application/json",
    Encoding.FLOAT64: "application/octet-stream",
    Encoding.CDR: "application/cdr",
}
_UNSAID = frozenset({"", "zenoh/bytes"})
_TEXT = frozenset({"text/json", "text/plain", "zenoh/string"})
_SENDER = b"netcosim bridge."
_CDR_LITTLE, _CDR_BIG = b"\x00\x01", b"\x00\x00"


class PayloadError(ValueError):
    """A payload that must not be used; the message says why."""


def encode(encoding: Encoding, tick: int, time_ns: int, values: Floats) -> bytes:
    """The payload of a variable at a tick.

    Args:
        encoding: the format.
        tick: at which the values were sampled; JSON alone carries it.
        time_ns: the simulated time of that tick.
        values: (n,) finite.
    """
    if encoding is Encoding.JSON:
        content = {"tick": tick, "time": to_seconds(time_ns), "value": values.tolist()}
        return json.dumps(content, separators=(",", ":")).encode()
    numbers = values.astype("<f8").tobytes()
    if encoding is Encoding.FLOAT64:
        return numbers
    # no dimensions, data_offset 0, the count; numbers are aligned to 8 bytes after the encapsulation header
    head = np.array([0, 0, len(values)], "<u4").tobytes()
    return _CDR_LITTLE + b"\x00\x00" + head + (b"\x00" * 4 + numbers if len(values) else b"")


def attachment(encoding: Encoding, tick: int, time_ns: int) -> bytes | None:
    """What rmw_zenoh wants beside a payload: sequence number, source time and the sender's identifier of 16 bytes."""
    if encoding is not Encoding.CDR:
        return None
    return np.array([tick + 1, time_ns], "<i8").tobytes() + bytes([len(_SENDER)]) + _SENDER


def decode(encoding: Encoding, said: str, payload: bytes, size: int) -> Floats:
    """The (size,) numbers in a payload, all finite.

    Args:
        encoding: the format that is expected.
        said: what Zenoh's own field says; a publisher that leaves it out is taken at its word.
        payload: as it came.
        size: how many numbers there must be.

    Raises:
        PayloadError: it is something else.
    """
    said = said.partition(";")[0]
    known = {encoding.mime, *_UNSAID, *(_TEXT if encoding is Encoding.JSON else ())}
    if said not in known:
        raise PayloadError(f"it is {said}, not {encoding.mime}")
    if encoding is Encoding.JSON:
        values = _from_json(payload)
    elif encoding is Encoding.FLOAT64:
        values = _from_float64(payload)
    else:
        values = _from_cdr(payload)
    if len(values) != size:
        raise PayloadError(f"it has {_numbers(len(values))}, not {size}")
    if not np.isfinite(values).all():
        raise PayloadError("it has a number that is not finite")
    return values


def largest(size: int) -> int:
    """No sensible payload of `size` numbers has more bytes."""
    return 4096 + 64 * size


def _from_json(payload: bytes) -> Floats:
    """The member `value` of an object, or the whole: a number, or a list (of lists) of numbers."""
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise PayloadError(f"it is no JSON: {error}") from None
    if isinstance(content, dict):
        if "value" not in content:
            raise PayloadError("it has no member 'value'")
        content = content["value"]
    values: list[float] = []
    _flatten(content, values, 0)
    return np.array(values, np.float64)


def _flatten(content: Any, values: list[float], depth: int) -> None:
    if isinstance(content, list) and depth < DEEPEST:
        for inner in content:
            _flatten(inner, values, depth + 1)
    elif isinstance(content, (int, float)):
        try:
            values.append(float(content))
        except OverflowError:
            values.append(math.inf)
    else:
        kind = {str: "text", dict: "an object", type(None): "null"}.get(type(content), "nested too deeply")
        raise PayloadError(f"its value is {kind}; write a number or a list of numbers")


def _from_float64(payload: bytes) -> Floats:
    if len(payload) % 8:
        raise PayloadError(f"it has {len(payload)} bytes, not 8 per number")
    return np.frombuffer(payload, "<f8").astype(np.float64)


def _from_cdr(payload: bytes) -> Floats:
    """The data of a std_msgs/Float64MultiArray: its dimensions are skipped."""
    order = {_CDR_LITTLE: "<", _CDR_BIG: ">"}.get(payload[:2])
    if order is None or len(payload) < 4:
        raise PayloadError("it does not begin as plain CDR does")
    body, at = payload[4:], 0

    def word() -> int:
        nonlocal at
        at += -at % 4
        if at + 4 > len(body):
            raise PayloadError("it is cut off")
        value = int(np.frombuffer(body, f"{order}u4", 1, at)[0])
        at += 4
        return value

    dimensions = word()
    for _ in range(dimensions):  # ends at the latest with the bytes: each takes some
        label = word()
        at += label
        word(), word()  # size and stride
    word()  # data_offset
    count = word()
    at += -at % 8 if count else 0
    if at + 8 * count > len(body):
        raise PayloadError("it is cut off")
    return np.frombuffer(body, f"{order}f8", count, at).astype(np.float64) if count else np.zeros(0)


def _numbers(count: int) -> str:
    return "1 number" if count == 1 else f"{count} numbers"
