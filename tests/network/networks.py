"""Small networks and logs that several tests use."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from network.channel import ChannelModel
from network.emulator import Emulator
from network.freshness import EdgeLog, edge_logs
from network.messages import Fates, Links, MessageLayout

T = 100_000_000  # ns, the paper's period
LAYOUT = MessageLayout(("p", "v"), (2, 1))
COLUMNS = ("sender", "receiver", "stamp", "sent", "arrival_ns", "fate")


def links_of(agents: Iterable[str], edges: Iterable[tuple[int, int]]) -> Links:
    """Edges (sender, receiver), slots counted in the order given."""
    heard: dict[int, int] = {}
    slots = []
    pairs = list(edges)
    for _, receiver in pairs:
        slots.append(heard.get(receiver, 0))
        heard[receiver] = slots[-1] + 1
    sender, receiver_ = (np.array([pair[side] for pair in pairs], np.int64) for side in (0, 1))
    return Links(tuple(agents), sender, receiver_, np.array(slots, np.int64))


def dense_links(n_agents: int, n_neighbours: int) -> Links:
    """Every agent hears the next `n_neighbours` in a circle."""
    edges = [((i + 1 + j) % n_agents, i) for i in range(n_agents) for j in range(n_neighbours)]
    return links_of((f"arm{i}" for i in range(n_agents)), edges)


def emulator_of(links: Links, model: ChannelModel, seed: int = 1, period_ns: int = T) -> Emulator:
    """One profile for all edges."""
    return Emulator(links, {"all": model}, ["all"] * len(links), LAYOUT, seed, period_ns)


def joined(fates: Iterable[Fates]) -> Fates:
    parts = list(fates)
    return Fates(*(np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS))


def play(emulator: Emulator, n_agents: int, ticks: int) -> Fates:
    """All fates of a run whose messages say nothing of interest."""
    values = np.zeros((n_agents, LAYOUT.width))
    fates = [emulator.emulate(tick, values).fates for tick in range(ticks)]
    return joined([*fates, emulator.finish()])


def logs_of(model: ChannelModel, links: Links, ticks: int, seed: int = 1, period_ns: int = T) -> list[EdgeLog]:
    return edge_logs(play(emulator_of(links, model, seed, period_ns), len(links.agents), ticks), links)


def rows(fates: Fates) -> list[tuple[int, ...]]:
    return list(zip(*(getattr(fates, name).tolist() for name in COLUMNS), strict=True))
