"""Roots and reachability against the transitive closure by matrix powers; weighted in-degrees."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.topology import kappa, reached_by, roots, sources
from network.messages import Links


@st.composite
def graphs(draw: st.DrawFn) -> Links:
    n = draw(st.integers(1, 8))
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    edges = sorted(
        draw(st.sets(st.sampled_from(pairs), max_size=12) if pairs else st.just(set())), key=lambda e: e[::-1]
    )
    sender, receiver = (np.array([edge[end] for edge in edges], dtype=np.int64) for end in (0, 1))
    slot = np.array([receiver[:k].tolist().count(r) for k, r in enumerate(receiver.tolist())], dtype=np.int64)
    return Links(tuple(map(str, range(n))), sender, receiver, slot)


def closure(links: Links) -> np.ndarray:
    """[i, j]: a message can reach j from i."""
    n = len(links.agents)
    reach = np.eye(n, dtype=int)
    reach[links.sender, links.receiver] = 1
    return np.linalg.matrix_power(reach, n) > 0


@given(graphs())
def test_reachability(links: Links) -> None:
    reach = closure(links)
    for i in range(len(links.agents)):
        assert np.array_equal(reached_by(links, i), reach[i])
        assert np.array_equal(reached_by(links, i, backwards=True), reach[:, i])


@given(graphs())
def test_roots(links: Links) -> None:
    assert roots(links) == np.flatnonzero(closure(links).all(axis=1)).tolist()


@given(graphs())
def test_sources_reach_everyone_and_not_each_other(links: Links) -> None:
    reach, found = closure(links), sources(links)
    assert reach[found].any(axis=0).all()
    assert not any(reach[i, j] for i in found for j in found if i != j)


@given(graphs(), st.data())
def test_kappa(links: Links, data: st.DataObject) -> None:
    weights = data.draw(st.lists(st.floats(0.1, 2), min_size=len(links), max_size=len(links)))
    adjacency = np.zeros((len(links.agents),) * 2)
    adjacency[links.receiver, links.sender] = weights
    np.testing.assert_allclose(kappa(links, weights), adjacency.sum(axis=1))
