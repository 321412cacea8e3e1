"""Every impairment against its closed form or its definition.

Statistical tests have fixed seeds. Each would fail for a perfect channel with probability `FALSE_ALARM` at most, up to
the normal approximation of sums over many independent edges.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from network.channel import ChannelModel, Setting, Transmission
from network.draws import Draws
from network.impairments.mahimahi import OPPORTUNITY_BYTES
from network.messages import NEVER
from network.models import AnyChannelModel
from network.netem import Netem
from tests.network.networks import T, dense_links, links_of

FALSE_ALARM = 1e-6
SIGMAS = float(-stats.norm.ppf(FALSE_ALARM / 2))
MS = 1_000_000
EDGES, TICKS = 300, 1000
ANY: TypeAdapter[ChannelModel] = TypeAdapter(AnyChannelModel)


def _setting(edges: int, size: int = 64, seed: int = 1) -> Setting:
    links = dense_links(edges, 1)
    names = [links.agents[i] for i in links.sender], [links.agents[i] for i in links.receiver]
    return Setting(links, T, Draws(seed, *names), size)


def _sent(written: dict[str, Any], edges: int = EDGES, ticks: int = TICKS, size: int = 64) -> list[Transmission]:
    channel = Netem.model_validate(written).open(_setting(edges, size))
    return [channel.transmit(tick) for tick in range(ticks)]


def _delays(sent: list[Transmission]) -> NDArray[np.int64]:
    """(ticks, edges); every tick every edge sends one."""
    return np.array([messages.delay_ns for messages in sent])


def _close(per_edge: NDArray[np.float64], expected: float) -> bool:
    """Whether the mean over independent edges is as expected."""
    return bool(abs(per_edge.mean() - expected) < SIGMAS * per_edge.std(ddof=1) / np.sqrt(len(per_edge)))


# --- loss ------------------------------------------------------------------------------------------------------------
LOSSES: list[Any] = [
    {"random": "5 %"},
    {"random": "5 %", "correlation": "50 %"},
    {"random": "30 %", "correlation": "90 %"},
    {"gemodel": "5 %"},
    {"gemodel": ["1 %", "20 %"]},
    {"gemodel": ["1 %", "20 %", "70 %", "1 %"]},
    {"gemodel": {"p": "10 %", "r": "40 %", "1-h": "50 %"}},
    {"state": "2 %"},
    {"state": ["2 %", "30 %"]},
    {"state": ["2 %", "30 %", "10 %", "40 %", "1 %"]},
    {"state": {"p13": "5 %", "p31": "20 %", "p14": "3 %"}},
]


@pytest.mark.parametrize("loss", LOSSES)
def test_the_long_run_rate_of_losses(loss: Any) -> None:
    lost = _delays(_sent({"loss": loss})) == NEVER
    expected = Netem.model_validate({"loss": loss}).loss.loss_rate()  # type: ignore[union-attr]
    assert 0 < expected < 1
    assert _close(lost.mean(axis=0), expected)


@pytest.mark.parametrize(
    ("loss", "rate"),
    [
        ({"gemodel": ["1 %", "20 %"]}, 0.01 / 0.21),
        ({"gemodel": ["1 %", "20 %", "70 %", "1 %"]}, (0.01 * 0.7 + 0.2 * 0.01) / 0.21),
        ({"gemodel": "5 %"}, 0.05),  # r = 1 - p: no memory
        ({"state": "2 %"}, 0.02),  # p31 = 1 - p13: no memory, as p31 + p13 = 1
        ({"state": ["2 %", "30 %"]}, 0.02 / 0.32),
    ],
)
def test_rates_in_closed_form(loss: Any, rate: float) -> None:
    assert Netem.model_validate({"loss": loss}).loss.loss_rate() == pytest.approx(rate)  # type: ignore[union-attr]


def _mean_run_of_chain(loss: Any) -> float:
    """P(lost) / P(lost, next received), from the chain's matrix alone."""
    model = Netem.model_validate({"loss": loss}).loss
    assert model is not None
    if model.gemodel is not None:
        ge = model.gemodel
        step = np.array([[1 - ge.p, ge.p], [ge.recovery, 1 - ge.recovery]])
        losing = np.array([ge.good, ge.bad])
    else:
        fs = model.state
        assert fs is not None
        out1, out3 = 1 - fs.p13 - fs.p14, 1 - fs.end_of_burst - fs.p32
        step = np.array(
            [[out1, 0, fs.p13, fs.p14], [0, 1 - fs.p23, fs.p23, 0], [fs.end_of_burst, fs.p32, out3, 0], [1, 0, 0, 0]]
        )
        losing = np.array([0.0, 0, 1, 1])
    stationary = np.linalg.matrix_power(step, 10_000)[0]
    lost = stationary @ losing
    assert lost == pytest.approx(model.loss_rate())
    return float(lost / ((stationary * losing) @ step @ (1 - losing)))


