"""The master answers in turn, whatever the order of the samples, and notices whatever is out of turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.master import Advance, Emulate, Finish, Master, SequenceError
from network.messages import Deliveries, Exchange, Fates

NOBODY = np.empty(0, dtype=np.int64)


def exchange(tick: int, n_agents: int, width: int) -> Exchange:
    nothing = Deliveries(NOBODY, NOBODY, NOBODY, np.empty((0, width)))
    return Exchange(tick, (nothing,) * n_agents, Fates(NOBODY, NOBODY, NOBODY, NOBODY, NOBODY, NOBODY))


@given(st.integers(1, 6), st.integers(0, 5), st.randoms(use_true_random=False))
def test_any_order_of_samples_gives_the_same_instructions(n_agents: int, ticks: int, random: object) -> None:
    master = Master(n_agents, 2, ticks)
    for tick in range(ticks + 1):
        order = list(range(n_agents))
        random.shuffle(order)  # type: ignore[attr-defined]
        for agent in order[:-1]:
            assert master.published(agent, tick, np.array([agent, tick], dtype=float)) is None
        assert master.waiting_for == {order[-1]}
        answer = master.published(order[-1], tick, np.array([order[-1], tick], dtype=float))
        if tick == ticks:
            assert answer == Finish(ticks)
            return
        assert isinstance(answer, Emulate)
        assert answer.values.tolist() == [[float(a), float(tick)] for a in range(n_agents)]
        advances = master.exchanged(exchange(tick, n_agents, 2))
        assert [(x.tick, x.agent) for x in advances] == [(tick, a) for a in range(n_agents)]
        assert all(isinstance(x, Advance) for x in advances)


def test_agents_that_nobody_hears_leave_zeros() -> None:
    master = Master(2, 2, 1)
    master.published(0, 0, np.empty(0))
    answer = master.published(1, 0, np.array([1.0, 2.0]))
    assert isinstance(answer, Emulate)
    assert answer.values.tolist() == [[0.0, 0.0], [1.0, 2.0]]


def test_out_of_turn_is_refused() -> None:
    master = Master(2, 1, 3)
    one = np.ones(1)
    with pytest.raises(SequenceError, match="out of turn"):
        master.exchanged(exchange(0, 2, 1))
    with pytest.raises(SequenceError, match="tick 1 out of turn"):
        master.published(0, 1, one)
    with pytest.raises(SequenceError, match="2 numbers, not 1"):
        master.published(0, 0, np.ones(2))
    master.published(0, 0, one)
    with pytest.raises(SequenceError, match="agent 0 published"):
        master.published(0, 0, one)
    master.published(1, 0, one)
    with pytest.raises(SequenceError, match="exchange of tick 1"):
        master.exchanged(exchange(1, 2, 1))
    master.exchanged(exchange(0, 2, 1))
    with pytest.raises(SequenceError):
        master.exchanged(exchange(0, 2, 1))
