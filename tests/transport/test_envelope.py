"""Envelopes: what was sent comes out; whatever happens to it on the way is noticed and named."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from network.envelope import VERSION, Envelope, Kind, Streams, WireError, check_name

names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,20}", fullmatch=True)
ticks = st.integers(-(2**63), 2**63 - 1)
bodies = st.lists(st.binary(max_size=40), max_size=4)
MAGIC = b"nCoS"


def frame(number: int = 0, body: bytes = b"12345678", run: str = "run") -> bytes:
    """Message `number` of the stream from worker-1 to the emulator."""
    streams = Streams(run, "worker-1")
    frames = [streams.encode("emulator", Kind.SAMPLES, tick, [body]) for tick in range(number + 1)]
    return frames[-1]


def refusal(damaged: bytes, after: int = 0) -> str:
    """Why the emulator refuses a frame, having received `after` good ones."""
    emulator = Streams("run", "emulator")
    for number in range(after):
        emulator.decode("worker-1", frame(number))
    with pytest.raises(WireError) as error:
        emulator.decode("worker-1", damaged)
    assert error.value.sender == "worker-1"
    assert "worker-1" in str(error.value)
    return error.value.what


def sealed(changed: bytearray) -> bytes:
    """A frame whose checksum fits what it says, as from somebody who means it."""
    changed[8:12] = zlib.crc32(changed[12:], zlib.crc32(changed[:8])).to_bytes(4, "little")
    return bytes(changed)


@given(names, names, names, st.lists(st.tuples(st.sampled_from(Kind), ticks, bodies), max_size=5))
def test_what_is_sent_comes_out(
    run: str, sender: str, receiver: str, messages: list[tuple[Kind, int, list[bytes]]]
) -> None:
    here, there = Streams(run, sender), Streams(run, receiver)
    for number, (kind, tick, parts) in enumerate(messages):
        envelope = there.decode(sender, here.encode(receiver, kind, tick, parts))
        assert envelope == Envelope(sender, receiver, kind, tick, number, memoryview(b"".join(parts)))
        assert envelope.body.readonly


@given(names, names, names)
def test_bodies_are_aligned(run: str, sender: str, receiver: str) -> None:
    body = b"body"
    assert (len(Streams(run, sender).encode(receiver, Kind.ROWS, 0, [body])) - len(body)) % 8 == 0


def test_every_flipped_bit_is_noticed() -> None:
    good = frame()
    for at in range(len(good)):
        for bit in range(8):
            damaged = bytearray(good)
            damaged[at] ^= 1 << bit
            assert "damaged" in refusal(bytes(damaged))


def test_every_truncation_and_extension_is_noticed() -> None:
    good = frame()
    for length in range(len(good)):
        assert "cut off" in refusal(good[:length])
    assert "damaged" in refusal(good + b"\0")


@given(st.binary(max_size=200))
def test_noise_is_refused(noise: bytes) -> None:
    assert refusal(noise)
    assert refusal(MAGIC + noise)


def test_another_version_is_refused_with_both_named() -> None:
    other = bytearray(frame())
    other[4:6] = (VERSION + 6).to_bytes(2, "little")
    assert refusal(sealed(other)) == f"it speaks version {VERSION + 6} of the protocol, this process version {VERSION}"


def test_another_run_sender_or_receiver_is_refused() -> None:
    assert refusal(frame(run="ruin")) == "its run is 'ruin', not 'run'"
    assert refusal(frame(run="nur")) == "its run is 'nur', not 'run'"
    stranger = Streams("run", "worker-2").encode("emulator", Kind.SAMPLES, 0, [])
    assert refusal(stranger) == "its sender is 'worker-2', not 'worker-1'"
    astray = Streams("run", "worker-1").encode("worker-2", Kind.SAMPLES, 0, [])
    assert refusal(astray) == "its receiver is 'worker-2', not 'emulator'"


def test_a_gap_a_repeat_and_an_overtaking_are_told_apart() -> None:
    assert refusal(frame(1)) == "message 0 was lost or overtaken: 1 came in its place"
    assert refusal(frame(3), after=1) == "messages 1 to 2 were lost or overtaken: 3 came in their place"
    assert refusal(frame(1), after=2) == "message 1 came again or too late, 2 was next"


def test_a_refused_message_does_not_count() -> None:
    emulator = Streams("run", "emulator")
    with pytest.raises(WireError):
        emulator.decode("worker-1", frame(1))
    assert emulator.decode("worker-1", frame(0)).sequence == 0
    assert emulator.decode("worker-1", frame(1)).sequence == 1


def test_whoever_means_it_is_refused_as_well() -> None:
    body_at = len(frame(body=b""))
    for at, value, what in [
        (6, b"\xff", "unknown kind 255"),
        (6, b"\x00", "unknown kind 0"),
        (7, b"\x01", "zeros"),
        (15, b"\x01", "zeros"),
        (body_at - 1, b"\x01", "zeros"),
        (32, struct.pack("<Q", 2**64 - 1), "8 bytes of body, not"),
        (12, b"\xff\xff\xff", "its run is"),
    ]:
        changed = bytearray(frame())
        changed[at : at + len(value)] = value
        assert what in refusal(sealed(changed))


def test_the_wrong_tick_or_kind_is_named() -> None:
    envelope = Streams("run", "emulator").decode("worker-1", frame())
    assert envelope.expect(Kind.SAMPLES, 0) is envelope
    assert envelope.expect(Kind.SAMPLES) is envelope
    with pytest.raises(WireError, match="message from worker-1: SAMPLES of tick 0 came instead of SAMPLES of tick 1"):
        envelope.expect(Kind.SAMPLES, 1)
    with pytest.raises(WireError, match="came instead of DONE"):
        envelope.expect(Kind.DONE)


@pytest.mark.parametrize("name", ["", "a/b", "a*", "@a", "ä", "-a", "a b", "x" * 129, "a\n"])
def test_names_that_are_no_part_of_a_key_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="write letters"):
        check_name(name, "process")
