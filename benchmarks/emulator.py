"""What the emulator costs per tick and per message, beside a plain loop over messages.

    python -m benchmarks.emulator [--repeat 5]

The yardstick is how an emulator is usually written: a heap of messages, a `random.Random` per edge, one message at a
time, doing the same work (the paper's channel, the freshest-stamp rule, fates, deliveries per agent). Times are the
best of several repetitions, in processor time of one core, with opening the channels and the first block left out.
"""

from __future__ import annotations

import argparse
import heapq
import random
import time
from collections.abc import Callable

import numpy as np

from network.channel import ChannelModel
from network.emulator import Emulator
from network.messages import Fate, Floats, Links, MessageLayout
from network.netem import Netem
from network.window import Window

PERIOD_NS = 100_000_000
LAYOUT = MessageLayout(("p", "v_hat"), (2, 2))
MODELS: dict[str, ChannelModel] = {
    "window": Window.model_validate({"depth": 10, "delay": ["150 ms", "250 ms"]}),
    "delay": Netem.model_validate({"delay": "20 ms"}),
    "jitter, loss": Netem.model_validate({"delay": ["10 ms", "330 ms"], "loss": "2 %"}),
    "gemodel": Netem.model_validate({"delay": "20 ms", "loss": {"gemodel": ["1 %", "20 %"]}}),
}
MIX = "mix of these"


class MessageLoop:
    """The yardstick, for the paper's channel."""

    def __init__(self, links: Links, depth: int, low_ns: int, high_ns: int) -> None:
        self._edges = list(zip(links.receiver.tolist(), links.sender.tolist(), links.slot.tolist(), strict=True))
        self._n_agents = len(links.agents)
        self._random = [random.Random(edge) for edge in range(len(links))]
        self._sent: list[set[int]] = [set() for _ in self._edges]
        self._freshest = [-1] * len(self._edges)
        self._history: dict[int, Floats] = {}
        self._queue: list[tuple[int, int, int, int, int, int]] = []
        self._depth, self._low, self._high = depth, low_ns, high_ns

    def emulate(self, tick: int, values: Floats) -> int:
        """How many messages arrived."""
        self._history[tick] = values.copy()
        self._history.pop(tick - self._depth - 4, None)
        for edge, (receiver, sender, _) in enumerate(self._edges):
            draw = self._random[edge]
            picked = draw.randint(tick - self._depth, tick)
            sent = self._sent[edge]
            sent.discard(tick - self._depth - 1)
            if picked >= 0 and picked not in sent:
                sent.add(picked)
                arrival = tick * PERIOD_NS + draw.randint(self._low, self._high)
                heapq.heappush(self._queue, (arrival, receiver, sender, picked, tick, edge))
        deliveries: list[list[tuple[int, int, int, Floats]]] = [[] for _ in range(self._n_agents)]
        fates = []
        end = (tick + 1) * PERIOD_NS
        while self._queue and self._queue[0][0] < end:
            arrival, receiver, sender, stamp, left, edge = heapq.heappop(self._queue)
            fresh = stamp > self._freshest[edge]
            if fresh:
                self._freshest[edge] = stamp
            fates.append((sender, receiver, stamp, left, arrival, Fate.DELIVERED if fresh else Fate.SUPERSEDED))
            deliveries[receiver].append((arrival, self._edges[edge][2], stamp, self._history[stamp][sender]))
        return len(fates)


def network(n_agents: int, n_neighbours: int) -> Links:
    """Every agent hears the next ones in a circle."""
    receiver = np.repeat(np.arange(n_agents), n_neighbours)
    slot = np.tile(np.arange(n_neighbours), n_agents)
    return Links(tuple(f"arm{i}" for i in range(n_agents)), (receiver + slot + 1) % n_agents, receiver, slot)


def opened(links: Links, model: str) -> Callable[[int, Floats], int]:
    """A fresh emulator, as a function that counts the fates."""
    names = [*MODELS] if model == MIX else [model]
    emulator = Emulator(links, MODELS, [names[i % len(names)] for i in range(len(links))], LAYOUT, 1, PERIOD_NS)
    return lambda tick, values: len(emulator.emulate(tick, values).fates)


def measure(emulate: Callable[[int, Floats], int], n_agents: int, ticks: int, repeat: int) -> tuple[float, float]:
    """Seconds per tick and per message that became due."""
    values = np.random.default_rng(0).normal(size=(n_agents, LAYOUT.width))
    tick, best = 0, (float("inf"), float("inf"))
    for _ in range(repeat + 1):  # the first warms up
        begin, messages = time.process_time(), 0
        for _ in range(ticks):
            messages += emulate(tick, values)
            tick += 1
        spent = time.process_time() - begin
        best = min(best, (spent / ticks, spent / max(1, messages)))
    return best


def main() -> None:
    """Print one line per network and channel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    repeat = parser.parse_args().repeat
    print(f"{'edges':>7} {'agents':>7} {'channel':>14} {'µs/tick':>10} {'µs/message':>11}")
    for n_agents, n_neighbours, ticks in ((10, 2, 640), (1000, 2, 64), (1000, 10, 24), (4000, 10, 8)):
        links = network(n_agents, n_neighbours)
        results = {name: measure(opened(links, name), n_agents, ticks, repeat) for name in (*MODELS, MIX)}
        loop = MessageLoop(links, 10, 150_000_000, 250_000_000)
        results["window, loop"] = measure(loop.emulate, n_agents, ticks, repeat)
        for name, (per_tick, per_message) in results.items():
            print(f"{len(links):7} {n_agents:7} {name:>14} {per_tick * 1e6:10.1f} {per_message * 1e6:11.3f}")
        print(f"{'':>16}the loop takes {results['window, loop'][0] / results['window'][0]:.1f} times as long\n")


if __name__ == "__main__":
    main()
