"""What it takes to analyse a log of a million messages, beside the definitions written down as plain loops.

    python -m benchmarks.freshness

Two logs of about a million messages: few edges for long, and many edges for a short time. Measured is what a report
asks for: the log taken apart by edge, the age of information, the (k*, h) front of every edge and the common one,
counts and delays, and joint rootedness over every window. Best of several repetitions, in processor time.

The yardstick follows the definitions of age and front sample by sample. Its front takes the square of their number, so
it gets one edge of 2,000 ticks; the results of both are compared.
"""

from __future__ import annotations

import argparse
import time
from bisect import insort
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from benchmarks.emulator import LAYOUT, PERIOD_NS, network
from network.channel import ChannelModel
from network.connectivity import connectivity, window_of
from network.emulator import Emulator
from network.freshness import EdgeLog, Span, age_of_information, common_front, edge_logs, tolerance_fronts
from network.messages import Fate, Fates, Links
from network.netem import Netem
from network.traffic import traffic
from network.window import Window

MODELS: dict[str, ChannelModel] = {
    "window": Window.model_validate({"depth": 10, "delay": ["150 ms", "250 ms"]}),
    "bursts": Netem.model_validate({"delay": ["10 ms", "330 ms"], "loss": {"gemodel": ["1 %", "20 %"]}}),
}
H_STAR_NS = 1_300_000_000
_Result = TypeVar("_Result")


def record(links: Links, n_ticks: int) -> Fates:
    """A log in which every other edge has the paper's channel, the rest losses in bursts."""
    names = [[*MODELS][i % 2] for i in range(len(links))]
    emulator = Emulator(links, MODELS, names, LAYOUT, 1, PERIOD_NS)
    values = np.zeros((len(links.agents), LAYOUT.width))
    fates = [*(emulator.emulate(tick, values).fates for tick in range(n_ticks)), emulator.finish()]
    columns = ("sender", "receiver", "stamp", "sent", "arrival_ns", "fate")
    return Fates(*(np.concatenate([getattr(each, column) for each in fates]) for column in columns))


def analyse(fates: Fates, links: Links, span: Span) -> dict[str, float]:
    """Seconds per part, and in all."""
    spent: dict[str, float] = {}

    def timed(name: str, work: Callable[[], _Result]) -> _Result:
        begin = time.process_time()
        result = work()
        spent[name] = time.process_time() - begin
        return result

    logs = timed("by edge", lambda: edge_logs(fates, links))
    timed("age", lambda: [age_of_information(log, span) for log in logs])
    fronts = timed("fronts", lambda: tolerance_fronts(logs, span))
    timed("common front", lambda: common_front(fronts))
    timed("traffic", lambda: [traffic(log, span, history=10) for log in logs])
    timed("rootedness", lambda: connectivity(logs, links, span, window_of(H_STAR_NS, PERIOD_NS)))
    return spent | {"in all": sum(spent.values())}


def by_definition(log: EdgeLog, span: Span) -> tuple[float, list[tuple[int, int]]]:
    """Mean age at ticks in seconds, and the pairs (k*, h) of the front."""
    came: dict[int, int] = {}
    lost, flying = set(), set()
    rows = zip(*(column.tolist() for column in (log.stamp, log.arrival_ns, log.fate)), strict=True)
    for stamp, arrival, fate in sorted(rows, key=lambda row: row[1]):
        if fate == Fate.LOST:
            lost.add(stamp)
        elif fate == Fate.IN_FLIGHT:
            flying.add(stamp)
        else:
            came.setdefault(stamp, arrival)
    arrivals = sorted((arrival, stamp) for stamp, arrival in came.items())
    ages, freshest, heard = 0, 0, 0
    for tick in range(span.n_ticks):
        while heard < len(arrivals) and arrivals[heard][0] <= tick * span.period_ns:
            freshest = max(freshest, arrivals[heard][1])
            heard += 1
        ages += tick - freshest
    delay = {k: (span.n_ticks - k) * span.period_ns for k in range(span.n_ticks) if k not in lost or k in flying}
    delay |= {k: arrival - k * span.period_ns for k, arrival in came.items()}
    members: list[int] = []
    front: list[tuple[int, int]] = []
    observed = {delay[k] for k in came}
    ordered = sorted(delay, key=delay.__getitem__)
    for i, k in enumerate(ordered):
        insort(members, k)
        if delay[k] not in observed or (i + 1 < len(ordered) and delay[ordered[i + 1]] == delay[k]):
            continue
        gaps = [after - before for before, after in zip(members, [*members[1:], span.n_ticks], strict=True)]
        k_star = max(members[0], *gaps)
        if not front or k_star < front[-1][0]:
            front.append((k_star, delay[k]))
    return ages * span.period_ns / 1e9 / span.n_ticks, front


def main() -> None:
    """Print seconds per part for both logs, and the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    for n_agents, n_neighbours, n_ticks in ((10, 2, 60_000), (1000, 10, 120)):
        links, span = network(n_agents, n_neighbours), Span(n_ticks, PERIOD_NS)
        fates = record(links, n_ticks)
        best = min((analyse(fates, links, span) for _ in range(3)), key=lambda spent: spent["in all"])
        print(f"{len(links)} edges, {n_ticks} ticks, {len(fates)} messages")
        for part, seconds in best.items():
            print(f"  {part:<14} {seconds:6.2f} s")
    links, span = network(2, 1), Span(2000, PERIOD_NS)
    log = edge_logs(record(links, span.n_ticks), links)[0]
    begin = time.process_time()
    expected = by_definition(log, span)
    loop, begin = time.process_time() - begin, time.process_time()
    age, (front,) = age_of_information(log, span), tolerance_fronts([log], span)
    spent = time.process_time() - begin
    assert abs(age.tick_mean - expected[0]) < 1e-9 * expected[0]
    assert list(zip(front.k_star.tolist(), front.h_ns.tolist(), strict=True)) == expected[1]
    print(f"age and front of one edge over {span.n_ticks} ticks: loops {loop:.3f} s, here {spent * 1e3:.2f} ms")


if __name__ == "__main__":
    main()
