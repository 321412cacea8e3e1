"""`cosim channel --fit`: logs are read or refused, and become profiles that play as the log."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from cosim import cli
from cosim.channel import fit, measured
from cosim.channel import subject as subjects
from cosim.channel.playing import play
from cosim.channel.subject import Wanted
from cosim.errors import ConfigError
from cosim.scenario import profiles

WIFI = "{model: netem, delay: {time: 20 ms, jitter: 8 ms, distribution: gamma}, loss: {gemodel: [3 %, 30 %]}}"
PING = """\
PING lab (10.1.2.3) 56(84) bytes of data.
[1700000000.020000] 64 bytes from 10.1.2.3: icmp_seq=65534 ttl=57 time=20.0 ms
no answer yet for icmp_seq=65535
[1700000002.030000] 64 bytes from 10.1.2.3: icmp_seq=0 ttl=57 time=30.0 ms
[1700000002.031000] 64 bytes from 10.1.2.3: icmp_seq=0 ttl=57 time=31.0 ms (DUP!)
From 10.0.0.1 icmp_seq=1 Destination Host Unreachable
[1700000004.010000] 64 bytes from 10.1.2.3: icmp_seq=2 ttl=57 time=10.0 ms

--- lab ping statistics ---
7 packets transmitted, 3 received, +1 duplicates, 57% packet loss, time 6000ms
"""


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs may be short."""
    monkeypatch.setattr(measured, "LEAST", 3)


def delays_of(channel: str, n: int, seed: int = 1) -> np.ndarray:
    """(n,) seconds; NaN where lost."""
    subject = subjects.find(channel, Wanted(ticks=n, seed=seed))
    fates, delays = play(subject).fates, np.full(n, np.nan)
    arrived = fates.arrival_ns >= 0
    sent = fates.sent[arrived]
    delays[sent] = (fates.arrival_ns[arrived] - sent * subject.period_ns) / 1e9
    return delays


def csv_of(delays: np.ndarray) -> str:
    rows = (f"{i},{i * 0.1:.1f},{'' if np.isnan(delay) else f'{1e3 * delay:.3f}'}" for i, delay in enumerate(delays))
    return "seq,time,delay_ms\n" + "\n".join(rows) + "\n"


def read(folder: Path, text: str) -> measured.Log:
    (folder / "log.csv").write_text(text)
    return measured.read(folder / "log.csv")


def problems(folder: Path, text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        read(folder, text)
    return [str(problem).removeprefix(f"{folder}/") for problem in caught.value.problems]


# --- reading ----------------------------------------------------------------------------------------------------------
@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    "text",
    [
        "seq,time,delay\n7,0,0.02\n8,0.1,\n10,0.3,0.03\n",
        "seq;delay_ms;remark\n7;20;first\n8;lost;x\n10;30;\n",
        "# of last week\nSeq\tDelay [ms]\n10\t30\n7\t20\n8\t*\n",
        '"seq","delay"\n7,20 ms\n8,-\n10,30 ms # late\n',
    ],
)
def test_csv(tmp_path: Path, text: str) -> None:
    log = read(tmp_path, text)
    assert np.array_equal(log.delay, [0.02, np.nan, np.nan, 0.03], equal_nan=True)
    assert (log.duplicates, log.round_trip) == (0, False)


@pytest.mark.usefixtures("few")
def test_csv_by_time(tmp_path: Path) -> None:
    log = read(tmp_path, "time_ms,delay_us\n0,20\n100,nan\n200,30\n300,100000\n")
    assert log.delay == pytest.approx([2e-5, np.nan, 3e-5, 0.1], nan_ok=True)
    assert (log.period, log.reordered) == (pytest.approx(0.1), False)
    assert read(tmp_path, "time,delay\n0,0.5\n0.1,0.2\n0.2,0.2\n").reordered


@pytest.mark.usefixtures("few")
def test_ping(tmp_path: Path) -> None:
    log = read(tmp_path, PING)
    expected = [0.02, np.nan, 0.03, np.nan, 0.01, np.nan, np.nan]
    assert np.array_equal(log.delay, expected, equal_nan=True)
    assert (log.duplicates, log.round_trip, log.period) == (1, True, None)
    assert log.sent[[0, 2, 4]] - log.sent[0] == pytest.approx([0, 2, 4], abs=1e-3)


@pytest.mark.usefixtures("few")
def test_ping_of_bsd(tmp_path: Path) -> None:
    lines = ["PING 10.1.2.3: 56 data bytes", "64 bytes from 10.1.2.3: icmp_seq=0 ttl=64 time=0.081 ms"]
    lines += ["Request timeout for icmp_seq 1", "64 bytes from 10.1.2.3: icmp_seq=2 ttl=64 time=0.093 ms"]
    log = read(tmp_path, "\n".join(lines))
    assert np.array_equal(log.delay, [8.1e-5, np.nan, 9.3e-5], equal_nan=True)


