"""The generator against its published vectors, the keys against their definition, and the statistics.

Statistical tests have fixed seeds, so they pass or fail for ever. Each fails for a perfect generator with
probability `FALSE_ALARM` at most; that is the chance that a change of the keys needs another seed.
"""

from __future__ import annotations

import hashlib
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from network.draws import Draws, initial_normal, initial_uniform, threefry2x64

FALSE_ALARM = 1e-6

# Random123 1.14, tests/kat_vectors, lines `threefry2x64 20`: counter, key, result.
KNOWN_ANSWERS = [
    ("0000000000000000 0000000000000000", "0000000000000000 0000000000000000", "c2b6e3a8c2c69865 6f81ed42f350084d"),
    ("ffffffffffffffff ffffffffffffffff", "ffffffffffffffff ffffffffffffffff", "e02cb7c4d95d277a d06633d0893b8b68"),
    ("243f6a8885a308d3 13198a2e03707344", "a4093822299f31d0 082efa98ec4e6c89", "263c7d30bb0f0af1 56be8361d3311526"),
]


def _pair(text: str) -> tuple[np.ndarray, np.ndarray]:
    first, second = (np.array([int(word, 16)], np.uint64) for word in text.split())
    return first, second


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_threefry_gives_the_published_answers(counter: str, key: str, expected: str) -> None:
    assert threefry2x64(_pair(counter), _pair(key)) == _pair(expected)


def test_threefry_works_element_by_element() -> None:
    counters, keys = ([_pair(row[side]) for row in KNOWN_ANSWERS] for side in (0, 1))
    c0, c1 = (np.concatenate(words)[:, None] for words in zip(*counters, strict=True))
    k0, k1 = (np.concatenate(words) for words in zip(*keys, strict=True))
    table = threefry2x64((c0, c1), (k0, k1))
    for i in range(3):
        for j in range(3):
            alone = threefry2x64(counters[i], keys[j])
            assert (table[0][i, j], table[1][i, j]) == (alone[0][0], alone[1][0])


