"""Every figure is drawn for few and for many agents; what does not apply is left out with a sentence."""

import argparse
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from cosim.documents import measures
from cosim.errors import ConfigError
from cosim.plan import AnalysisPlan
from cosim.reporting import findings, network, report
from cosim.reporting.edges import Edges
from cosim.reporting.figures import FIGURES, age, disagreement
from cosim.reporting.figures import graph as drawing
from cosim.reporting.figures.scene import MAX_POINTS, Scene, short_name
from cosim.reporting.figures.style import legend_lines
from cosim.results import load
from network.netem import Netem
from tests.recording.networks import V_D, VARIABLES, make_plan, record, restrict

NAMES = [entry.name for entry in FIGURES]
LOSSLESS = [name for name in NAMES if name != "losses"]  # the figures of a run on the paper's channel


class Page(HTMLParser):
    """Attributes of every tag, all identifiers, and the visible text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.attributes: list[tuple[str, str, str]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self.open:
            while self.open.pop() != tag:
                pass

    def handle_data(self, data: str) -> None:
        if not {"style", "defs", "metadata"} & set(self.open):
            self.text += f" {data}"


@pytest.fixture(scope="module", params=[10, 18, 100])
def drawn(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with its report."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    record(make_plan(request.param, 150), folder)
    assert report.draw(folder) == folder / "report.html"
    return folder


def test_every_figure_is_there(drawn: Path) -> None:
    expected = sorted(f"{name}{suffix}" for name in LOSSLESS for suffix in (".svg", ".pdf"))
    assert sorted(path.name for path in (drawn / "figures").iterdir()) == expected
    page = (drawn / "report.html").read_text()
    assert page.count("<svg") == len(LOSSLESS)
    assert page.split("Not drawn")[1].count("<p ") == page.count("No message was lost.") == 1


def test_svgs_are_well_formed_and_pdfs_are_pdfs(drawn: Path) -> None:
    for path in (drawn / "figures").iterdir():
        if path.suffix == ".svg":
            root = ET.parse(path).getroot()
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            assert root.get("width") == "252pt"  # 3.5 inches: one column
            assert "nan" not in re.sub(r'id="[^"]*"|"#[^"]*"|"data:[^"]*"', "", path.read_text().lower())
        else:
            assert path.read_bytes().startswith(b"%PDF")
            assert b"/Type3" not in path.read_bytes()


def test_page_loads_nothing(drawn: Path) -> None:
    text = (drawn / "report.html").read_text()
    page = Page(text)
    loading = [
        (tag, name, value)
        for tag, name, value in page.attributes
        if name in ("src", "href", "xlink:href", "data", "action")
        and not value.startswith(("#", "data:image/png;base64,"))
    ]
    links = {f"figures/{name}.{suffix}" for name in LOSSLESS for suffix in ("svg", "pdf")}
    assert {value for _, _, value in loading} == links
    assert all(tag == "a" for tag, _, _ in loading)
    assert "<script" not in text
    assert not re.search(r"url\((?!#)", text)
    assert "@import" not in text


def test_identifiers_are_unique_and_references_resolve(drawn: Path) -> None:
    page = Page((drawn / "report.html").read_text())
    found = [value for _, name, value in page.attributes if name == "id"]
    assert len(found) == len(set(found))
    targets = {value[1:] for _, name, value in page.attributes if name == "xlink:href" and value[0] == "#"}
    targets |= {match for _, _, value in page.attributes for match in re.findall(r"url\(#([^)]*)\)", value)}
    assert targets <= set(found)


def test_page_says_what_ran(drawn: Path) -> None:
    results = load(drawn)
    text = Page((drawn / "report.html").read_text()).text
    for expected in (results.manifest["digest"], results.manifest["title"], "complete", "15 s", "holds", "1.3 s"):
        assert expected in text
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", text, re.IGNORECASE)


def test_page_explains_its_measures_by_itself(drawn: Path) -> None:
    """Whoever is sent it has no docs."""
    text = Page((drawn / "report.html").read_text()).text
    assert "docs/" not in text
    assert {"MATI", "h* assumed", "Jointly rooted"} <= {name for name, _, _ in measures()}
    for row in measures():
        assert all(cell in text for cell in row)


def test_drawing_again_gives_the_same_files(tmp_path: Path) -> None:
    record(make_plan(10, 60), tmp_path / "run")
    contents = []
    for _ in range(2):
        report.draw(tmp_path / "run")
        drawn = [*(tmp_path / "run" / "figures").iterdir(), tmp_path / "run" / "report.html"]
        contents.append({path.name: path.read_bytes() for path in drawn})
    assert contents[0] == contents[1]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(make_plan(2, 20), tmp_path / "run")
    assert report.main(argparse.Namespace(run=tmp_path / "run")) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'run' / 'report.html'}\n"
    with pytest.raises(ConfigError, match="no such folder"):
        report.main(argparse.Namespace(run=tmp_path / "other"))


# --- what does not apply ----------------------------------------------------------------------------------------------
def not_drawn(folder: Path) -> dict[str, str]:
    """Draw; the sentence for every figure that is not there."""
    report.draw(folder)
    missing = [name for name in NAMES if not (folder / "figures" / f"{name}.svg").exists()]
    text = (folder / "report.html").read_text()
    titles = {entry.name: entry.title for entry in FIGURES}
    return {name: re.search(rf"<b>{titles[name]}\.</b> (.*)</p>", text)[1] for name in missing}  # type: ignore[index]


def test_no_roles(tmp_path: Path) -> None:
    record(make_plan(3, 30, analysis=AnalysisPlan()), tmp_path / "run")
    missing = not_drawn(tmp_path / "run")
    assert set(missing) == {"positions", "velocities", "estimates", "disagreement", "parameters", "losses"}
    assert missing["estimates"] == "The scenario does not say which variable is the estimate (analysis.estimate)."
    assert "guarantees" not in (tmp_path / "run" / "report.html").read_text()


def test_roles_that_are_not_recorded(tmp_path: Path) -> None:
    record(restrict(make_plan(3, 30), ["plant.v"]), tmp_path / "run")
    missing = not_drawn(tmp_path / "run")
    assert set(missing) == {"channel", "positions", "estimates", "parameters", "losses"}
    assert missing["positions"] == "plant.p was not recorded."
    assert missing["channel"] == "No sender recorded a variable that it published."


def test_figures_of_an_earlier_report_go(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    record(restrict(make_plan(3, 30), ["plant.v"]), tmp_path / "run")
    (tmp_path / "run" / "figures").mkdir()
    (tmp_path / "run" / "figures" / "positions.svg").write_text("old")
    assert "positions" in not_drawn(tmp_path / "run")


def test_only_some_agents_record(tmp_path: Path) -> None:
    plan = make_plan(4, 30, record=[VARIABLES, {}, VARIABLES, {}])
    record(plan, tmp_path / "run")
    assert set(not_drawn(tmp_path / "run")) == {"losses"}
    assert Scene(load(tmp_path / "run")).signal("position").agents == [0, 2]
    record(make_plan(4, 30, record=[VARIABLES, {}, {}, {}]), tmp_path / "lonely")
    assert "Only one agent records plant.p" in not_drawn(tmp_path / "lonely")["positions"]


@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_run_that_ended_at_once(tmp_path: Path, ticks: int) -> None:
    record(make_plan(3, 100), tmp_path / "run", status="aborted: agent 2 failed", ticks=ticks)
    missing = not_drawn(tmp_path / "run")
    assert (set(missing) == set(NAMES) - {"graph"}) == (ticks == 0)
    text = (tmp_path / "run" / "report.html").read_text()
    assert "aborted: agent 2 failed" in text
    assert "of 10 s" in text


def test_leaderless(tmp_path: Path) -> None:
    record(make_plan(5, 60, leaders=()), tmp_path / "run")
    assert not_drawn(tmp_path / "run") == {"losses": "No message was lost."}
    results = load(tmp_path / "run")
    assert "|vᵢ − mean|" in findings.agreement(results)[1][0]
    assert ("Leaders", "none") in findings.graph(results)


def test_channel_that_loses_without_bound(tmp_path: Path) -> None:
    channel = Netem(delay=["10 ms", "30 ms"], loss="40 %")
    record(make_plan(4, 80, channel=channel), tmp_path / "run")
    assert not_drawn(tmp_path / "run") == {}
    results = load(tmp_path / "run")
    rows = dict(network.totals(Edges(results)))
    lost = np.count_nonzero(results.deliveries["fate"] == "lost")
    assert f"{lost} lost" in rows["Of these"]
    assert rows["Age at ticks, largest that the channels allow (h*)"] == "no bound"
    assert {line.verdict for line in findings.conditions(results)} == {"cannot be evaluated", "hears nobody"}


def test_more_agents_than_a_graph_can_show(tmp_path: Path) -> None:
    record(make_plan(drawing.MAX_AGENTS + 1, 30), tmp_path / "run")
    assert set(not_drawn(tmp_path / "run")) == {"graph", "losses"}


def test_names_that_are_markup(tmp_path: Path) -> None:
    plan = make_plan(3, 20)
    names = ("<b>&", "$a_1", "x" * 40)
    plan = replace(
        plan,
        title="<script>alert(1)</script>",
        links=replace(plan.links, agents=names),
        agents=tuple(replace(agent, name=name) for agent, name in zip(plan.agents, names, strict=True)),
        analysis=replace(plan.analysis, leaders=("$a_1",), k_eta=None, lambda_=None),
    )
    record(plan, tmp_path / "run")
    assert set(not_drawn(tmp_path / "run")) == {"losses"}
    assert "<script" not in (tmp_path / "run" / "report.html").read_text()


# --- numbers ----------------------------------------------------------------------------------------------------------
def test_conditions_of_the_paper(tmp_path: Path) -> None:
    record(make_plan(10, 20), tmp_path / "run")
    lines = findings.conditions(load(tmp_path / "run"))
    hearing = [line for line in lines if line.in_neighbours != "0"]
    assert {(line.kappa, line.mu, line.h_star, line.bound) for line in hearing} == {
        ("1", "3.606 1/s", "1.3 s", "1.303 s")
    }
    assert {line.margin for line in hearing} == {f"{(math.sqrt(13) - 1) / 2 - 1.3:.2g} s"}
    assert {line.verdict for line in hearing} == {"holds"}
    assert [line.agents for line in lines if line.in_neighbours == "0"] == ["4"]


def test_agreement_at_the_end(tmp_path: Path) -> None:
    record(make_plan(4, 50), tmp_path / "run")
    results = load(tmp_path / "run")
    rows = dict(findings.agreement(results))
    positions, velocities = results.array("plant.p")[-1], results.array("plant.v")[-1]
    assert rows["Largest |p₁ − pᵢ| at the end"] == f"{np.abs(positions - positions[0]).max():.3g} rad"
    assert rows["Largest |vᵢ − v_d| at the end"] == f"{np.abs(velocities - V_D).max():.3g} rad/s"


def test_disagreement_is_the_largest_deviation(tmp_path: Path) -> None:
    record(make_plan(4, 50), tmp_path / "run")
    scene = Scene(load(tmp_path / "run"))
    velocity = scene.signal("velocity")
    expected = np.abs(velocity.values - np.array(V_D)).max(axis=(1, 2))
    curves = disagreement._curves(scene)
    assert np.array_equal(curves[1][3], expected)


def test_sawtooth_falls_at_arrivals_and_rises_with_slope_one(tmp_path: Path) -> None:
    record(make_plan(5, 200), tmp_path / "run")
    edges = Edges(load(tmp_path / "run"))
    time, values = age.sawtooth(edges.logs[0], edges.span, edges.span.end_ns)
    assert (time[0], values[0], time[-1]) == (0.0, 0.0, 20.0)
    rises, falls = np.diff(values)[::2], np.diff(values)[1::2]
    assert np.allclose(rises, np.diff(time)[::2])
    assert (falls < 0).all()
    assert values.max() == pytest.approx(edges.ages[0].sup)


def test_beginning_of_a_long_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.recording.recorder.FATES_AT_ONCE", 100)
    monkeypatch.setattr("cosim.reporting.edges.MAX_FATES", 500)
    record(make_plan(5, 300), tmp_path / "run")
    edges = Edges(load(tmp_path / "run"))
    assert 20 < edges.span.n_ticks < 300
    assert max(one.tick_sup for one in edges.ages) <= 1.3
    assert network.totals(edges)[0] == ("Evaluated over", f"the first {edges.span.n_ticks / 10:g} s")
    report.draw(tmp_path / "run")


def test_long_runs_are_thinned_out(tmp_path: Path) -> None:
    record(make_plan(2, 2 * MAX_POINTS + 1), tmp_path / "run")
    scene = Scene(load(tmp_path / "run"))
    assert scene.every == 3
    assert len(scene.time) == len(scene.signal("position").values) <= MAX_POINTS


# --- layout -----------------------------------------------------------------------------------------------------------
def test_circle_is_in_the_order_of_the_file() -> None:
    assert np.allclose(drawing.circle(4), [[0, 1], [1, 0], [0, -1], [-1, 0]])


@pytest.mark.parametrize("n", [15, 40, 120])
def test_discs_do_not_overlap(n: int) -> None:
    positions = drawing.stress_layout(make_plan(n, 1).links)
    assert np.isfinite(positions).all()
    gap = drawing._gaps(positions) + 1e9 * np.eye(n)
    diameter = 2 * drawing._radius(positions, 3.4) / drawing._scale(positions, 3.4)
    assert np.quantile(gap.min(axis=1), 0.05) > 0.8 * diameter


def test_layout_keeps_parts_without_a_link_apart() -> None:
    links = make_plan(20, 1).links
    inside = (links.sender < 10) == (links.receiver < 10)
    parts = replace(
        links, sender=links.sender[inside], receiver=links.receiver[inside], slot=np.zeros(inside.sum(), np.int64)
    )
    assert np.isfinite(drawing.stress_layout(parts)).all()


@pytest.mark.parametrize(("name", "shown"), [("4", "4"), ("a1", "a1"), ("arm_1", "1"), ("$", "1"), ("left", "1")])
def test_names_in_formulas(name: str, shown: str) -> None:
    assert short_name(name, "1") == shown


def test_legend_of_ten_agents_is_one_line() -> None:
    assert legend_lines([str(i) for i in range(1, 11)], "$i$ =") == 1
    assert legend_lines([f"arm_number_{i}" for i in range(1, 11)], "$i$ =") > 1
    assert legend_lines([]) == 0
