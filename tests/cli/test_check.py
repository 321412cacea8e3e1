"""`cosim check`: what it says of ten agents and of a hundred, and what it refuses."""

from pathlib import Path

import pytest

from cosim import cli
from tests.cli.conftest import Cosim
from tests.scenario.scenarios import BASE, FILE, changed

CHECKED = """\
paper_leaders: Ten arms, leaders 1 and 4
  time              60 s in 600 periods of 100 ms
  seed              1

10 agents
  components        plant = TwoLinkArm (FMI 3.0), controller = ArmSyncController (FMI 3.0)
  coupling          joint, rk4, 5 ms, native loop
  message           p[2], v_hat[2]

Graph: 16 edges
  roots             1..7
  leaders           1, 4
                    1, 4: every agent is reached
  in-neighbours     2: 1, 3, 6, 8..10
                    1: 2, 4, 5, 7
  kappa             1

Channels
  paper             window (depth 10, delay 150 ms to 250 ms), 16 edges
                    least delay 150 ms; age at ticks at most: 1.3 s

The paper's published condition: mu_i > 1 + 2 h*, that is h* < (mu_i - 1)/2
  mu_i              3.60555
  h*                1.3 s
                    holds: h* = 1.3 s, (mu_i - 1)/2 = 1.30278 s, margin 0.0028 s
  h* is the largest age of information read at a tick. The condition is shown as published and guarantees
  nothing: its proof has a gap, and runs that violate it often still converge.
"""


def check(folder: Path, text: str, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, output and problems."""
    (folder / FILE).write_text(text)
    code = cli.main(["check", str(folder / FILE), "--set", "coupling.loop=python", *arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_the_paper_s_scenario(cosim: Cosim) -> None:
    done = cosim("check", "paper_leaders")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == CHECKED


def test_a_hundred_agents_fit_on_a_screen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = changed(("1..3: {template", "1..100: {template"), ("- 2 -> 1", "- 2 -> 1\n    - 3 -> 4..100"))
    code, out, err = check(tmp_path, text, capsys)
    assert code == 0
    assert len(out.splitlines()) < 40
    assert "  in-neighbours     2: 1\n                    1: 2..100\n" in out
    assert err.splitlines()[-1] == "1 warning"  # nobody hears 4 to 100


def test_agents_that_differ_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = changed(("start: {role: leader}", "start: {role: leader, k_eta: 9}, fmu: ArmSyncController.fmi2"))
    _, out, _ = check(tmp_path, text, capsys, "--set", "agents.3.coupling.step=1 ms")
    assert "plant = TwoLinkArm (FMI 3.0), controller = ArmSyncController (FMI 3.0): 1, 3\n" in out
    assert "plant = TwoLinkArm (FMI 3.0), controller = ArmSyncController (FMI 2.0): 2\n" in out
    assert "joint, rk4, 1 ms, Python loop: 3\n" in out
    assert "  mu_i              3.60555: 1, 3\n                    1.80742: 2\n" in out


def test_a_graph_without_a_root(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = changed(("    - 1 -> 2\n    - 2 -> 3\n    - 3 -> 1\n    - 2 -> 1\n", "    - 1 -> 3\n    - 2 -> 3\n"))
    code, out, err = check(tmp_path, text, capsys)
    assert code == 0
    assert "roots             none: the graph is not rooted\n" in out
    assert "leaders           2\n                    2: not reached: 1\n" in out
    assert "warning: the graph has no root: agents 1, 2 cannot reach each other" in err


@pytest.mark.parametrize(
    ("channel", "sentence"),
    [
        ("{model: ideal}", "holds: h* = 0 s, (mu_i - 1)/2 = 1.30278 s, margin 1.3 s"),
        ("{model: netem, delay: 2 s}", "does not hold: h* = 2 s, (mu_i - 1)/2 = 1.30278 s, margin -0.7 s"),
        ("{model: netem, delay: 20 ms, loss: 1 %}", "cannot be evaluated; it would ask for h* < 1.30278 s"),
    ],
)
def test_the_published_condition(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], channel: str, sentence: str
) -> None:
    _, out, _ = check(tmp_path, changed(("{model: ideal}", channel)), capsys)
    assert f"                    {sentence}\n" in out


def test_no_condition_without_its_gains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = check(tmp_path, changed(("  lambda: controller.lambda\n", "")), capsys)
    assert "published condition" not in out


def test_a_start_value_that_the_fmu_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = check(tmp_path, BASE, capsys, "--set", "agents.2.components.plant.start.m1=-1")
    assert (code, out) == (3, "")
    assert err.startswith("error: agent 2, component plant, at t = 0 s: ")


def test_overrides_reach_the_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = check(tmp_path, BASE, capsys, "--seed", "9", "--until", "5 s", "--set", "period=0.05 s")
    assert "5 s in 100 periods of 50 ms" in out
    assert "seed              9" in out