def _by_definition(seed: int, sender: str, receiver: str, purpose: str, tick: int) -> float:
    def prefixed(*parts: str) -> bytes:
        return b"".join(len(part.encode()).to_bytes(8, "little") + part.encode() for part in parts)

    digest = hashlib.blake2b(prefixed("edge", str(seed), sender, receiver), digest_size=16).digest()
    purpose_digest = hashlib.blake2b(prefixed(purpose), digest_size=8).digest()
    k0, k1 = (np.array([int.from_bytes(digest[i : i + 8], "little")], np.uint64) for i in (0, 8))
    counter = (np.array([tick // 2], np.uint64), np.array([int.from_bytes(purpose_digest, "little")], np.uint64))
    return (int(threefry2x64(counter, (k0, k1))[tick % 2][0]) >> 11) / 2**53


@pytest.mark.parametrize("tick", [0, 1, 2, 255, 256, 257, 100_001])
def test_a_draw_is_keyed_as_documented(tick: int) -> None:
    draws = Draws(7, ["arm1", "Rücken"], ["arm2", "arm1"])
    expected = [_by_definition(7, "arm1", "arm2", "delay", tick), _by_definition(7, "Rücken", "arm1", "delay", tick)]
    assert draws.uniform("delay", tick).tolist() == expected


@given(st.lists(st.tuples(st.sampled_from(["delay", "loss"]), st.integers(0, 2000)), max_size=30))
def test_draws_do_not_depend_on_the_order_of_asking(questions: list[tuple[str, int]]) -> None:
    shared = Draws(3, ["a", "b"], ["b", "a"])
    for purpose, tick in questions:
        fresh = Draws(3, ["a", "b"], ["b", "a"])
        assert shared.uniform(purpose, tick).tolist() == fresh.uniform(purpose, tick).tolist()


@pytest.mark.parametrize("n_edges", [2, 100, 3000, 20_000])
def test_draws_do_not_depend_on_other_edges_or_on_how_many_ticks_are_drawn_at_once(n_edges: int) -> None:
    many = Draws(3, [f"s{i}" for i in range(n_edges)], ["r"] * n_edges)
    last = Draws(3, [f"s{n_edges - 1}"], ["r"])
    for tick in (0, 1, 5, 254, 300):
        assert many.uniform("delay", tick)[-1] == last.uniform("delay", tick)[0]


def test_what_a_draw_is_keyed_by_changes_it() -> None:
    values = [
        float(Draws(seed, [sender], [receiver]).uniform(purpose, tick)[0])
        for seed, sender, receiver, purpose, tick in [
            (1, "a", "b", "delay", 0),
            (2, "a", "b", "delay", 0),
            (1, "b", "a", "delay", 0),
            (1, "a", "b", "loss", 0),
            (1, "a", "b", "delay", 1),
            (1, "ab", "", "delay", 0),
            (1, "", "ab", "delay", 0),
        ]
    ]
    assert len(set(values)) == len(values)


def test_several_ticks_at_once_and_one_of_each_edge_are_the_same_draws() -> None:
    n = 3000
    draws, alone = (Draws(3, [f"s{i}" for i in range(n)], ["r"] * n) for _ in range(2))
    for ticks in (range(1), range(1, 20), range(3, 9), range(40, 41)):
        expected = [alone.uniform("delay", tick).tolist() for tick in ticks]
        assert draws.uniforms("delay", ticks).tolist() == expected
    tick, edge = np.array([0, 7, 300, 7]), np.array([5, 5, 2999, 0])
    expected = [alone.uniform("delay", t)[e] for t, e in zip(tick.tolist(), edge.tolist(), strict=True)]
    assert draws.at("delay", tick, edge).tolist() == expected


def test_no_edges() -> None:
    assert Draws(1, [], []).uniform("delay", 5).shape == (0,)


def test_a_pickled_generator_goes_on_alike() -> None:
    draws = Draws(1, ["a"], ["b"])
    draws.uniform("delay", 3)
    copy = pickle.loads(pickle.dumps(draws))
    assert [copy.uniform("delay", t) for t in range(600)] == [draws.uniform("delay", t) for t in range(600)]


def _sample(ticks: int = 400, edges: int = 500) -> np.ndarray:
    draws = Draws(11, [f"s{i}" for i in range(edges)], [f"r{i % 7}" for i in range(edges)])
    return np.array([draws.uniform("delay", tick) for tick in range(ticks)])


def test_uniforms_are_uniform() -> None:
    sample = _sample()
    assert sample.min() >= 0.0
    assert sample.max() < 1.0
    assert stats.kstest(sample.ravel(), "uniform").pvalue > FALSE_ALARM


@pytest.mark.parametrize("shift", [(1, 0), (2, 0), (0, 1), (1, 1)])
def test_neighbouring_ticks_and_edges_are_independent(shift: tuple[int, int]) -> None:
    sample = _sample()
    ticks, edges = sample.shape
    first = sample[: ticks - shift[0], : edges - shift[1]].ravel()
    second = sample[shift[0] :, shift[1] :].ravel()
    counts = np.histogram2d(first, second, bins=16, range=((0, 1), (0, 1)))[0].ravel()
    assert stats.chisquare(counts).pvalue > FALSE_ALARM


def test_initial_conditions_are_keyed_by_seed_path_and_element() -> None:
    values = initial_uniform(1, ["arm1.plant.p"], 4)[0]
    assert initial_uniform(1, ["arm1.plant.p"], 2)[0].tolist() == values[:2].tolist()
    assert (
        len(
            {*values.tolist(), *initial_uniform(1, ["arm2.plant.p"], 4)[0], *initial_uniform(2, ["arm1.plant.p"], 4)[0]}
        )
        == 12
    )
    assert initial_uniform(1, ["x"], 0)[0].shape == initial_normal(1, ["x"], 0)[0].shape == (0,)


def test_initial_conditions_have_their_distributions() -> None:
    assert stats.kstest(initial_uniform(1, ["arm1.plant.p"], 20_000)[0], "uniform").pvalue > FALSE_ALARM
    assert stats.kstest(initial_normal(1, ["arm1.plant.p"], 20_000)[0], "norm").pvalue > FALSE_ALARM


def test_normals_are_the_quantiles_of_the_same_words_as_the_uniforms() -> None:
    uniform, normal = initial_uniform(9, ["x"], 1000)[0], initial_normal(9, ["x"], 1000)[0]
    assert np.allclose(stats.norm.cdf(normal), uniform, atol=1e-15, rtol=1e-12)
