"""`cosim channel PROFILE`: what it plays, prints and draws, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest

from cosim import cli
from cosim.channel import subject as subjects
from cosim.channel.playing import play
from cosim.channel.subject import Wanted
from cosim.planning import load as plan_of
from cosim.reporting import network
from cosim.reporting.edges import Edges
from network.emulator import Emulator
from network.messages import Fates
from tests.cli.conftest import ROOT
from tests.network.networks import COLUMNS, joined

MINE = "title: Mine\nchannel: {model: netem, delay: 40 ms, loss: {gemodel: [2 %, 20 %]}}\n"


def run(*arguments: str) -> int:
    return cli.main(["channel", *arguments])


def problems(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[str]:
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    return printed.err.splitlines()


def rows_of(fates: Fates, agents: tuple[str, ...]) -> set[tuple[object, ...]]:
    names = np.array(agents)
    numbers = (getattr(fates, name).tolist() for name in COLUMNS[2:])
    return set(zip(names[fates.sender].tolist(), names[fates.receiver].tolist(), *numbers, strict=True))


@pytest.mark.parametrize("channel", ["bursts", "cellular", "paper"])
def test_a_scenario_s_channel_fares_as_in_the_run(channel: str) -> None:
    subject = subjects.find(f"mixed_network:{channel}", Wanted(ticks=120))
    plan = plan_of("mixed_network").plan
    emulator = Emulator(plan.links, plan.channels, plan.link_channel, plan.layout, plan.seed, plan.period_ns)
    values = np.zeros((len(plan.agents), plan.layout.width))
    fates = joined([*(emulator.emulate(tick, values).fates for tick in range(120)), emulator.finish()])
    chosen = [i for i, name in enumerate(plan.link_channel) if name == channel]
    pairs = {(plan.links.agents[plan.links.sender[i]], plan.links.agents[plan.links.receiver[i]]) for i in chosen}
    expected = {row for row in rows_of(fates, plan.links.agents) if row[:2] in pairs}
    assert len(expected) > 100
    assert rows_of(play(subject).fates, subject.links.agents) == expected


def test_the_table_says_what_is_stated_and_what_was_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("{model: netem, delay: 40 ms, loss: {gemodel: [2 %, 20 %]}}", "--edges", "20", "--no-report") == 0
    printed = capsys.readouterr().out
    rows = dict(line.strip().split("  ", 1) for line in printed.splitlines() if "  " in line.strip())
    rows = {label: value.strip() for label, value in rows.items()}
    assert rows["Losses in the long run"] == "9.09 %, 5 in a row on average"
    assert rows["Played"] == "10000 ticks of 100 ms on 20 edges, seed 1, messages of 32 B"
    # Of 200,000 messages in runs of 5: the standard deviations are 0.2 % and 0.04.
    assert float(rows["Delivery ratio"].split()[0]) == pytest.approx(90.91, abs=1)
    assert float(rows["Losses in a row on an edge"].split()[1].rstrip(",")) == pytest.approx(5, abs=0.2)
    assert rows["One-way delay"] == "median 0.04 s, 95 % 0.04 s, 99 % 0.04 s, largest 0.04 s"
    subject = subjects.find("{model: netem, delay: 40 ms, loss: {gemodel: [2 %, 20 %]}}", Wanted(edges=20))
    for label, value in network.measures(Edges(play(subject))):
        assert rows[label] == value


def test_size_and_period_make_the_load_of_a_rate(capsys: pytest.CaptureFixture[str]) -> None:
    slow = "{model: netem, rate: {rate: 8 kbit/s, limit: 2}}"
    assert run(slow, "--size", "80 B", "--period", "200 ms", "--ticks", "50", "--no-report") == 0
    assert "80 ms of every 200 ms: 40 % of its time" in capsys.readouterr().out
    assert run(slow, "--size", "400 B", "--ticks", "50", "--no-report") == 0
    printed = capsys.readouterr().out
    assert "400 ms of every 100 ms: 400 % of its time; more than there is, so that messages are lost" in printed
    assert "Delivery ratio" in printed


def test_page_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.yaml").write_text(MINE)
    contents = []
    for _ in range(2):
        assert run(str(tmp_path / "mine.yaml"), "--ticks", "300", "--edges", "3", "--out", str(tmp_path / "out")) == 0
        page = tmp_path / "out" / "channel.html"
        assert capsys.readouterr().out.splitlines()[-1] == str(page)
        contents.append({path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()})
    assert contents[0] == contents[1]
    names = {path.stem for path in (tmp_path / "out" / "figures").iterdir()}
    assert names == {"timeline", "age", "delays", "losses", "front", "heat"}
    text = page.read_text()
    assert text.count("<svg") == 6
    assert "docs/" not in text  # whoever is sent the page has none: it explains its measures itself
    assert "Walsh, Ye, Bushnell 2002" in text
    assert "gemodel: {p: 0.02, r: 0.2}" in text
    assert "Not drawn" not in text
    assert "<script" not in text


@pytest.mark.parametrize(
    "channel", ["{model: ideal}", "{model: netem, loss: 1}", "{model: window, depth: 3, delay: 0}"]
)
def test_channels_that_lack_something_to_draw(tmp_path: Path, channel: str) -> None:
    assert run(channel, "--ticks", "1", "--out", str(tmp_path / "one")) == 0
    assert run(channel, "--ticks", "40", "--out", str(tmp_path / "more")) == 0
    assert "Not drawn" in (tmp_path / "more" / "channel.html").read_text()


def test_every_shipped_profile_plays(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--list") == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert len(listed) > 10
    for name in listed:
        assert run(name, "--ticks", "200", "--no-report") == 0
        assert "Delivery ratio" in capsys.readouterr().out


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(MINE.replace("40 ms", "40 mss"))
    (tmp_path / "net.yaml").write_text((ROOT / "configs" / "channel_sine.yaml").read_text())
    assert problems(capsys)[0].startswith("error: name a profile, such as wifi_busy")
    assert "no shipped profile 'wifi_bussy' (did you mean 'wifi_busy'?)" in problems(capsys, "wifi_bussy")[0]
    assert "mixed_network is a scenario: write mixed_network:CHANNEL" in problems(capsys, "mixed_network")[0]
    assert problems(capsys, "net.yaml")[0].startswith("net.yaml: error: this is a scenario: write net.yaml:CHANNEL")
    (said, _) = problems(capsys, "mixed_network:burst")
    assert "no edge has a channel 'burst' (did you mean 'bursts'?)" in said
    assert problems(capsys, "mine.yaml")[0].startswith("mine.yaml:2:32: error: delay: unknown unit of time 'mss'")
    assert problems(capsys, "{model: netem, loss: 150 %}")[0].startswith("PROFILE:1:22: error: loss: '150 %'")
    assert "no shipped profile 'lt'" in problems(capsys, "{profile: lt, loss: 1 %}")[0]
    said = "\n".join(problems(capsys, "lte", "--ticks", "0", "--edges", "-1", "--period", "5 sec", "--size", "30 B"))
    for expected in ("--ticks: 0 are too few", "--edges: -1 are", "--period: unknown unit", "--size: a message is"):
        assert expected in said
    assert "more than 5000000 messages" in problems(capsys, "lte", "--ticks", "1000000", "--edges", "6")[0]


def test_a_replay_is_played_on_the_edges_of_its_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "mixed_network", "--until", "4 s", "--out", str(tmp_path / "run"), "--no-report"]) == 0
    replay = f"{{model: replay, file: {tmp_path / 'run' / 'deliveries.parquet'}}}"
    capsys.readouterr()
    (said, _) = problems(capsys, replay)
    assert "cannot be played on these edges: the recorded run has no message from a to b" in said
