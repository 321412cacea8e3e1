"""The channels beside the kernel's own netem: UDP packets over a virtual cable, with the same parameters.

Skipped where the machine has no netem, or does not let us make network namespaces. Each comparison would fail for equal
laws with probability `FALSE_ALARM`. What a packet takes anyway is measured first, and added to our delays.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from network.channel import Setting
from network.draws import Draws
from network.impairments.distributions import Quantile, read_table
from network.impairments.queue import Rate
from network.messages import NEVER
from network.netem import Netem
from tests.network.networks import T, dense_links

FALSE_ALARM = 1e-6
SIGMAS = float(-stats.norm.ppf(FALSE_ALARM / 2))
PROBE = Path(__file__).with_name("udp_probe.py")
NEAR, FAR = "10.213.78.1", "10.213.78.2"
HEADERS = 42  # bytes of Ethernet, IP and UDP, which netem's rate counts
MS = 1_000_000

Arrivals = NDArray[np.int64]
"""(n, 3): number, time of sending and of arrival in nanoseconds of each packet that arrived, in that order."""


def run(*command: str) -> str:
    """What it says; `OSError` with that if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode:
        raise OSError(done.stderr.strip() or done.stdout.strip())
    return done.stdout


class Cable:
    """Two network namespaces, joined by a cable whose near end has a netem."""

    def __init__(self, stack: ExitStack) -> None:
        self._near, self._far = (f"netem-{side}-{os.getpid()}" for side in "ab")
        self._end, end = f"na{os.getpid()}", f"nb{os.getpid()}"
        for name in (self._near, self._far):
            run("ip", "netns", "add", name)
            stack.callback(run, "ip", "netns", "del", name)
        pair = ("type", "veth", "peer", "name", end, "netns", self._far)
        run("ip", "link", "add", self._end, "netns", self._near, *pair)
        for name, device, address in ((self._near, self._end, NEAR), (self._far, end, FAR)):
            run("ip", "-n", name, "addr", "add", f"{address}/24", "dev", device)
            run("ip", "-n", name, "link", "set", device, "up")
        # By hand: a lost question for an address would cost a second.
        far = json.loads(run("ip", "-n", self._far, "-j", "link", "show", end))[0]["address"]
        run("ip", "-n", self._near, "neigh", "replace", FAR, "lladdr", far, "dev", self._end)

    def netem(self, parameters: str) -> None:
        """Begin anew with these parameters."""
        where = ("dev", self._end, "root", "netem", "limit", "100000")
        run("tc", "-n", self._near, "qdisc", "replace", *where, *parameters.split())

    def send(self, parameters: str, n: int = 2000, interval_ms: float = 1.0, size: int = 64) -> Arrivals:
        """What becomes of packets."""
        self.netem(parameters)
        receive = ["ip", "netns", "exec", self._far, sys.executable, str(PROBE), "receive", FAR]
        with subprocess.Popen(receive, stdout=subprocess.PIPE, text=True) as receiver:
            assert receiver.stdout is not None
            assert receiver.stdout.readline() == "ready\n"
            numbers = (str(n), str(interval_ms), str(size))
            run("ip", "netns", "exec", self._near, sys.executable, str(PROBE), "send", FAR, *numbers)
            rows = json.loads(receiver.communicate(timeout=60)[0])
        run("tc", "-n", self._near, "qdisc", "del", "dev", self._end, "root")
        return np.array(rows, np.int64)


@pytest.fixture(scope="module")
def cable() -> Iterator[Cable]:
    for tool in ("ip", "tc"):
        if shutil.which(tool) is None:
            pytest.skip(f"needs the command {tool} (package iproute2)")
    with ExitStack() as stack:
        try:
            made = Cable(stack)
        except OSError as error:
            pytest.skip(f"network namespaces are not allowed here: {error}")
        try:
            made.netem("delay 1ms")
        except OSError as error:
            pytest.skip(f"this kernel has no netem (module sch_netem): {error}")
        yield made


@pytest.fixture(scope="module")
def overhead(cable: Cable) -> int:
    """What a packet takes beyond its delay, in nanoseconds: the median, as a busy machine stalls now and then."""
    return int(np.median(delays_of(cable.send("delay 100ms")))) - 100 * MS


def delays_of(arrivals: Arrivals) -> NDArray[np.int64]:
    """(n,) nanoseconds."""
    return arrivals[:, 2] - arrivals[:, 1]


def ours(written: dict[str, Any], edges: int = 400, ticks: int = 2000) -> NDArray[np.int64]:
    """(ticks, edges) delays of a channel with these parameters."""
    links = dense_links(edges, 1)
    names = [links.agents[i] for i in links.sender], [links.agents[i] for i in links.receiver]
    channel = Netem.model_validate(written).open(Setting(links, T, Draws(1, *names), 64))
    return channel.transmit_many(range(ticks)).delay_ns.reshape(ticks, edges)


