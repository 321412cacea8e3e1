"""Bodies: what was sent comes out to the bit; whatever does not fit what the receiver knows is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from network.codec import (
    Block,
    decode_external,
    decode_fates,
    decode_mail,
    decode_object,
    decode_rows,
    decode_samples,
    encode_external,
    encode_fates,
    encode_mail,
    encode_object,
    encode_rows,
    encode_samples,
)
from network.envelope import Envelope, Kind, Part, Streams, WireError
from network.messages import NEVER, Deliveries, Fate, Fates, Floats, Ints, Mail

T = 100_000_000
N_AGENTS = 9
blocks = st.integers(0, 4).flatmap(
    lambda n: st.builds(
        Block,
        st.tuples(*[st.integers(0, 3)] * n),
        st.tuples(*[st.integers(0, 3)] * n),
        st.integers(0, 4),
        st.just(T),
    )
)


def sent(parts: list[Part], tick: int = 5, kind: Kind = Kind.SAMPLES) -> Envelope:
    """Through the wire."""
    frame = Streams("run", "worker-1").encode("emulator", kind, tick, parts)
    return Streams("run", "emulator").decode("worker-1", frame)


def floats(draw: Callable[..., Any], *shape: int) -> Floats:
    """Any numbers: infinities, negative zeros and NaNs among them."""
    values: Floats = draw(arrays.arrays(np.float64, shape, elements=st.floats()))
    return values


def ints(*values: int) -> Ints:
    return np.array(values, np.int64)


def same(a: Floats | Ints, b: Floats | Ints) -> bool:
    """Equal to the bit, and safe from being written to."""
    return (
        a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes() and not (b.size and b.flags.writeable)
    )


@st.composite
def deliveries(draw: st.DrawFn, block: Block, agent: int, tick: int) -> Deliveries:
    """Mail that the emulator could send."""
    n = draw(st.integers(0, 4)) if block.neighbours[agent] else 0
    arrival = np.sort(draw(arrays.arrays(np.int64, n, elements=st.integers(tick * T, (tick + 1) * T - 1))))
    slot = draw(arrays.arrays(np.int64, n, elements=st.integers(0, max(0, block.neighbours[agent] - 1))))
    stamp = draw(arrays.arrays(np.int64, n, elements=st.integers(0, tick)))
    return Deliveries(arrival, slot, stamp, floats(draw, n, block.width))


def joined(mail: Sequence[Deliveries]) -> Mail:
    """The deliveries of agents, one after the other."""
    if not mail:
        return Mail(ints(0), ints(), ints(), ints(), np.zeros((0, 0)))
    columns = ([getattr(some, name) for some in mail] for name in ("arrival_ns", "slot", "stamp", "values"))
    ends = np.cumsum([0, *map(len, mail)])
    return Mail(ends, *map(np.concatenate, columns))


@st.composite
def fates(draw: st.DrawFn, tick: int) -> Fates:
    """Fates that the emulator could tell at a tick."""
    n = draw(st.integers(0, 4))
    sender, receiver = (draw(arrays.arrays(np.int64, n, elements=st.integers(0, N_AGENTS - 1))) for _ in range(2))
    sent_at = draw(arrays.arrays(np.int64, n, elements=st.integers(0, tick)))
    fate = draw(arrays.arrays(np.int64, n, elements=st.sampled_from([int(fate) for fate in Fate])))
    arrival = draw(arrays.arrays(np.int64, n, elements=st.integers(0, 10**12)))
    return Fates(sender, receiver, sent_at // 2, sent_at, np.where(fate == Fate.LOST, NEVER, arrival), fate)


@st.composite
def pieces(draw: st.DrawFn, least: int, *shape: int) -> list[Floats]:
    """Ticks that follow each other, a few at a time."""
    sizes = draw(st.lists(st.integers(least, 3), min_size=least, max_size=3))
    return [floats(draw, size, *shape) for size in sizes]


@given(st.data(), blocks)
def test_samples_come_out(data: st.DataObject, block: Block) -> None:
    samples = data.draw(pieces(1, len(block), block.width))
    assert same(np.concatenate(samples), decode_samples(block, sent(encode_samples(block, samples))))


@given(st.data(), blocks, st.integers(0, 10), st.integers(1, 3))
def test_mail_comes_out(data: st.DataObject, block: Block, tick: int, n_ticks: int) -> None:
    mail = [data.draw(deliveries(block, agent, tick + i)) for i in range(n_ticks) for agent in range(len(block))]
    n_came, came = decode_mail(block, sent(encode_mail(joined(mail), n_ticks), tick))
    assert n_came == n_ticks
    assert len(came) == len(mail)
    for agent, (theirs, ours) in enumerate(zip(mail, came, strict=True)):
        assert same(ours.values, came[agent].values)
        assert same(theirs.arrival_ns, ours.arrival_ns)
        assert same(theirs.slot, ours.slot)
        assert same(theirs.stamp, ours.stamp)
        assert same(theirs.values, ours.values)


@given(st.data(), blocks)
def test_rows_come_out(data: st.DataObject, block: Block) -> None:
    rows = data.draw(pieces(0, sum(block.widths)))
    joined_rows = np.concatenate([np.empty((0, sum(block.widths))), *rows])
    assert same(joined_rows, decode_rows(block, sent(encode_rows(block, rows))))


@given(st.data(), st.integers(0, 10), st.integers(0, 3))
def test_fates_come_out(data: st.DataObject, tick: int, n_ticks: int) -> None:
    ticks = [data.draw(fates(tick + i)) for i in range(n_ticks)]
    counts, came = decode_fates(N_AGENTS, sent(encode_fates([*map(len, ticks)], ticks), tick))
    assert counts == [*map(len, ticks)]
    begin = 0
    for theirs in ticks:
        ours = came.between(begin, begin := begin + len(theirs))
        assert all(same(*columns) for columns in zip(theirs.columns, ours.columns, strict=True))
    assert begin == len(came)


@given(st.data(), st.lists(st.integers(1, 3), max_size=4))
def test_values_from_outside_come_out_and_leave_the_rest(data: st.DataObject, sizes: list[int]) -> None:
    finite = st.floats(allow_nan=False, allow_infinity=False)
    chosen = data.draw(st.sets(st.sampled_from(range(len(sizes))))) if sizes else set()
    taken = {index: data.draw(arrays.arrays(np.float64, sizes[index], elements=finite)) for index in chosen}
    found, rest = decode_external(sizes, sent([*encode_external(taken), b"the rest"]))
    assert found.keys() == taken.keys()
    assert all(same(taken[index], found[index]) for index in taken)
    assert bytes(rest.body) == b"the rest"


@pytest.mark.parametrize(
    ("body", "what"),
    [
        (b"", "has 0 bytes"),
        (ints(2, 0, 1).tobytes(), "bytes, at least"),
        (ints(-1).tobytes(), "does not exist"),
        (ints(2**62).tobytes(), "does not exist"),
        (ints(1, 2, 0, 0).tobytes(), "does not exist"),
        (ints(2, 1, 1, 0, 0).tobytes(), "or twice"),
        (ints(1, 0).tobytes() + np.array([np.nan]).tobytes(), "not finite"),
    ],
)
def test_values_from_outside_that_no_orchestrator_sends_are_refused(body: bytes, what: str) -> None:
    with pytest.raises(WireError, match=what):
        decode_external([1, 1], sent([body]))


def test_arrays_in_any_order_of_memory_come_out() -> None:
    block = Block((1, 1), (3, 3), 3, T)
    values = np.arange(12.0).reshape(6, 2).T[:, ::2][None]
    assert same(np.array(values), decode_samples(block, sent(encode_samples(block, [values]))))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=5,
)


@given(st.dictionaries(st.text(max_size=5), json_values, max_size=4))
def test_objects_come_out(content: dict[str, object]) -> None:
    assert decode_object(sent(encode_object(content))) == content


# --- what does not fit -------------------------------------------------------------------------------------------
BLOCK = Block((2, 0, 1), (1, 2, 0), 2, T)
MAIL = [
    Deliveries(ints(5 * T, 5 * T + 7), ints(1, 0), ints(4, 5), np.ones((2, 2))),
    Deliveries(ints(), ints(), ints(), np.ones((0, 2))),
    Deliveries(ints(5 * T + 3), ints(0), ints(0), np.ones((1, 2))),
]
FATES = Fates(ints(0, 8), ints(1, 0), ints(3, 5), ints(4, 5), ints(NEVER, 6 * T), ints(Fate.LOST, Fate.DELIVERED))
ROWS = [np.ones((2, 3)), np.ones((1, 3))]
GOOD: list[tuple[Callable[[Envelope], object], list[Part]]] = [
    (lambda envelope: decode_samples(BLOCK, envelope), encode_samples(BLOCK, [np.ones((2, 3, 2))])),
    (lambda envelope: decode_mail(BLOCK, envelope), encode_mail(joined(MAIL), 1)),
    (lambda envelope: decode_rows(BLOCK, envelope), encode_rows(BLOCK, ROWS)),
    (lambda envelope: decode_fates(N_AGENTS, envelope), encode_fates([2, 2], [FATES, FATES])),
    (decode_object, encode_object({"a": [1, 2]})),
]


@pytest.mark.parametrize(("decode", "parts"), GOOD)
def test_bodies_of_any_other_length_are_refused(decode: Callable[[Envelope], object], parts: list[Part]) -> None:
    body = b"".join(parts)
    decode(sent([body]))
    for other in [*(body[:length] for length in range(len(body))), body + b"\1", body + bytes(8)]:
        with pytest.raises(WireError, match=r"^message from worker-1: the body of SAMPLES of tick 5 "):
            decode(sent([other]))


@given(st.data(), st.sampled_from(GOOD))
def test_any_change_of_a_body_is_refused_or_harmless(
    data: st.DataObject, good: tuple[Callable[[Envelope], object], list[Part]]
) -> None:
    decode, parts = good
    body = bytearray(b"".join(parts) or b"\0" * 8)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(body) - 1))
        body[at] = data.draw(st.integers(0, 255))
    with suppress(WireError):
        decode(sent([body]))


def test_messages_of_no_tick_are_refused() -> None:
    with pytest.raises(WireError, match="announces 0 ticks"):
        decode_samples(BLOCK, sent(encode_samples(BLOCK, [np.ones((0, 3, 2))])))
    with pytest.raises(WireError, match="announces 0 ticks"):
        decode_mail(BLOCK, sent(encode_mail(joined([]), 0)))


def test_mail_of_a_tick_must_not_come_in_another() -> None:
    later = replace(MAIL[2], arrival_ns=ints(6 * T + 3))
    decode_mail(BLOCK, sent(encode_mail(joined([*MAIL, MAIL[1], MAIL[1], later]), 2)))
    with pytest.raises(WireError, match="arrives outside its tick"):
        decode_mail(BLOCK, sent(encode_mail(joined([*MAIL, *MAIL]), 2)))
    too_new = replace(later, stamp=ints(7))
    with pytest.raises(WireError, match="has an impossible stamp"):
        decode_mail(BLOCK, sent(encode_mail(joined([*MAIL, MAIL[1], MAIL[1], too_new]), 2)))


@pytest.mark.parametrize(
    ("column", "values", "what"),
    [
        ("arrival_ns", ints(5 * T - 1, 5 * T), "arrives outside its tick"),
        ("arrival_ns", ints(5 * T, 6 * T), "arrives outside its tick"),
        ("arrival_ns", ints(5 * T + 1, 5 * T), "arrives before the one ahead of it"),
        ("slot", ints(2, 0), "is from no in-neighbour"),
        ("slot", ints(-1, 0), "is from no in-neighbour"),
        ("stamp", ints(6, 0), "has an impossible stamp"),
        ("stamp", ints(0, -1), "has an impossible stamp"),
    ],
)
def test_mail_that_no_emulator_sends_is_refused(column: str, values: Ints, what: str) -> None:
    changes: dict[str, Any] = {column: values}
    mail = [replace(MAIL[0], **changes), *MAIL[1:]]
    with pytest.raises(WireError, match=f"the body of MAIL of tick 5 has a message that {what}"):
        decode_mail(BLOCK, sent(encode_mail(joined(mail), 1), kind=Kind.MAIL))


def test_mail_for_an_agent_without_neighbours_is_refused() -> None:
    with pytest.raises(WireError, match="is from no in-neighbour"):
        decode_mail(BLOCK, sent(encode_mail(joined([MAIL[1], MAIL[0], MAIL[1]]), 1)))


@pytest.mark.parametrize(
    ("column", "values", "what"),
    [
        ("sender", ints(0, N_AGENTS), "names no agent"),
        ("receiver", ints(-1, 0), "names no agent"),
        ("stamp", ints(3, 6), "has an impossible stamp"),
        ("stamp", ints(-1, 5), "has an impossible stamp"),
        ("sent", ints(4, 6), "has an impossible stamp"),
        ("fate", ints(Fate.LOST, len(Fate)), "has an unknown fate"),
        ("fate", ints(Fate.LOST, -1), "has an unknown fate"),
        ("fate", ints(Fate.DELIVERED, Fate.DELIVERED), "is lost and arrives, or neither"),
        ("arrival_ns", ints(NEVER, -2), "arrives before the run"),
    ],
)
def test_fates_that_no_emulator_tells_are_refused(column: str, values: Ints, what: str) -> None:
    with pytest.raises(WireError, match=f"has a message that {what}"):
        decode_fates(N_AGENTS, sent(encode_fates([2], [replace(FATES, **{column: values})])))


@pytest.mark.parametrize("count", [-1, 2**31, 2**62, 2**63 - 1])
def test_absurd_counts_are_refused_before_memory_is_asked_for(count: int) -> None:
    head: list[Part] = [ints(count).data]
    for decode in (lambda e: decode_rows(BLOCK, e), lambda e: decode_fates(N_AGENTS, e)):
        with pytest.raises(WireError, match="announces"):
            decode(sent(head))
    with pytest.raises(WireError, match="announces more than it holds"):
        decode_mail(BLOCK, sent([ints(1, count, count, count).data]))
    with pytest.raises(WireError, match="announces"):
        decode_mail(BLOCK, sent([ints(count, 0, 0, 0).data]))
    with pytest.raises(WireError, match="announces"):
        decode_samples(BLOCK, sent(head))


@pytest.mark.parametrize("tick", [-1, 2**62 // T + 1, 2**63 - 1, -(2**63)])
def test_ticks_beyond_any_run_are_refused(tick: int) -> None:
    with pytest.raises(WireError, match="is of no tick of any run"):
        decode_mail(BLOCK, sent(encode_mail(joined(MAIL), 1), tick))


@pytest.mark.parametrize("tick", [-1, 2**63 - 1])
def test_fates_beyond_any_run_are_refused(tick: int) -> None:
    with pytest.raises(WireError, match="is of no tick of any run"):
        decode_fates(N_AGENTS, sent(encode_fates([2], [FATES]), tick))


def test_rows_of_another_size_are_not_sent() -> None:
    with pytest.raises(ValueError, match="rows must have 3 numbers"):
        encode_rows(BLOCK, [np.ones((1, 3)), np.ones((1, 2))])


def test_samples_of_another_shape_are_not_sent() -> None:
    with pytest.raises(ValueError, match=r"samples must have the shape \(3, 2\)"):
        encode_samples(BLOCK, [np.ones((1, 2, 3))])


@pytest.mark.parametrize("body", [b"\xff", b"[1]", b"1", b"", b"{", b"[" * 100_000])
def test_what_is_no_object_is_refused(body: bytes) -> None:
    with pytest.raises(WireError, match="is not"):
        decode_object(sent([body]))
