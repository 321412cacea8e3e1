"""What the report says of the network, on runs whose network did what was planned."""

from pathlib import Path

import numpy as np
import pytest

from cosim.plan import AnalysisPlan
from cosim.reporting import network, report
from cosim.reporting.edges import Edges
from cosim.reporting.figures import heat, timeline
from cosim.reporting.figures.scene import Scene
from cosim.reporting.meanwhile import meanwhile_table
from cosim.results import load
from network.channel import ChannelModel
from network.netem import Ideal, Netem
from tests.recording.networks import make_plan, record


def edges_of(folder: Path, n: int = 4, ticks: int = 120, channel: ChannelModel | None = None) -> Edges:
    record(make_plan(n, ticks, channel=channel), folder)
    return Edges(load(folder))


def test_a_blackout_is_a_break_with_its_times(tmp_path: Path) -> None:
    # Admitted without a bound of the channel: (sqrt(13) - 1)/2 = 1.303 s. Down from 3 s to 6 s: last sample of 2.9 s.
    edges = edges_of(tmp_path / "run", channel=Netem(delay="20 ms", schedule={"down": [["3 s", "6 s"]]}))
    assert all(spans.tolist() == [[43, 61]] for spans in edges.breaks)
    n = len(edges)
    assert (
        network.broken(edges) == f"broken by {n} of {n} edges: {n} of {n} with the channel {edges.results.channel(0)}"
    )
    table = network.breaks_table(edges)
    assert table is not None
    assert len(table.rows) == len(edges)
    assert table.rows[0][2:] == ("1.303 s, published condition", "3.1 s", "15 %", "4.3–6 s")
    totals = dict(network.totals(edges))
    assert totals["Losses in a row on an edge"] == "mean 30, most 30"
    assert totals["Most losses in any 5, 10, 20, 50, 100 in a row"] == "5, 10, 20, 30, 30"
    assert totals["Time between fresh arrivals"].endswith(", largest 3.1 s")
    assert totals["One-way delay"] == "median 0.02 s, 95 % 0.02 s, 99 % 0.02 s, largest 0.02 s"
    report.draw(tmp_path / "run")
    assert "4.3–6 s" in (tmp_path / "run" / "report.html").read_text()


def test_a_window_that_is_not_jointly_rooted_is_named(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", channel=Netem(delay="20 ms", schedule={"down": [["3 s", "6 s"]]}))
    (said,) = (value for label, value in network.totals(edges) if label == "Jointly rooted, in windows of 15 ticks")
    followers = sorted(set(range(1, 5)) - {1, 4})
    assert f"did not reach agents {', '.join(map(str, followers))}" in said
    assert edges.connectivity is not None
    gap = edges.connectivity.first_gap
    assert gap is not None
    assert f"from {gap / 10:g} to {(gap + 14) / 10:g} s" in said


def test_nothing_breaks_where_the_channel_keeps_its_bound(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run")
    assert {one.origin for one in edges.assumed} == {"bound of the channel"}
    assert network.broken(edges) == f"kept by all {len(edges)} edges"
    table = network.breaks_table(edges)
    assert table is not None
    assert not table.rows
    report.draw(tmp_path / "run")
    assert "No edge was older at a tick" in (tmp_path / "run" / "report.html").read_text()


def test_the_condition_has_three_readings(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run")
    allowed, observed, literal = network.readings(edges)
    hearing = len(set(edges.results.links.receiver.tolist()))
    assert (allowed.h_star, allowed.verdict) == ("1.3 s", f"holds for {hearing} of {hearing} agents")
    assert float(observed.h_star.split()[0]) == max(age.tick_sup for age in edges.ages)
    least = edges.common_front.smallest_sum_ns(edges.span.period_ns)
    assert least is not None
    assert float(literal.h_star.split()[0]) == pytest.approx(least / 1e9, rel=1e-3)


def test_an_ideal_network(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", channel=Ideal())
    rows = dict(network.totals(edges))
    assert rows["Assumption 1: least k*·T + h"].startswith("0.1 s common to all edges, (k*, h) = (1, 0 s)")
    assert rows["Jointly rooted, in windows of 1 ticks"] == "all 120 windows"


def test_nothing_is_assumed_without_gains_or_bounds(tmp_path: Path) -> None:
    record(make_plan(3, 30, channel=Netem(loss="10 %"), analysis=AnalysisPlan()), tmp_path / "run")
    edges = Edges(load(tmp_path / "run"))
    assert network.breaks_table(edges) is None
    assert network.readings(edges) == []
    assert ("Jointly rooted", "not evaluated: no h* is assumed") in network.totals(edges)


def test_many_edges_are_folded_worst_first(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", n=40, channel=Netem(delay="20 ms", loss="85 %"))
    table = network.freshness_table(edges)
    assert len(table.first) == network.OPEN_ROWS
    assert len(table.first) + len(table.rest) == len(edges)
    broken = [sum(stop - first for first, stop in edges.breaks[link].tolist()) for link in edges.worst_first]
    assert broken == sorted(broken, reverse=True)
    assert np.any(broken)
    report.draw(tmp_path / "run")
    assert "more edges</summary>" in (tmp_path / "run" / "report.html").read_text()


def test_meanwhile_is_the_disagreement_at_the_times_of_the_break(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", channel=Netem(delay="20 ms", schedule={"down": [["3 s", "6 s"]]}))
    assert edges.incidents == [(43, 61, list(range(len(edges))))]
    table = meanwhile_table(Scene(edges.results))
    assert table is not None
    (row,) = table.rows
    assert row[0] == "4.3 – 6.1 s"
    positions = edges.results.array("plant.p")
    of_agent = np.abs(positions - positions[:, :1]).max(axis=2)
    deviation = of_agent.max(axis=1)
    most = 43 + int(np.argmax(deviation[43:62]))
    worst = edges.results.agents[int(np.argmax(of_agent[most]))]
    assert row[2] == f"{deviation[43]:.2g} → {deviation[most]:.2g} ({worst}) → {deviation[111]:.2g}"


def test_the_map_of_ages_has_the_largest_of_each_bin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    edges = edges_of(tmp_path / "run", channel=Netem(delay="20 ms", schedule={"down": [["3 s", "6 s"]]}))
    monkeypatch.setattr(heat, "MAX_BINS", 24)
    values, width = heat.binned(edges, [0])
    assert (values.shape, width) == ((1, 24), 0.5)
    assert values[0, [5, 6, 11, 12, 13]].tolist() == [0.1, 0.5, 3.0, 3.1, 0.1]


def test_the_timeline_shows_the_worst_of_a_blackout(tmp_path: Path) -> None:
    edges = edges_of(tmp_path / "run", channel=Netem(delay="20 ms", schedule={"down": [["3 s", "6 s"]]}))
    begin, end = timeline.window(edges, edges.worst_first[0], timeline.TICKS)
    assert end - begin == pytest.approx(timeline.TICKS / 10)
    assert begin < 3.0 < 6.0 < end
