"""The emulator against a message-by-message reference, and the properties that it promises."""

from __future__ import annotations

import heapq
import pickle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from network.channel import Channel, ChannelModel, Setting, Transmission
from network.draws import Draws
from network.emulator import Emulator, EmulatorError
from network.messages import NEVER, Deliveries, Fate, Ints, Links, MessageLayout
from network.netem import Ideal, Netem
from network.replay import Replay
from network.window import Window
from tests.network.networks import LAYOUT, T, dense_links, emulator_of, links_of, play, rows


class Erratic(ChannelModel):
    """Everything at once, on a coarse grid so that arrivals coincide: old samples, twice or never, late or at once."""

    model: Literal["erratic"] = "erratic"

    def open(self, setting: Setting) -> Channel:
        return _ErraticChannel(len(setting.links), setting.period_ns, setting.draws)

    def min_delay_ns(self) -> int:
        return 0


class _ErraticChannel(Channel):
    history = 3

    def __init__(self, n_links: int, period_ns: int, draws: Draws) -> None:
        self._n, self._period, self._draws = n_links, period_ns, draws

    def _below(self, n: int, purpose: str, tick: int) -> Ints:
        return (self._draws.uniform(purpose, tick) * n).astype(np.int64)

    def transmit(self, tick: int) -> Transmission:
        copies = self._below(4, "copies", tick)
        link = np.repeat(np.arange(self._n), copies)
        copy = np.concatenate([np.arange(n) for n in copies] or [np.zeros(0)]).astype(np.int64)
        stamp = np.maximum(0, tick - self._below(4, "stamp", tick))[link]
        step = np.array([self._below(41, f"delay{c}", tick)[i] - 1 for i, c in zip(link, copy, strict=True)])
        return Transmission(link, stamp, np.where(step < 0, NEVER, step * (self._period // 4)).astype(np.int64), copy)


MODELS: dict[str, ChannelModel] = {
    "ideal": Ideal(),
    "whole": Netem.model_validate({"delay": "200 ms"}),
    "radio": Netem.model_validate({"delay": ["10 ms", "330 ms"], "loss": "20 %"}),
    "slow": Netem.model_validate({"delay": ["2 s", "3 s"]}),
    "paper": Window.model_validate({"depth": 10, "delay": ["150 ms", "250 ms"]}),
    "erratic": Erratic(),
}


def _reference(links: Links, profiles: list[str], seed: int, ticks: int) -> tuple[list[Any], list[Any], list[Any]]:
    """Message by message, edge by edge: deliveries per tick, fates per tick, and what is in flight at the end."""
    channels = []
    for i, profile in enumerate(profiles):
        sender, receiver = int(links.sender[i]), int(links.receiver[i])
        alone = links_of(links.agents, [(sender, receiver)])
        draws = Draws(seed, [links.agents[sender]], [links.agents[receiver]])
        channels.append((sender, receiver, int(links.slot[i]), MODELS[profile].open(Setting(alone, T, draws, 24))))
    queue: list[tuple[int, ...]] = []
    freshest: dict[tuple[int, int], int] = {}
    all_deliveries, all_fates = [], []
    for tick in range(ticks):
        fates = []
        for sender, receiver, slot, channel in channels:
            sent = channel.transmit(tick)
            for stamp, delay, copy in zip(sent.stamp.tolist(), sent.delay_ns.tolist(), sent.copy.tolist(), strict=True):
                if delay == NEVER:
                    fates.append((NEVER, receiver, sender, stamp, copy, tick, Fate.LOST))
                else:
                    heapq.heappush(queue, (tick * T + delay, receiver, sender, stamp, copy, tick, slot))
        fates.sort()
        deliveries: list[list[tuple[int, ...]]] = [[] for _ in links.agents]
        while queue and queue[0][0] < (tick + 1) * T:
            arrival, receiver, sender, stamp, copy, left, slot = heapq.heappop(queue)
            fresh = stamp > freshest.get((sender, receiver), NEVER)
            freshest[sender, receiver] = max(stamp, freshest.get((sender, receiver), NEVER))
            fates.append((arrival, receiver, sender, stamp, copy, left, Fate.DELIVERED if fresh else Fate.SUPERSEDED))
            deliveries[receiver].append((arrival, slot, stamp, sender))
        all_deliveries.append(deliveries)
        all_fates.append([(s, r, stamp, left, arrival, fate) for arrival, r, s, stamp, _, left, fate in fates])
    in_flight = [(s, r, k, left, at, Fate.IN_FLIGHT) for at, r, s, k, _, left, _ in sorted(queue)]
    return all_deliveries, all_fates, in_flight


def _sample(tick: int, n_agents: int) -> np.ndarray:
    return tick * 1000.0 + np.arange(n_agents)[:, None] * 10.0 + np.arange(LAYOUT.width)


def _delivered(deliveries: Deliveries) -> list[tuple[int, ...]]:
    return list(zip(deliveries.arrival_ns.tolist(), deliveries.slot.tolist(), deliveries.stamp.tolist(), strict=True))


@st.composite
def networks(draw: st.DrawFn) -> tuple[Links, list[str]]:
    n_agents = draw(st.integers(1, 5))
    pairs = [(i, j) for i in range(n_agents) for j in range(n_agents) if i != j]
    edges = draw(st.permutations(pairs)) if pairs else []
    edges = edges[: draw(st.integers(0, len(edges)))]
    profiles = [draw(st.sampled_from(sorted(MODELS))) for _ in edges]
    return links_of([f"arm{i}" for i in range(n_agents)], edges), profiles


@settings(max_examples=60, deadline=None)
@given(networks(), st.integers(0, 2**63), st.integers(0, 140))
@example((dense_links(5, 4), ["erratic", "paper", "radio", "slow"] * 5), 1, 140)
def test_it_does_what_a_loop_over_messages_does(network: tuple[Links, list[str]], seed: int, ticks: int) -> None:
    links, profiles = network
    n_agents = len(links.agents)
    deliveries, fates, in_flight = _reference(links, profiles, seed, ticks)
    emulator = Emulator(links, MODELS, profiles, LAYOUT, seed, T)
    for tick in range(ticks):
        exchange = emulator.emulate(tick, _sample(tick, n_agents))
        assert exchange.tick == tick
        assert rows(exchange.fates) == fates[tick]
        for got, expected in zip(exchange.mail, deliveries[tick], strict=True):
            assert _delivered(got) == [(arrival, slot, stamp) for arrival, slot, stamp, _ in expected]
            values = [_sample(stamp, n_agents)[sender].tolist() for _, _, stamp, sender in expected]
            assert got.values.tolist() == values
    assert rows(emulator.finish()) == in_flight


@settings(max_examples=30, deadline=None)
@given(networks(), st.data())
def test_an_edge_does_not_depend_on_the_others(network: tuple[Links, list[str]], data: st.DataObject) -> None:
    links, profiles = network
    kept = [i for i in range(len(links)) if data.draw(st.booleans())]
    fewer = links_of(links.agents, [(int(links.sender[i]), int(links.receiver[i])) for i in kept])
    some = play(Emulator(fewer, MODELS, [profiles[i] for i in kept], LAYOUT, 5, T), len(links.agents), 70)
    every = play(Emulator(links, MODELS, profiles, LAYOUT, 5, T), len(links.agents), 70)
    wanted = set(zip(fewer.sender.tolist(), fewer.receiver.tolist(), strict=True))
    assert rows(some) == [row for row in rows(every) if row[:2] in wanted]


@settings(max_examples=20, deadline=None)
@given(networks(), st.integers(1, 100))
def test_every_message_has_one_fate(network: tuple[Links, list[str]], ticks: int) -> None:
    links, profiles = network
    n_agents = len(links.agents)
    fates = play(Emulator(links, MODELS, profiles, LAYOUT, 2, T), n_agents, ticks)
    sent = 0
    for i, profile in enumerate(profiles):
        sender, receiver = links.agents[links.sender[i]], links.agents[links.receiver[i]]
        alone = links_of(links.agents, [(int(links.sender[i]), int(links.receiver[i]))])
        channel = MODELS[profile].open(Setting(alone, T, Draws(2, [sender], [receiver]), 24))
        sent += sum(len(channel.transmit(tick).link) for tick in range(ticks))
    assert len(fates) == sent
    flying = fates.fate == Fate.IN_FLIGHT
    assert (fates.arrival_ns[flying] >= ticks * T).all()
    assert (fates.arrival_ns[~flying] < ticks * T).all()
    assert ((fates.arrival_ns == NEVER) == (fates.fate == Fate.LOST)).all()


def test_the_fresh_stamps_of_an_edge_rise() -> None:
    links = dense_links(6, 3)
    fates = play(emulator_of(links, Erratic()), 6, 300)
    for sender, receiver in zip(links.sender, links.receiver, strict=True):
        edge = (fates.sender == sender) & (fates.receiver == receiver)
        fresh = fates.stamp[edge & (fates.fate == Fate.DELIVERED)]
        assert (np.diff(fresh) > 0).all()
        arrived = edge & ((fates.fate == Fate.DELIVERED) | (fates.fate == Fate.SUPERSEDED))
        assert fresh[-1] == fates.stamp[arrived].max()


def test_the_order_of_the_edges_in_the_file_changes_only_the_slots() -> None:
    edges = [(1, 0), (2, 0), (0, 2), (1, 2)]
    links, turned = (links_of("abc", order) for order in (edges, edges[::-1]))
    model = MODELS["paper"]
    assert rows(play(emulator_of(links, model), 3, 80)) == rows(play(emulator_of(turned, model), 3, 80))


def test_an_arrival_at_the_next_tick_belongs_to_it() -> None:
    links = links_of("ab", [(0, 1)])
    for delay, due in (("99999999 ns", 0), ("100 ms", 1), ("0 s", 0)):
        emulator = emulator_of(links, Netem.model_validate({"delay": delay}))
        counts = [len(emulator.emulate(tick, _sample(tick, 2)).mail[1]) for tick in range(3)]
        assert counts == [int(tick >= due) for tick in range(3)]


def test_messages_carry_the_sample_of_their_stamp_however_long_they_fly() -> None:
    links = dense_links(3, 2)
    emulator = emulator_of(links, Netem.model_validate({"delay": ["1 s", "30 s"]}))
    seen = 0
    for tick in range(700):
        values = _sample(tick, 3)
        for receiver, deliveries in enumerate(emulator.emulate(tick, values).mail):
            senders = links.sender[links.receiver == receiver][deliveries.slot]
            expected = deliveries.stamp[:, None] * 1000.0 + senders[:, None] * 10.0 + np.arange(LAYOUT.width)
            assert (deliveries.values == expected).all()
            seen += len(deliveries)
        values[:] = np.nan  # the caller may reuse its array
    assert seen > 2000


@pytest.mark.parametrize(("profile", "slack"), [("ideal", 0), ("paper", 1), ("whole", 2), ("slow", 20)])
def test_samples_may_lag_by_the_slack(profile: str, slack: int) -> None:
    links = dense_links(4, 2)
    prompt, lagging = (emulator_of(links, MODELS[profile]) for _ in range(2))
    assert lagging.slack == slack
    for tick in range(150):
        if tick >= slack:
            lagging.publish(tick - slack, _sample(tick - slack, 4))
        late, early = lagging.exchange(tick), prompt.emulate(tick, _sample(tick, 4))
        assert rows(late.fates) == rows(early.fates)
        for got, expected in zip(late.mail, early.mail, strict=True):
            assert _delivered(got) == _delivered(expected)
            assert (got.values == expected.values).all()


def test_samples_may_be_ahead() -> None:
    links = dense_links(4, 2)
    prompt, ahead = (emulator_of(links, MODELS["paper"]) for _ in range(2))
    published = 0
    for tick in range(90):
        while published < min(90, tick + tick % 40 + 1):
            ahead.publish(published, _sample(published, 4))
            published += 1
        early, late = ahead.exchange(tick), prompt.emulate(tick, _sample(tick, 4))
        assert [d.values.tolist() for d in early.mail] == [d.values.tolist() for d in late.mail]


def test_one_tick_more_lag_than_the_slack_is_refused() -> None:
    emulator = emulator_of(dense_links(3, 1), MODELS["paper"])
    emulator.exchange(0)
    with pytest.raises(EmulatorError, match="tick 1 needs the samples of tick 0, which are not in yet"):
        emulator.exchange(1)


def test_it_is_refused_to_call_out_of_turn() -> None:
    emulator = emulator_of(dense_links(3, 1), Ideal())
    values = _sample(0, 3)
    with pytest.raises(EmulatorError, match="samples of tick 1 came out of turn: tick 0 is next"):
        emulator.emulate(1, values)
    emulator.emulate(0, values)
    with pytest.raises(EmulatorError, match="samples of tick 0 came out of turn: tick 1 is next"):
        emulator.emulate(0, values)
    with pytest.raises(EmulatorError, match="tick 0 was emulated out of turn: tick 1 is next"):
        emulator.exchange(0)
    emulator.finish()
    with pytest.raises(EmulatorError, match="the emulation is finished"):
        emulator.emulate(1, values)
    with pytest.raises(EmulatorError, match="the emulation is finished"):
        emulator.exchange(1)


@pytest.mark.parametrize("profile", sorted(MODELS))
def test_a_saved_emulator_goes_on_alike(profile: str) -> None:
    links = dense_links(4, 2)
    emulator = emulator_of(links, MODELS[profile])
    for tick in range(40):
        emulator.emulate(tick, _sample(tick, 4))
    copy = pickle.loads(pickle.dumps(emulator))
    for tick in range(40, 100):
        one, other = (each.emulate(tick, _sample(tick, 4)) for each in (emulator, copy))
        assert rows(one.fates) == rows(other.fates)
        assert [d.values.tolist() for d in one.mail] == [d.values.tolist() for d in other.mail]
    assert rows(emulator.finish()) == rows(copy.finish())


def test_what_it_hands_out_is_read_only() -> None:
    emulator = emulator_of(dense_links(3, 1), Ideal())
    deliveries = emulator.emulate(0, _sample(0, 3)).mail[0]
    for array in (deliveries.arrival_ns, deliveries.slot, deliveries.stamp, deliveries.values):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_network_in_which_nobody_publishes() -> None:
    emulator = Emulator(links_of("ab", []), {}, (), MessageLayout((), ()), seed=1, period_ns=T)
    for tick in range(3):
        mail = emulator.emulate(tick, np.empty((2, 0))).mail
        assert mail.ends.tolist() == [0, 0, 0]
        assert mail.values.shape == (0, 0)


def test_many_edges_are_routed_as_few_are() -> None:
    links = dense_links(1500, 8)  # one tick at a time
    wanted = [(int(links.sender[i]), int(links.receiver[i])) for i in (0, 5000, 11_999)]
    fates = rows(play(emulator_of(links, MODELS["paper"]), 1500, 12))
    few = rows(play(emulator_of(links_of(links.agents, wanted), MODELS["paper"]), 1500, 12))
    assert few == [row for row in fates if row[:2] in wanted]


def test_seeds_differ() -> None:
    links = dense_links(3, 1)
    one, other = (play(emulator_of(links, MODELS["paper"], seed), 3, 20) for seed in (1, 2))
    assert rows(one) != rows(other)


@settings(deadline=None, max_examples=30)
@given(networks(), st.data())
@example((dense_links(5, 4), ["erratic", "paper", "radio", "slow"] * 5), None)
def test_several_ticks_and_groups_at_once_are_those_one_by_one(
    network: tuple[Links, list[str]], data: st.DataObject | None
) -> None:
    links, profiles = network
    n_agents, ticks = len(links.agents), 150
    owner = [data.draw(st.integers(0, 2)) if data else i % 3 for i in range(n_agents)]
    groups = [[agent for agent in range(n_agents) if owner[agent] == group] for group in range(3)]
    prompt = Emulator(links, MODELS, profiles, LAYOUT, 1, T)
    several = Emulator(links, MODELS, profiles, LAYOUT, 1, T, groups)
    tick = 0
    while tick < ticks:
        stop = tick + (data.draw(st.integers(1, 9)) if data else 4)
        for published in range(several.published, stop):
            several.publish(published, _sample(published, n_agents))
        stretch = several.exchange_several(tick, stop)
        assert 1 <= stretch.n_ticks <= stop - tick
        fates = rows(stretch.fates)
        for row, count in enumerate(stretch.fate_counts):
            expected = prompt.emulate(tick + row, _sample(tick + row, n_agents))
            assert fates[:count] == rows(expected.fates)
            fates = fates[count:]
            for group, mail in zip(groups, stretch.mail, strict=True):
                of_tick = mail.of(range(row * len(group), (row + 1) * len(group)))
                for agent, got in zip(group, of_tick, strict=True):
                    assert _delivered(got) == _delivered(expected.mail[agent])
                    assert (got.values == expected.mail[agent].values).all()
        assert not fates
        tick += stretch.n_ticks


def test_a_recorded_network_happens_again(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    links = dense_links(6, 3)
    model = Netem.model_validate({"delay": ["10 ms", "330 ms"], "loss": "20 %", "duplicate": "10 %"})
    names = ["paper", "all"] * 9
    fates = play(Emulator(links, {"paper": MODELS["paper"], "all": model}, names, LAYOUT, 4, T), 6, 120)
    table = {name: getattr(fates, name) for name in ("stamp", "sent", "arrival_ns")}
    table["sender"], table["receiver"] = ([links.agents[i] for i in ends] for ends in (fates.sender, fates.receiver))
    table["fate"] = [Fate(fate).name.lower() for fate in fates.fate]
    pq.write_table(pa.table(table), tmp_path / "deliveries.parquet")
    replay = Replay.model_validate({"file": str(tmp_path / "deliveries.parquet")})
    again = play(emulator_of(links, replay, seed=5), 6, 120)
    assert rows(again) == rows(fates)
    fewer = links_of(links.agents, [(int(links.sender[i]), int(links.receiver[i])) for i in (3, 11)])
    wanted = set(zip(fewer.sender.tolist(), fewer.receiver.tolist(), strict=True))
    assert rows(play(emulator_of(fewer, replay), 6, 120)) == [row for row in rows(fates) if row[:2] in wanted]