def test_malformed_logs_say_where(tmp_path: Path) -> None:
    good = "".join(f"{i},{20 + i} ms\n" for i in range(30))
    head = "seq,delay\n"
    cases = {
        "": "log.csv:1:1: error: the file is empty",
        "a,b\n1,2\n": "log.csv:1:1: error: there is no column 'delay'",
        "delay\n1\n": "log.csv:1:1: error: there is no column 'seq' or 'time'",
        "seq,delay,delay_ms\n": "log.csv:1:11: error: a second column 'delay'",
        f"{head}{good}30,  20 mss\n": "log.csv:32:6: error: delay: unknown unit of time 'mss'",
        f"{head}{good}x,1\n": "log.csv:32:1: error: seq: 'x' is no sequence number",
        f"{head}{good}30,-5\n": "log.csv:32:4: error: delay: '-5': a delay is 0 or more",
        f"{head}{good}30\n": "log.csv:32:3: error: 1 cells: there is none for 'delay'",
        f"seq,delay_ms\n{good.replace(' ms', '')}30,1.2.3\n": "log.csv:32:4: error: delay: '1.2.3' is no number of ms",
        "time,delay\n1,1\n0,1\n": "log.csv:3:1: error: time: messages must be in the order of sending",
        f"{head}1,1\n2,2\n": "log.csv: error: 2 messages, of which 2 arrived, are too few; 20 at least are needed",
        f"{head}1,1\n99999999,2\n": "log.csv: error: sequence numbers from 1 to 99999999, but only 2 messages",
        "64 bytes from x: icmp_seq=1 ttl=3\n": "log.csv:1:28: error: an answer without its time",
        "64 bytes from x: icmp_seq=1 time=1.2.3 ms\n": "log.csv:1:34: error: '1.2.3' is no number",
    }
    for text, expected in cases.items():
        assert problems(tmp_path, text)[0].startswith(expected), text
    many = problems(tmp_path, head + "x,1\n" * 30)
    assert len(many) == 11
    assert many[-1] == "log.csv: error: 20 more lines are malformed"
    (tmp_path / "log.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="binary"):
        measured.read(tmp_path / "log.csv")


# --- fitting ----------------------------------------------------------------------------------------------------------
def test_a_log_becomes_the_profile_that_made_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pings.csv").write_text(csv_of(delays_of(WIFI, 6000)))
    assert cli.main(["channel", "--fit", "pings.csv"]) == 0
    printed = capsys.readouterr().out
    assert "no difference to be seen" in printed
    folder = Path("runs/channels/pings")
    assert printed.splitlines()[-2:] == [str(folder / "pings.yaml"), str(folder / "fit.html")]
    written = profiles.model_of(profiles.load(folder / "pings.yaml")).as_written()
    assert written["delay"]["distribution"] == "gamma"
    assert written["loss"]["gemodel"] == {"p": pytest.approx(0.03, abs=0.006), "r": pytest.approx(0.3, abs=0.06)}
    assert {path.stem for path in (folder / "figures").iterdir()} == {"log", "delays", "losses"}
    page = (folder / "fit.html").read_text()
    assert page.count("<svg") == 3
    assert "gemodel p r 1-h 1-k" in page
    assert "docs/" not in page
    assert "Walsh, Ye, Bushnell 2002" in page
    assert cli.main(["channel", str(folder / "pings.yaml"), "--ticks", "100", "--no-report"]) == 0


def test_where_no_distribution_fits_the_log_s_own_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    delays = np.where(rng.random(3000) < 0.5, rng.normal(0.02, 0.001, 3000), rng.normal(0.08, 0.001, 3000))
    (tmp_path / "log.csv").write_text(csv_of(delays))
    assert cli.main(["channel", "--fit", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")]) == 0
    assert "too far; so the profile has the log's own distribution, log.dist" in capsys.readouterr().out
    assert "table: log.dist" in (tmp_path / "out" / "log.yaml").read_text()
    again = delays_of(str(tmp_path / "out" / "log.yaml"), 3000)
    assert stats.ks_2samp(delays, again).pvalue > 1e-6


def test_a_round_trip_is_halved(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(csv_of(np.full(30, 0.04)))
    log = measured.read(tmp_path / "log.csv", round_trip=True)
    model = fit.fit(log, tmp_path / "log.csv", tmp_path / "out").model
    assert model.as_written() == {"model": "netem", "delay": "20 ms"}


def test_order_is_kept_where_the_log_kept_it(tmp_path: Path) -> None:
    slow = "{model: netem, delay: {time: 300 ms, jitter: 150 ms, distribution: lognormal%s}}"
    for extra, expected in ((", fifo: true", True), ("", False)):
        log = read(tmp_path, csv_of(delays_of(slow % extra, 2000)))
        delay = fit.fit(log, tmp_path / "log.csv", tmp_path / "out").model.delay
        assert delay is not None
        assert delay.fifo is expected


def test_the_log_s_own_measures_stand_beside_the_profile_s(tmp_path: Path) -> None:
    delays = delays_of(WIFI, 1000)
    fitted = fit.fit(read(tmp_path, csv_of(delays)), tmp_path / "log.csv", tmp_path / "out")
    rows = {label: log for label, log, _ in fit.comparison(fitted)}
    assert rows["Delivery ratio"] == f"{100 * np.isfinite(delays).mean():.3g} %"
    (age,) = fitted.measured.ages
    assert rows["Age of information, largest read at a tick"] == f"{age.tick_sup:.4g} s"


def test_command_line_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["channel", "lte", "--fit", "log.csv"]) == 2
    assert "give a PROFILE to play, or a log to --fit, not both" in capsys.readouterr().err
    assert cli.main(["channel", "--fit", str(tmp_path / "gone.csv")]) == 2
    assert "gone.csv: error: cannot be read: No such file" in capsys.readouterr().err