@pytest.mark.parametrize(
    ("loss", "mean_run"),
    [
        ({"random": "20 %"}, 1 / 0.8),
        ({"random": "20 %", "correlation": "50 %"}, 1 / (0.5 * 0.8)),
        ({"gemodel": ["1 %", "20 %"]}, 5.0),
        ({"gemodel": ["5 %", "20 %", "70 %", "5 %"]}, None),
        ({"state": ["5 %", "25 %"]}, 4.0),
        ({"state": ["2 %", "30 %", "10 %", "40 %", "1 %"]}, None),
    ],
)
def test_the_mean_run_of_losses(loss: Any, mean_run: float | None) -> None:
    lost = _delays(_sent({"loss": loss})) == NEVER
    stated = Netem.model_validate({"loss": loss}).loss.mean_burst()  # type: ignore[union-attr]
    assert mean_run is None or stated == pytest.approx(mean_run)
    # P(lost)/P(a run ends): the mean of a ratio, tested as a difference of means over independent edges.
    ends = (lost[:-1] & ~lost[1:]).mean(axis=0)
    assert _close(lost[:-1].mean(axis=0) - stated * ends, 0.0)


def test_the_mean_burst_of_gemodel_is_that_of_its_chain() -> None:
    for loss in (["1 %", "20 %"], ["5 %", "20 %", "70 %", "5 %"], ["60 %", "70 %", "90 %"]):
        model = Netem.model_validate({"loss": {"gemodel": loss}}).loss
        assert model is not None
        assert model.gemodel is not None
        assert model.gemodel.mean_burst() == pytest.approx(_mean_run_of_chain({"gemodel": loss}))


@pytest.mark.parametrize("lag", [1, 2, 4])
def test_correlated_losses_and_duplicates_have_their_correlation(lag: int) -> None:
    rate, correlation = 0.2, 0.6
    lost = _delays(_sent({"loss": {"random": rate, "correlation": correlation}})) == NEVER
    twice = np.zeros((TICKS, EDGES), np.bool_)
    for tick, messages in enumerate(_sent({"duplicate": {"random": rate, "correlation": correlation}})):
        twice[tick, messages.link[messages.copy == 1]] = True
    for event in (lost, twice):
        both = (event[lag:] & event[:-lag]).mean(axis=0)
        assert _close(both, rate**2 + rate * (1 - rate) * correlation**lag)
        assert _close(event.mean(axis=0), rate)


def test_a_chain_begins_in_its_stationary_distribution() -> None:
    for loss in ({"gemodel": ["2 %", "10 %"]}, {"state": ["5 %", "25 %"]}):
        lost = _delays(_sent({"loss": loss}, edges=4000, ticks=1)) == NEVER
        rate = Netem.model_validate({"loss": loss}).loss.loss_rate()  # type: ignore[union-attr]
        assert stats.binomtest(int(lost.sum()), lost.size, rate).pvalue > FALSE_ALARM


# --- duplicates and order --------------------------------------------------------------------------------------------
def test_duplicates_have_their_rate_and_their_own_delays() -> None:
    sent = _sent({"duplicate": "10 %", "delay": ["10 ms", "90 ms"]}, ticks=400)
    copies = np.concatenate([messages.copy for messages in sent])
    assert stats.binomtest(int(copies.sum()), EDGES * 400, 0.1).pvalue > FALSE_ALARM
    messages = max(sent, key=lambda messages: len(messages.link))
    twice = messages.link[messages.copy == 1]
    first = messages.delay_ns[messages.copy == 0][twice]
    assert (first != messages.delay_ns[messages.copy == 1]).all()


