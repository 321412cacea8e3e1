"""What is written for others, and what of theirs is taken."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.bridge.live import checked
from cosim.plan import Subscription
from network.payload import Encoding, PayloadError, attachment, decode, encode
from network.plain import Arrival

finite = st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=6)


@given(finite, st.sampled_from(Encoding))
def test_every_format_gives_back_the_bits(numbers: list[float], encoding: Encoding) -> None:
    values = np.array(numbers, np.float64)
    back = decode(encoding, encoding.mime, encode(encoding, 7, 700_000_000, values), len(values))
    assert back.tobytes() == values.tobytes()


@given(st.binary(max_size=80), st.sampled_from(Encoding))
def test_any_bytes_are_taken_or_refused(payload: bytes, encoding: Encoding) -> None:
    try:
        values = decode(encoding, "", payload, 2)
    except PayloadError:
        return
    assert values.shape == (2,)
    assert np.isfinite(values).all()


@pytest.mark.parametrize("text", ["[1, 2]", '{"value": [1, 2], "tick": 3}', "[[1], [2]]", " [1.0, 2e0]\n"])
@pytest.mark.parametrize("said", ["", "zenoh/bytes", "application/json", "application/json;charset=utf-8"])
def test_json_that_is_taken(text: str, said: str) -> None:
    assert decode(Encoding.JSON, said, text.encode(), 2).tolist() == [1.0, 2.0]


def test_a_number_alone_is_taken() -> None:
    assert decode(Encoding.JSON, "", b"0.5", 1).tolist() == [0.5]


@pytest.mark.parametrize(
    ("encoding", "said", "payload", "why"),
    [
        (Encoding.JSON, "", b"[1, 2", "it is no JSON"),
        (Encoding.JSON, "", b"[1]", "it has 1 number, not 2"),
        (Encoding.JSON, "", b"[1, NaN]", "not finite"),
        (Encoding.JSON, "", b"[1, -Infinity]", "not finite"),
        (Encoding.JSON, "", b"[1, 1e400]", "not finite"),
        (Encoding.JSON, "", b"[1, %s]" % (b"9" * 400), "not finite"),
        (Encoding.JSON, "", b'["1", 2]', "its value is text"),
        (Encoding.JSON, "", b"[1, null]", "its value is null"),
        (Encoding.JSON, "", b'{"v": 1}', "it has no member 'value'"),
        (Encoding.JSON, "", b"[" * 5000, "it is no JSON"),
        (Encoding.JSON, "", b"[" * 20 + b"]" * 20, "nested too deeply"),
        (Encoding.JSON, "", b"\xff", "it is no JSON"),
        (Encoding.JSON, "application/octet-stream", b"[1, 2]", "it is application/octet-stream, not application/json"),
        (Encoding.JSON, "application/python-serialized-object", b"[1, 2]", "it is application/python"),
        (Encoding.FLOAT64, "application/json", b"[1, 2]", "it is application/json"),
        (Encoding.FLOAT64, "", bytes(15), "it has 15 bytes"),
        (Encoding.FLOAT64, "", bytes(24), "it has 3 numbers, not 2"),
        (Encoding.FLOAT64, "", struct.pack("<2d", 1.0, float("nan")), "not finite"),
        (Encoding.CDR, "", b"", "does not begin as plain CDR"),
        (Encoding.CDR, "", b"\x00\x01\x00\x00" + b"\xff" * 12, "it is cut off"),
    ],
)
def test_what_is_refused(encoding: Encoding, said: str, payload: bytes, why: str) -> None:
    with pytest.raises(PayloadError) as caught:
        decode(encoding, said, payload, 2)
    assert why in str(caught.value)


def test_json_is_what_the_page_says() -> None:
    said = json.loads(encode(Encoding.JSON, 3, 300_000_000, np.array([0.1, -2.0])))
    assert said == {"tick": 3, "time": 0.3, "value": [0.1, -2.0]}


def test_cdr_is_a_float64_multi_array() -> None:
    """As ROS 2 writes it: encapsulation, no dimensions, offset 0, two numbers after padding."""
    head = bytes.fromhex("0001000000000000000000000200000000000000")
    assert encode(Encoding.CDR, 0, 0, np.array([1.0, -2.0])) == head + struct.pack("<2d", 1.0, -2.0)
    dimension = struct.pack("<I", 1) + struct.pack("<I", 2) + b"x\0" + b"\0\0" + struct.pack("<II", 2, 2)
    other = b"\x00\x01\x00\x00" + dimension + struct.pack("<II", 0, 2) + b"\0" * 4 + struct.pack("<2d", 1.0, -2.0)
    assert decode(Encoding.CDR, "", other, 2).tolist() == [1.0, -2.0]
    big = b"\x00\x00\x00\x00" + struct.pack(">III", 0, 0, 1) + b"\0" * 4 + struct.pack(">d", 3.5)
    assert decode(Encoding.CDR, "application/cdr", big, 1).tolist() == [3.5]


def test_the_attachment_that_rmw_zenoh_wants() -> None:
    said = attachment(Encoding.CDR, 4, 500)
    assert said is not None
    assert struct.unpack("<qqB", said[:17]) == (5, 500, 16)
    assert len(said) == 33


@pytest.mark.parametrize(
    ("low", "high", "whole", "payload", "why"),
    [
        (0.0, 1.0, True, b"2", "not from 0 to 1"),
        (-128.0, 127.0, True, b"1.5", "not whole"),
        (-128.0, 127.0, True, b"-129", "not from -128 to 127"),
    ],
)
def test_what_an_input_cannot_hold(low: float, high: float, whole: bool, payload: bytes, why: str) -> None:
    subscription = Subscription("x", Encoding.JSON, 1, low, high, whole)
    with pytest.raises(PayloadError, match=why):
        checked(subscription, Arrival("", len(payload), payload))
    assert checked(subscription, Arrival("", 4, b"true")).tolist() == [1.0]


def test_what_is_too_large_or_deletes_the_key() -> None:
    with pytest.raises(PayloadError, match="or deletes"):
        checked(Subscription("x", Encoding.JSON, 1, -1, 1, False), Arrival("", 10**9, None))