def runs_of(lost: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Lengths of the runs of losses."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost, [0]))))
    return edges[1::2] - edges[::2]


@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto", "paretonormal"])
def test_delays_have_the_kernels_distribution(cable: Cable, overhead: int, distribution: str) -> None:
    named = "" if distribution == "uniform" else f" distribution {distribution}"
    # Long delays: a busy machine wakes up late by some milliseconds, now more, now less.
    kernel = delays_of(cable.send(f"delay 800ms 200ms{named}"))
    written = {"delay": {"time": "800 ms", "jitter": "200 ms", "distribution": distribution}}
    expected = ours(written, ticks=100).ravel() + overhead
    assert stats.ks_2samp(kernel, expected).pvalue > FALSE_ALARM


@pytest.mark.parametrize(
    ("parameters", "loss"),
    [
        ("loss random 10%", {"random": "10 %"}),
        ("loss gemodel 3% 20%", {"gemodel": ["3 %", "20 %"]}),
        ("loss gemodel 3% 20% 70% 1%", {"gemodel": ["3 %", "20 %", "70 %", "1 %"]}),
        ("loss state 3% 30% 20% 40% 1%", {"state": ["3 %", "30 %", "20 %", "40 %", "1 %"]}),
    ],
)
def test_losses_have_the_kernels_rate_and_runs(cable: Cable, parameters: str, loss: dict[str, Any]) -> None:
    n = 4000
    lost = np.ones(n, np.bool_)
    lost[cable.send(parameters, n, interval_ms=0.5)[:, 0]] = False
    edges = (ours({"loss": loss}, ticks=n) == NEVER).T
    rates = edges.mean(axis=1)
    assert abs(lost.mean() - rates.mean()) < SIGMAS * rates.std() * np.sqrt(1 + 1 / len(rates))
    expected = np.concatenate([runs_of(edge) for edge in edges])
    assert stats.ks_2samp(runs_of(lost), expected).pvalue > FALSE_ALARM


def test_a_correlation_keeps_our_rate_and_not_the_kernels(cable: Cable) -> None:
    n = 4000
    kernel = 1 - len(cable.send("loss random 10% 50%", n, interval_ms=0.5)) / n
    lost = (ours({"loss": {"random": "10 %", "correlation": "50 %"}}, ticks=n) == NEVER).mean(axis=0)
    assert abs(lost.mean() - 0.1) < SIGMAS * lost.std() / np.sqrt(len(lost))
    assert kernel < 0.05


def test_duplicates_have_the_kernels_rate(cable: Cable) -> None:
    n = 3000
    numbers = cable.send("duplicate 20%", n, interval_ms=0.5)[:, 0]
    assert stats.binomtest(len(numbers) - len(np.unique(numbers)), n, 0.2).pvalue > FALSE_ALARM


def test_as_many_go_ahead_as_in_the_kernel(cable: Cable) -> None:
    arrivals = cable.send("delay 100ms reorder 50% gap 4", 3000, interval_ms=0.5)
    delays = delays_of(arrivals[np.argsort(arrivals[:, 0])])
    ahead = np.flatnonzero(delays < 50 * MS)
    assert np.diff(ahead).min() >= 4
    # Cycles of three that may not, then geometrically many, are independent.
    cycles = stats.nbinom(1, 0.5).rvs(size=(5000, 1000), random_state=1) + 4
    counts = (np.cumsum(cycles, axis=1) < len(delays)).sum(axis=1)
    assert abs(len(ahead) - counts.mean()) < SIGMAS * counts.std() + 1
    expected = (ours({"delay": "100 ms", "reorder": {"random": "50 %", "gap": 4}}, ticks=3000) == 0).sum(axis=0)
    assert abs(expected.mean() - counts.mean()) < SIGMAS * counts.std() / np.sqrt(len(expected)) + 1


@pytest.mark.parametrize(
    ("parameters", "rate"),
    [
        ("rate 100kbit", {"rate": "100 kbit/s"}),
        ("rate 100kbit 20 48 5", {"rate": "100 kbit/s", "overhead": 20, "cell": 48, "cell_overhead": 5}),
    ],
)
def test_a_packet_occupies_the_link_as_long_as_the_kernel_says(
    cable: Cable, parameters: str, rate: dict[str, Any]
) -> None:
    n = 100
    arrivals = cable.send(parameters, n, interval_ms=0.0)
    took = Rate.model_validate(rate).transmission_ns(64 + HEADERS)
    assert len(arrivals) == n
    between = arrivals[-1, 2] - arrivals[0, 2]
    assert between / (n - 1) == pytest.approx(took, rel=0.05)


# --- iproute2's tables, without a kernel -----------------------------------------------------------------------------
TABLES = [Path(folder) for folder in ("/usr/lib/tc", "/usr/share/tc", *map(str, Path("/usr/lib").glob("*/tc")))]


@pytest.mark.parametrize("name", ["normal", "pareto", "paretonormal"])
def test_distributions_are_those_of_the_tables(name: Any) -> None:
    path = next((folder / f"{name}.dist" for folder in TABLES if (folder / f"{name}.dist").exists()), None)
    if path is None:
        pytest.skip("needs the tables of iproute2")
    table = read_table(path)
    u = (np.arange(len(table)) + 0.5) / len(table)
    ours_ = (Quantile(name, 0, 8192)(u)) / 8192
    # The entries are multiples of 1/8192 jitter, on a grid of probabilities half a step away, which tells in the tails.
    assert np.abs(np.sort(table) - ours_)[100:-100].max() < 0.02
    assert (table.min(), table.max()) == pytest.approx((ours_.min(), ours_.max()), abs=0.6)
    written = {"delay": {"time": "200 ms", "jitter": "50 ms", "table": str(path)}}
    kernel = _tabledist(np.rint(table * 8192).astype(np.int64), 200 * MS, 50 * MS)
    assert stats.ks_2samp(kernel, ours(written, ticks=100).ravel()).pvalue > FALSE_ALARM


def _tabledist(table: NDArray[np.int64], mu: int, sigma: int, n: int = 40_000) -> NDArray[np.int64]:
    """The kernel's own arithmetic: net/sched/sch_netem.c, tabledist, with NETEM_DIST_SCALE = 8192."""
    t = table[np.random.default_rng(1).integers(0, 2**32, n) % len(table)]
    x = (sigma % 8192) * t
    x = np.where(x >= 0, x + 4096, x - 4096)
    return np.asarray(np.trunc(x / 8192).astype(np.int64) + (sigma // 8192) * t + mu)