def test_a_gap_keeps_messages_back_from_going_ahead() -> None:
    delays = _delays(_sent({"delay": "50 ms", "reorder": {"random": "50 %", "gap": 4}}))
    ahead = delays == 0
    assert set(np.unique(delays)) == {0, 50 * MS}
    for edge in range(20):
        assert np.diff(np.flatnonzero(ahead[:, edge])).min() >= 4
    # A cycle: three that may not, then geometrically many of which the last one goes ahead.
    assert _close(ahead[4:].mean(axis=0), 1 / (3 + 1 / 0.5))


class _ParetoNormal:
    """A quarter of a normal number and three quarters of a pareto one that rise together, by bisection."""

    def __init__(self, mean: float, jitter: float) -> None:
        self._mean, self._jitter = mean, jitter

    def cdf(self, delay: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = np.zeros_like(delay), np.ones_like(delay)
        for _ in range(60):
            middle = (low + high) / 2
            pareto = np.minimum((stats.pareto.ppf(middle, 3) - 1.5) * 4 / 3, 4)
            below = self._mean + self._jitter * (stats.norm.ppf(middle) / 4 + pareto * 3 / 4) < delay
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return low


# --- delay -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("correlation", ["0 %", "60 %"])
@pytest.mark.parametrize(
    ("distribution", "law"),
    [
        ("uniform", stats.uniform(30, 20)),
        ("normal", stats.norm(40, 10)),
        ("lognormal", stats.lognorm(np.sqrt(np.log1p(1 / 16)), scale=40 / np.sqrt(1 + 1 / 16))),
        ("gamma", stats.gamma(16, scale=2.5)),
        ("paretonormal", _ParetoNormal(40, 10)),
    ],
)
def test_delays_follow_their_law_whatever_the_correlation(distribution: str, law: Any, correlation: str) -> None:
    delay = {"time": "40 ms", "jitter": "10 ms", "distribution": distribution, "correlation": correlation}
    delays = _delays(_sent({"delay": delay}, edges=2000, ticks=21)) / MS
    assert stats.kstest(delays[-1], law.cdf).pvalue > FALSE_ALARM


def test_pareto_has_its_shape_and_its_cut() -> None:
    delays = _delays(_sent({"delay": {"time": "40 ms", "jitter": "10 ms", "distribution": "pareto"}})).ravel() / MS
    below = delays < 80
    expected = 1 - (1.5 + 0.75 * 4) ** -3.0
    assert stats.binomtest(int(below.sum()), below.size, expected).pvalue > FALSE_ALARM
    law = stats.pareto(3, loc=-1.5)  # in units of 3/4 jitter, above the mean
    uniform = law.cdf((delays[below] - 40) / 10 * 0.75) / expected
    assert stats.kstest(uniform[::20], "uniform").pvalue > FALSE_ALARM
    assert delays.max() == 80


def test_correlated_delays_have_the_correlation_of_their_normal_scores() -> None:
    delay = {"time": "400 ms", "jitter": "10 ms", "correlation": "70 %", "distribution": "normal"}
    scores = (_delays(_sent({"delay": delay})) / MS - 400) / 10
    assert _close((scores[1:] * scores[:-1]).mean(axis=0), 0.7)


def test_a_table_is_drawn_from_evenly(tmp_path: Path) -> None:
    table = tmp_path / "three.dist"
    table.write_text("# three values\n-8192 0\n 16384 # two jitters\n")
    delays = _delays(_sent({"delay": {"time": "40 ms", "jitter": "10 ms", "table": str(table)}}))
    values, counts = np.unique(delays, return_counts=True)
    assert values.tolist() == [30 * MS, 40 * MS, 60 * MS]
    assert stats.chisquare(counts).pvalue > FALSE_ALARM
    model = Netem.model_validate({"delay": {"time": "40 ms", "jitter": "10 ms", "table": str(table)}})
    assert (model.min_delay_ns(), model.age_bound_ns(T)) == (30 * MS, 100 * MS)


def test_delays_are_cut_and_bounded() -> None:
    delay = {"time": "40 ms", "jitter": "30 ms", "distribution": "normal", "min": "20 ms", "max": "50 ms"}
    delays = _delays(_sent({"delay": delay}))
    assert (delays.min(), delays.max()) == (20 * MS, 50 * MS)
    model = Netem.model_validate({"delay": delay})
    assert (model.min_delay_ns(), model.age_bound_ns(T)) == (20 * MS, 100 * MS)


def test_messages_that_keep_their_order_arrive_in_it() -> None:
    delay = {"time": "300 ms", "jitter": "290 ms", "fifo": True}
    arrivals = _delays(_sent({"delay": delay})) + np.arange(TICKS)[:, None] * T
    assert (np.diff(arrivals, axis=0) >= 0).all()
    free = _delays(_sent({"delay": delay | {"fifo": False}})) + np.arange(TICKS)[:, None] * T
    assert (arrivals == np.maximum.accumulate(free, axis=0)).all()


# --- rate, slots, traces ---------------------------------------------------------------------------------------------
@settings(deadline=None, max_examples=50)
@given(
    st.integers(1, 4000),
    st.one_of(st.none(), st.integers(1, 5)),
    st.integers(0, 60),
    st.integers(0, 100),
)
def test_a_link_of_limited_rate_is_a_queue(rate: int, limit: int | None, overhead: int, twice: int) -> None:
    written = {"rate": {"rate": f"{rate} bit/s", "overhead": overhead, "limit": limit}, "duplicate": f"{twice} %"}
    service = Netem.model_validate(written).rate.transmission_ns(64)  # type: ignore[union-attr]
    assert service == -(-(64 + overhead) * 8_000_000_000 // rate)
    departures: list[int] = []
    for tick, messages in enumerate(_sent(written, edges=2, ticks=60)):
        for delay in messages.delay_ns[messages.link == 0].tolist():
            waiting = [time for time in departures if time > tick * T]
            if limit is not None and len(waiting) >= limit:
                assert delay == NEVER
                continue
            departures.append(max([tick * T, *waiting]) + service)
            assert delay == departures[-1] - tick * T


def test_cells_round_a_message_up() -> None:
    rate = {"rate": "1 Mbit/s", "overhead": 8, "cell": 48, "cell_overhead": 5}
    model = Netem.model_validate({"rate": rate})
    assert model.rate is not None
    assert model.rate.transmission_ns(64) == 2 * 53 * 8 * 1000


def test_the_mean_wait_in_a_queue_is_that_of_its_random_walk() -> None:
    # One or two messages per tick, service 0.6 T: what is left at ticks goes up by 0.2 T or down by 0.4 T, not below 0.
    # In units of 0.2 T it is geometric with ratio z, z^3 - 2 z + 1 = 0: z = (sqrt(5) - 1)/2, of mean z/(1 - z).
    sent = _sent({"rate": {"rate": "8000 bit/s", "overhead": -4}, "duplicate": "50 %"}, edges=4000, ticks=150)
    last = sent[-1]
    wait = last.delay_ns[last.copy == 0] - 60 * MS
    assert (wait % (20 * MS) == 0).all()
    assert _close(wait / (20 * MS), (1 + np.sqrt(5)) / 2)


@pytest.mark.parametrize(("p", "service"), [(0.1, 5), (0.3, 2), (0.06, 10)])
def test_the_mean_wait_for_a_link_is_that_of_geo_d_1(p: float, service: int) -> None:
    # A message at a tick with probability p, each taking D ticks: M/D/1 on a grid, which it becomes for large D. The
    # mean wait is p D (D - 1) / (2 (1 - p D)) ticks (Hunter: "Mathematical Techniques of Applied Probability 2", 1983).
    rate = f"{64 * 8 / (service * T) * 1e9!r} bit/s"
    delays = _delays(_sent({"loss": 1 - p, "rate": rate}, edges=4000, ticks=90 * service))[60 * service :]
    arrived = delays != NEVER
    wait = np.where(arrived, delays / T - service, 0)
    expected = p * service * (service - 1) / (2 * (1 - p * service))
    # A ratio over independent edges, as a difference of means.
    assert _close((wait - expected * arrived).sum(axis=0), 0.0)


def test_a_link_without_a_queue_loses_what_finds_it_busy() -> None:
    # After each message that it takes, D - 1 ticks at which it takes none: (D - 1) p of 1 + (D - 1) p are lost.
    p, service = 0.2, 5
    rate = {"rate": f"{64 * 8 / (service * T) * 1e9!r} bit/s", "limit": 1}
    offered = _delays(_sent({"loss": 1 - p}, ticks=2000)) != NEVER
    taken = _delays(_sent({"loss": 1 - p, "rate": rate}, ticks=2000)) != NEVER
    assert not (taken & ~offered).any()
    share = (service - 1) * p / (1 + (service - 1) * p)
    assert _close((offered & ~taken)[50:].sum(axis=0) - share * offered[50:].sum(axis=0), 0.0)


def test_slots_take_what_has_come_and_no_more_than_they_hold() -> None:
    sent = _sent({"slot": {"every": "250 ms", "packets": 2}}, edges=1, ticks=40)
    arrivals = [int(messages.delay_ns[0]) + tick * T for tick, messages in enumerate(sent)]
    assert all(arrival % (250 * MS) == 0 for arrival in arrivals)
    assert max(np.unique(arrivals, return_counts=True)[1]) == 2
    assert arrivals == sorted(arrivals)
    drawn = _sent({"slot": ["20 ms", "80 ms"]}, edges=3000, ticks=100)
    assert 0 <= _delays(drawn).min() <= _delays(drawn).max() <= 80 * MS
    # Far from the start a message meets an interval in proportion to its length: E[X^2] / (2 E[X]) on average.
    mean, square = 50.0, 50.0**2 + 60.0**2 / 12
    assert _close(_delays(drawn)[-1] / MS, square / (2 * mean))


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.integers(0, 400), min_size=1, max_size=12).filter(lambda times: max(times) > 0),
    st.integers(1, 4000),
    st.one_of(st.none(), st.integers(1, 4)),
    st.integers(0, 1500),
)
def test_a_trace_delivers_as_its_definition_says(
    tmp_path_factory: pytest.TempPathFactory, times: list[int], size: int, limit: int | None, start_ms: int
) -> None:
    trace = tmp_path_factory.mktemp("trace") / "cell.trace"
    times = sorted(times)
    trace.write_text("".join(f"{time}\n" for time in times))
    mahimahi = {"file": str(trace), "limit": limit, "start": f"{start_ms} ms"}
    sent = _sent({"mahimahi": mahimahi}, edges=2, ticks=25, size=size)
    cycle, start = times[-1], start_ms % times[-1]
    # Opportunities one by one, from the beginning of the trace.
    opportunities = (c * cycle + time - start for c in range(100_000) for time in times)
    current, room = next(opportunities), OPPORTUNITY_BYTES
    departures: list[int] = []
    for tick, messages in enumerate(sent):
        now = tick * T // MS
        if limit is not None and sum(time > now for time in departures) >= limit:
            assert messages.delay_ns.tolist() == [NEVER, NEVER]
            continue
        while current < now:
            current, room = next(opportunities), OPPORTUNITY_BYTES
        left = size
        while left:
            used = min(left, room)
            left, room = left - used, room - used
            leaves = current
            if not room:
                current, room = next(opportunities), OPPORTUNITY_BYTES
        departures.append(leaves)
        assert messages.delay_ns.tolist() == [(leaves - now) * MS] * 2


