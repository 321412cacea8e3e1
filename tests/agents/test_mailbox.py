"""The freshest-stamp rule (eq. k_t) against its definition, for any order of arrival."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.agents.mailbox import Mailboxes, Updates
from network.messages import NEVER, Mail

PERIOD_NS = 100_000_000
SLOTS = 4
Pairs = list[tuple[int, int]]

arrivals = st.lists(st.tuples(st.integers(0, SLOTS - 1), st.integers(0, 20)), max_size=40)


def mail(agents: list[Pairs]) -> Mail:
    """One arrival a millisecond at each agent; the message carries its own slot and stamp."""
    pairs = [pair for agent in agents for pair in agent]
    slots = np.array([slot for slot, _ in pairs], dtype=np.int64)
    stamps = np.array([stamp for _, stamp in pairs], dtype=np.int64)
    times = np.array([i * 1_000_000 for agent in agents for i in range(len(agent))], dtype=np.int64)
    values = np.stack([slots, stamps], axis=1).astype(float).reshape(len(pairs), 2)
    return Mail(np.cumsum([0, *map(len, agents)]), times, slots, stamps, values)


def accepted(updates: Updates, agent: int) -> list[tuple[int, int, int]]:
    """Arrival, slot and stamp."""
    part = slice(updates.ends[agent], updates.ends[agent + 1])
    stamps = updates.content[part, 2].astype(int).tolist()
    return list(zip(updates.arrival_ns[part], updates.slot[part], stamps, strict=True))


def records(pairs: Pairs, before: Pairs) -> list[tuple[int, int, int]]:
    """By the definition, message by message."""
    freshest = dict.fromkeys(range(SLOTS), NEVER)
    found = []
    for i, (slot, stamp) in enumerate([*before, *pairs]):
        if stamp > freshest[slot]:
            freshest[slot] = stamp
            found.append((i, slot, stamp))
    return [((i - len(before)) * 1_000_000, slot, stamp) for i, slot, stamp in found if i >= len(before)]


@given(st.lists(st.tuples(arrivals, arrivals), max_size=4))
def test_keeps_the_largest_stamp_that_has_arrived(agents: list[tuple[Pairs, Pairs]]) -> None:
    """In one tick and in the next, agent by agent."""
    mailboxes = Mailboxes([SLOTS] * len(agents), PERIOD_NS)
    first = mailboxes.accept(mail([pairs for pairs, _ in agents]))
    second = mailboxes.accept(mail([pairs for _, pairs in agents]))
    for agent, (now, then) in enumerate(agents):
        assert accepted(first, agent) == records(now, [])
        assert accepted(second, agent) == records(then, now)
        largest = [max([stamp for s, stamp in now + then if s == slot], default=NEVER) for slot in range(SLOTS)]
        assert mailboxes.stamps[SLOTS * agent : SLOTS * (agent + 1)].tolist() == largest


def test_one_message_of_each_sender() -> None:
    """The common case: nothing is to be put in order."""
    mailboxes = Mailboxes([2, 0, 1], PERIOD_NS)
    assert accepted(mailboxes.accept(mail([[(1, 3), (0, 2)], [], [(0, 5)]])), 0) == [(0, 1, 3), (1_000_000, 0, 2)]
    later = mailboxes.accept(mail([[(0, 2), (1, 4)], [], [(0, 4)]]))
    assert [accepted(later, agent) for agent in range(3)] == [[(1_000_000, 1, 4)], [], []]


def test_update_carries_values_stamp_and_sample_time() -> None:
    updates = Mailboxes([SLOTS], PERIOD_NS).accept(mail([[(2, 7)]]))
    assert updates.content.tolist() == [[2.0, 7.0, 7.0, 0.7]]
