"""The figures of a network: what their lines say, read from the lines."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from cosim.reporting.edges import Edges
from cosim.reporting.figures.age import draw_age
from cosim.reporting.figures.delays import MAX_POINTS, distribution, draw_delays
from cosim.reporting.figures.front import draw_front
from cosim.reporting.figures.losses import draw_losses
from cosim.reporting.figures.style import styled
from cosim.results import load
from network.channel import ChannelModel
from network.netem import Netem
from network.traffic import loss_runs
from tests.recording.networks import make_plan, record

BURSTS = Netem.model_validate({"delay": ["10 ms", "30 ms"], "loss": {"gemodel": ["10 %", "40 %"]}})
BLACKOUT = Netem.model_validate({"delay": "20 ms", "schedule": {"down": [["10 s", "13 s"]]}})


def edges_of(folder: Path, channel: ChannelModel, ticks: int = 400) -> Edges:
    record(make_plan(4, ticks, channel=channel), folder)
    return Edges(load(folder))


def test_the_delays_level_off_at_the_share_that_arrives(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", BURSTS)
    with styled():
        figure, caption = draw_delays(edges)
    x, y = figure.axes[0].lines[0].get_data()
    known = sum(one.sent - one.in_flight for one in edges.traffic)
    arrived = sum(one.delivered + one.superseded for one in edges.traffic)
    assert np.max(y) == pytest.approx(arrived / known)
    assert (np.min(x), np.max(x)) == (pytest.approx(0.01, abs=1e-3), pytest.approx(0.03, abs=1e-3))
    assert "median 0.02 s" in caption


@pytest.mark.parametrize("n", [1, 7, 3 * MAX_POINTS])
def test_a_distribution_is_the_empirical_one(n: int) -> None:
    values = np.random.default_rng(1).gamma(2.0, size=n)
    x, y = distribution(values, n)
    exact = stats.ecdf(values).cdf.evaluate(x)
    assert np.abs(y[1::2] - exact[1::2]).max() < 1e-12
    assert (np.diff(x) >= 0).all()
    assert (y[0], y[-1]) == (0.0, 1.0)


def test_runs_of_losses_stand_beside_independent_ones(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", BURSTS)
    with styled():
        figure, _ = draw_losses(edges)
    observed, independent = figure.axes[0].lines
    runs = np.concatenate([loss_runs(log) for log in edges.logs])
    for length, share in zip(*observed.get_data(), strict=True):
        assert share == pytest.approx(np.mean(runs >= length))
    rate = sum(one.lost for one in edges.traffic) / sum(one.sent - one.in_flight for one in edges.traffic)
    assert independent.get_data()[1][1] == pytest.approx(rate)


def test_the_front_passes_through_the_least_sum(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", BURSTS)
    with styled():
        figure, caption = draw_front(edges)
    least = edges.common_front.smallest_sum_ns(edges.span.period_ns)
    assert least is not None
    _, line, dot = figure.axes[0].lines
    (k_star,), (h,) = dot.get_data()
    assert k_star * 0.1 + h == pytest.approx(least / 1e9)
    assert line.get_data()[1][0] == pytest.approx(least / 1e9)
    assert f"k* = {k_star}" in caption


def test_the_age_is_shown_where_it_was_too_old(tmp_path: Path) -> None:
    with styled():
        figure, caption = draw_age(edges_of(tmp_path / "run", BLACKOUT))
    curve, bound = figure.axes[0].lines
    begin, end = figure.axes[0].get_xlim()
    assert begin < 10 < 13 < end
    assert np.max(curve.get_data()[1]) == pytest.approx(3.12)
    assert bound.get_data()[1][0] == pytest.approx((np.sqrt(13) - 1) / 2, abs=1e-6)
    assert "published condition" in caption