def test_a_recording_is_played_again_and_again(tmp_path: Path) -> None:
    file = tmp_path / "lte.csv"
    file.write_text("time,delay,loss\n0,20 ms,0\n0.3,0.05,100 %\n0.5,10 ms,0\n0.8,0,0\n")
    delays = _delays(_sent({"recorded": {"file": str(file), "fifo": False}}, edges=1, ticks=16))[:, 0]
    cycle = [20 * MS] * 3 + [NEVER] * 2 + [10 * MS] * 3
    assert delays.tolist() == cycle * 2


def test_a_recording_loses_at_the_rate_of_each_line(tmp_path: Path) -> None:
    file = tmp_path / "lte.csv"
    file.write_text("time,delay,loss\n0,20 ms,5 %\n1,30 ms,40 %\n2,0,0\n")
    delays = _delays(_sent({"recorded": str(file)}))
    for first, rate, delay in ((0, 0.05, 20), (10, 0.4, 30)):
        of_line = delays[np.arange(TICKS) % 20 // 10 * 10 == first]
        assert set(np.unique(of_line)) == {NEVER, delay * MS}
        assert _close((of_line == NEVER).mean(axis=0), rate)


# --- schedules -------------------------------------------------------------------------------------------------------
def test_a_schedule_loses_what_it_says() -> None:
    schedule = {
        "drop": [1, "3..4"],
        "down": [["1 s", "2 s"]],
        "outage": {"every": "10 s", "for": "1 s", "first": "5 s"},
    }
    lost = np.flatnonzero(_delays(_sent({"schedule": schedule}, edges=1, ticks=200))[:, 0] == NEVER)
    assert lost.tolist() == [0, 2, 3, *range(10, 20), *range(50, 60), *range(150, 160)]
    up = _delays(_sent({"schedule": {"up": [["1 s", "2 s"], ["3 s", "4 s"]]}}, edges=1, ticks=60))[:, 0]
    assert np.flatnonzero(up != NEVER).tolist() == [*range(10, 20), *range(30, 40)]


# --- rules that all keep ---------------------------------------------------------------------------------------------
EVERYTHING = {
    "schedule": {"drop": [2], "down": [["1 s", "2 s"]], "outage": {"every": "3 s", "for": "200 ms"}},
    "loss": {"gemodel": ["5 %", "30 %"]},
    "duplicate": {"random": "20 %", "correlation": "30 %"},
    "slot": {"every": ["20 ms", "60 ms"], "packets": 2},
    "rate": {"rate": "20 kbit/s", "limit": 5},
    "delay": {"time": "200 ms", "jitter": "80 ms", "correlation": "40 %", "distribution": "gamma"},
    "reorder": {"random": "20 %", "gap": 2},
}


def test_an_edge_does_not_depend_on_the_others() -> None:
    model = Netem.model_validate(EVERYTHING)
    together = model.open(_setting(12))
    few_links = links_of([f"arm{i}" for i in range(12)], [(1, 0), (2, 1)])
    single = model.open(Setting(few_links, T, Draws(1, ["arm1", "arm2"], ["arm0", "arm1"]), 64))
    for tick in range(120):
        all_of_them, few = together.transmit(tick), single.transmit(tick)
        for link in (0, 1):
            mine, same = all_of_them.link == link, few.link == link
            assert all_of_them.delay_ns[mine].tolist() == few.delay_ns[same].tolist()
            assert all_of_them.copy[mine].tolist() == few.copy[same].tolist()


ONE_BY_ONE: list[dict[str, Any]] = [
    EVERYTHING,
    {"schedule": {"drop": [2, "5..9"], "down": [["1 s", "2 s"]]}, "loss": {"gemodel": ["5 %", "30 %", "70 %", "1 %"]}},
    {"loss": {"gemodel": ["60 %", "70 %"]}, "delay": {"time": "300 ms", "jitter": "290 ms", "fifo": True}},
    {"loss": {"state": ["5 %", "30 %", "10 %", "40 %", "1 %"]}, "delay": {"time": "90 ms", "jitter": "50 ms"}},
    {"loss": {"random": "9 %", "correlation": "50 %"}, "duplicate": "30 %", "slot": ["20 ms", "260 ms"]},
    {"loss": "20 %", "delay": {"time": "40 ms", "jitter": "30 ms", "distribution": "normal", "correlation": "20 %"}},
    {"model": "window", "depth": 3, "delay": ["10 ms", "30 ms"], "loss": {"gemodel": ["5 %", "30 %"]}},
    {"model": "window", "depth": 70, "delay": {"time": "300 ms", "jitter": "290 ms", "fifo": True}},
]


@pytest.mark.parametrize("written", ONE_BY_ONE)
@pytest.mark.parametrize("edges", [3, 700])
def test_many_ticks_at_once_are_the_same_ticks_one_by_one(written: dict[str, Any], edges: int) -> None:
    model = ANY.validate_python({"model": "netem"} | written)
    single, many = (model.open(_setting(edges)) for _ in range(2))
    tick = 0
    for n_ticks in (1, 64, 2, 3, 5, 80, 1):
        ticks = range(tick, tick + n_ticks)
        for sent, tick in zip(many.transmit_many(ticks).by_tick(), ticks, strict=True):
            expected = single.transmit(tick)
            for name in ("link", "stamp", "delay_ns", "copy"):
                assert getattr(sent, name).tolist() == getattr(expected, name).tolist()
        tick += 1


def test_what_a_user_writes_can_be_written_again() -> None:
    model = Netem.model_validate(EVERYTHING)
    written = model.as_written()
    assert Netem.model_validate(written) == model
    assert written["loss"]["gemodel"] == {"p": 0.05, "r": 0.3}


# --- mistakes --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"loss": "120 %"}, "must be from 0 to 1"),
        ({"loss": {"random": "2 %", "gemodel": "1 %"}}, "give one of `random`, `state` and `gemodel`"),
        ({"loss": {"gemodel": ["1 %"], "correlation": "10 %"}}, "`correlation` is for `random`"),
        ({"loss": {"gemodel": ["1 %", 0]}}, "r is 0 and every message is lost in the bad state"),
        ({"loss": {"gemodel": ["1 %", "2 %", "3 %", "4 %", "5 %"]}}, "in the order p, r, 1-h, 1-k"),
        ({"loss": {"state": ["60 %", "1 %", 0, 1, "60 %"]}}, "p13 + p14 is 1.2"),
        ({"loss": {"state": ["60 %", "70 %", "60 %"]}}, "p31 + p32 is 1.3"),
        ({"loss": {"state": ["60 %", 0]}}, "a burst never ends"),
        ({"delay": {"time": "10 ms", "min": "5 ms", "max": "2 ms"}}, "`max` is less than `min`"),
        (
            {"delay": {"time": "10 ms", "jitter": "1 ms", "distribution": "gamma", "table": __file__}},
            "is no whole number of",
        ),
        ({"delay": {"time": 0, "jitter": "1 ms", "distribution": "gamma"}}, "needs a mean `time`"),
        ({"delay": "-1 ms"}, "negative"),
        ({"reorder": "1 %"}, "give a `delay` as well"),
        ({"rate": "fast"}, "'fast' is not a rate"),
        ({"rate": "3 Mbyte/s"}, "unknown unit of rate"),
        ({"rate": 0}, "must be more than 0"),
        ({"mahimahi": "nowhere.trace"}, "no such file"),
        ({"schedule": {"down": [["2 s", "1 s"]]}}, "a window begins at 0 or later and ends after it begins"),
        ({"schedule": {"down": [["1 s", "3 s"], ["2 s", "4 s"]]}}, "do not overlap"),
        ({"schedule": {"drop": [0]}}, "counted from 1"),
        ({"schedule": {"drop": ["9..3"]}}, "a range begins with the lesser number"),
        ({"schedule": {"drop": ["1..999999999999999"]}}, "more than a million messages"),
        ({"schedule": {"down": [["-1 s", "1 s"]]}}, "a window begins at 0 or later"),
        ({"delay": {"time": "10 ms", "jitter": "-1 ms"}}, "negative"),
        ({"delay": {"time": "10 ms", "correlation": "101 %"}}, "must be from 0 to 1"),
        ({"loss": {"gemodel": {"p": "nan"}}}, "must be from 0 to 1"),
        ({"rate": "inf bit/s"}, "is not a rate"),
        ({"schedule": {"outage": {"every": "1 s", "for": "2 s"}}}, "an outage must be shorter"),
        ({"slot": "1 ns"}, "slots must be 1 us apart"),
    ],
)
def test_mistakes_get_a_sentence(written: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=r".") as caught:
        Netem.model_validate(written)
    assert any(said in error["msg"] for error in caught.value.errors()), caught.value


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the trace is empty"),
        ("5\nsix\n", ":2: 'six' is no whole number of milliseconds"),
        ("5\n3\n", ":2: 3 comes after 5"),
        ("0\n", "the last time is 0"),
    ],
)
def test_a_malformed_trace_names_the_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "x.trace").write_text(text)
    with pytest.raises(ValidationError, match=r".") as caught:
        _sent({"mahimahi": str(tmp_path / "x.trace")})
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", ":1: the first line names the columns"),
        ("time,delay\n0,1 ms\n", "at least two lines"),
        ("time,delay\n0,1 ms\n1\n", ":3: 1 cells, not 2"),
        ("time,delay\n0,soon\n1,0\n", ":2: 'soon' is not a time"),
        ("time,delay\n0,1 ms\n0,1 ms\n", ":3: times must rise"),
        ("time,delay,loss\n0,1 ms,1\n1,1 ms,0\n", "every message would be lost"),
    ],
)
def test_a_malformed_recording_names_the_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(ValidationError, match=r".") as caught:
        _sent({"recorded": str(tmp_path / "x.csv")})
    assert said in str(caught.value)
