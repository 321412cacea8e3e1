"""The freshest-stamp rule (eq. k_t) against its definition, for any order of arrival."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.mailbox import Mailbox
from network.messages import NEVER, Deliveries

PERIOD_NS = 100_000_000

arrivals = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 20)), max_size=40)


def deliveries(pairs: list[tuple[int, int]]) -> Deliveries:
    """One arrival a millisecond; the message carries its own slot and stamp."""
    slots = np.array([slot for slot, _ in pairs], dtype=np.int64)
    stamps = np.array([stamp for _, stamp in pairs], dtype=np.int64)
    times = np.arange(len(pairs), dtype=np.int64) * 1_000_000
    return Deliveries(times, slots, stamps, np.stack([slots, stamps], axis=1).astype(float).reshape(len(pairs), 2))


@given(arrivals)
def test_keeps_the_largest_stamp_that_has_arrived(pairs: list[tuple[int, int]]) -> None:
    mailbox = Mailbox(4, PERIOD_NS)
    updates = mailbox.accept(deliveries(pairs))
    for slot in range(4):
        stamps = [stamp for s, stamp in pairs if s == slot]
        assert mailbox.stamps[slot] == max(stamps, default=NEVER)
        accepted = updates.stamp[updates.slot == slot].tolist()
        assert accepted == sorted(set(accepted)), "every accepted stamp is fresher than the one before"
        records = [s for i, s in enumerate(stamps) if s > max(stamps[:i], default=NEVER)]
        assert accepted == records


@given(arrivals, st.integers(0, 40))
def test_cutting_the_stream_anywhere_changes_nothing(pairs: list[tuple[int, int]], cut: int) -> None:
    whole, parts = Mailbox(4, PERIOD_NS), Mailbox(4, PERIOD_NS)
    together = whole.accept(deliveries(pairs))
    first, second = parts.accept(deliveries(pairs[:cut])), parts.accept(deliveries(pairs[cut:]))
    assert together.stamp.tolist() == first.stamp.tolist() + second.stamp.tolist()
    assert whole.stamps == parts.stamps


def test_update_carries_sample_time_and_values() -> None:
    updates = Mailbox(4, PERIOD_NS).accept(deliveries([(2, 7)]))
    assert updates.time.tolist() == [0.7]
    assert updates.values.tolist() == [[2.0, 7.0]]


@pytest.mark.parametrize(
    "pairs", [[(0, 1), (1, 2), (2, 3)], [(0, 2), (0, 1), (1, 5)]], ids=["all accepted", "one stale"]
)
def test_updates_are_contiguous_whatever_the_deliveries_are_views_of(pairs: list[tuple[int, int]]) -> None:
    """The native loop reads them by address; the emulator hands out columns of a table."""
    plain = deliveries(pairs)
    columns = np.stack([plain.arrival_ns, plain.slot, plain.stamp], axis=1)
    strided = Deliveries(columns[:, 0], columns[:, 1], columns[:, 2], np.asfortranarray(plain.values))
    expected, updates = Mailbox(4, PERIOD_NS).accept(plain), Mailbox(4, PERIOD_NS).accept(strided)
    for name in ("arrival_ns", "slot", "stamp", "time", "values"):
        array = getattr(updates, name)
        assert array.flags.c_contiguous, name
        assert np.array_equal(array, getattr(expected, name)), name
