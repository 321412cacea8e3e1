"""The master answers in turn, whatever the order of the samples, and notices whatever is out of turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.master import Advance, Emulate, Finish, Master, SequenceError
from network.messages import Exchange, Fates, Mail

NOBODY = np.empty(0, dtype=np.int64)


def exchange(tick: int, n_agents: int, width: int) -> Exchange:
    mail = Mail(np.zeros(n_agents + 1, np.int64), NOBODY, NOBODY, NOBODY, np.empty((0, width)))
    return Exchange(tick, mail, Fates(NOBODY, NOBODY, NOBODY, NOBODY, NOBODY, NOBODY))


@given(st.lists(st.integers(0, 3), min_size=1, max_size=6), st.integers(0, 5), st.randoms(use_true_random=False))
def test_any_order_of_samples_gives_the_same_instructions(sizes: list[int], ticks: int, random: object) -> None:
    """Blocks of agents publish in any order; all samples lie in the order of the agents."""
    master = Master(sizes, 2, ticks)
    n_agents, firsts = sum(sizes), [sum(sizes[:block]) for block in range(len(sizes))]
    for tick in range(ticks + 1):
        samples = [
            np.array([[first + i, tick] for i in range(size)], dtype=float).reshape(size, 2)
            for first, size in zip(firsts, sizes, strict=True)
        ]
        order = list(range(len(sizes)))
        random.shuffle(order)  # type: ignore[attr-defined]
        for block in order[:-1]:
            assert master.published(block, tick, samples[block]) is None
        answer = master.published(order[-1], tick, samples[order[-1]])
        if tick == ticks:
            assert answer == Finish(ticks)
            return
        assert isinstance(answer, Emulate)
        assert answer.values.tolist() == [[float(a), float(tick)] for a in range(n_agents)]
        came = exchange(tick, n_agents, 2)
        assert master.exchanged(came) == Advance(tick, came.mail)


def test_out_of_turn_is_refused() -> None:
    master = Master([1, 1], 1, 3)
    one = np.ones((1, 1))
    with pytest.raises(SequenceError, match="out of turn"):
        master.exchanged(exchange(0, 2, 1))
    with pytest.raises(SequenceError, match="tick 1 out of turn"):
        master.published(0, 1, one)
    with pytest.raises(SequenceError, match=r"\(1, 2\) numbers, not \(1, 1\)"):
        master.published(0, 0, np.ones((1, 2)))
    master.published(0, 0, one)
    with pytest.raises(SequenceError, match="block 0 published"):
        master.published(0, 0, one)
    master.published(1, 0, one)
    with pytest.raises(SequenceError, match="exchange of tick 1"):
        master.exchanged(exchange(1, 2, 1))
    master.exchanged(exchange(0, 2, 1))
    with pytest.raises(SequenceError):
        master.exchanged(exchange(0, 2, 1))
