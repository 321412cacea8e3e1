"""Joint rootedness against the definition, window by window."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network.connectivity import connectivity, unreached, updates, window_of
from network.freshness import EdgeLog, Span
from network.messages import Fate
from network.window import Window
from tests.network.networks import T, dense_links, links_of, logs_of


def _log(arrivals: list[int]) -> EdgeLog:
    """A sample that arrives at each of these times, fresh."""
    n = len(arrivals)
    stamps = np.array([time // T for time in arrivals], np.int64)
    return EdgeLog(stamps, stamps, np.array(arrivals, np.int64), np.full(n, Fate.DELIVERED))


def test_an_update_counts_at_the_tick_at_or_after_its_arrival() -> None:
    grew = updates([_log([0, T // 2, 2 * T, 2 * T + 1])], Span(5, T))
    assert np.flatnonzero(grew[:, 0]).tolist() == [0, 1, 2, 3]


def test_the_window_of_the_paper() -> None:
    assert window_of(1_300_000_000, T) == 14
    assert window_of(1_300_000_001, T) == 15


def test_a_chain_is_rooted_only_if_news_can_pass_along_it_in_order() -> None:
    links = links_of("abc", [(0, 1), (1, 2)])
    span = Span(4, T)
    in_order = connectivity([_log([T]), _log([2 * T])], links, span, 2)
    assert in_order.rooted.tolist() == [False, True, False]
    # b hears a only after c has heard b: over both ticks, c has not heard of a. But over the graph of both it has.
    reverse = connectivity([_log([2 * T]), _log([T])], links, span, 2)
    assert reverse.rooted.tolist() == [False, True, False]
    assert in_order.first_gap == 0


def test_the_root_must_be_a_leader_where_there_are_leaders() -> None:
    links = links_of("ab", [(0, 1)])
    span = Span(2, T)
    assert connectivity([_log([T])], links, span, 1).rooted.tolist() == [False, True]
    assert connectivity([_log([T])], links, span, 1, leaders=[0]).rooted.tolist() == [False, True]
    assert connectivity([_log([T])], links, span, 1, leaders=[1]).rooted.tolist() == [False, False]


def test_the_papers_channel_on_a_ring_is_jointly_rooted_over_its_windows() -> None:
    links, span = dense_links(5, 1), Span(300, T)
    model = Window.model_validate({"depth": 10, "delay": ["150 ms", "250 ms"]})
    logs = logs_of(model, links, span.n_ticks)
    found = connectivity(logs, links, span, window_of(model.age_bound_ns(T) or 0, T))
    assert found.rooted.all()
    grew = updates(logs, span)
    assert found.mean_updates.tolist() == [grew[:, links.receiver == i].sum() / span.n_ticks for i in range(5)]


@given(st.data())
def test_a_sliding_window_is_the_composition_of_its_graphs(data: st.DataObject) -> None:
    n = data.draw(st.integers(2, 4))
    pairs = data.draw(st.lists(st.sampled_from([(i, j) for i in range(n) for j in range(n) if i != j]), unique=True))
    ticks, window = data.draw(st.integers(1, 8)), data.draw(st.integers(1, 4))
    heard = data.draw(st.lists(st.sets(st.integers(0, ticks - 1)), min_size=len(pairs), max_size=len(pairs)))
    leaders = data.draw(st.sets(st.integers(0, n - 1), max_size=2))
    links, span = links_of(map(str, range(n)), pairs), Span(ticks, T)
    logs = [_log([tick * T for tick in sorted(at)]) for at in heard]
    found = connectivity(logs, links, span, window, leaders)
    for begin in range(ticks - window + 1):
        knows = np.eye(n, dtype=bool)  # [j, i]: i knows of j
        for tick in range(begin, begin + window):
            step = np.eye(n, dtype=bool)
            for a in leaders:
                for b in leaders:
                    step[a, b] = True
            for (j, i), at in zip(pairs, heard, strict=True):
                if tick in at and i not in leaders:
                    step[j, i] = True
            knows = (knows.astype(int) @ step.astype(int)) > 0
        reach = np.linalg.matrix_power(knows.astype(object), n) > 0
        expected = any(reach[r].all() for r in (leaders or range(n)))
        assert found.rooted[begin] == expected


@pytest.mark.parametrize("leaders", [[], [3, 66]])
def test_many_agents_are_composed_as_few_are(leaders: list[int]) -> None:
    n, span, window = 70, Span(60, T), 9  # more agents than there are bits in a word
    links = dense_links(n, 3)
    logs = logs_of(Window.model_validate({"depth": 3, "delay": ["10 ms", "250 ms"]}), links, span.n_ticks)
    found = connectivity(logs, links, span, window, leaders)
    grew = updates(logs, span)
    for begin in range(span.n_ticks - window + 1):
        knows = np.eye(n)
        for tick in range(begin, begin + window):
            step = np.eye(n)
            step[np.ix_(leaders, leaders)] = 1
            heard = grew[tick] & ~np.isin(links.receiver, leaders)
            step[links.sender[heard], links.receiver[heard]] = 1
            knows = np.minimum(knows @ step, 1)
        for _ in range(7):
            knows = np.minimum(knows @ knows, 1)
        assert found.rooted[begin] == knows[leaders or range(n)].all(axis=1).any()
        missed = unreached(logs, links, span, range(begin, begin + window), leaders)
        best = knows[leaders or range(n)].sum(axis=1).max()
        assert len(missed) == n - best
    assert found.rooted.sum() > 0
