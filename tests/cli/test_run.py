"""`cosim run` as people use it: a process, its output, its exit code and the run folder it leaves."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cosim import results

COSIM = [sys.executable, "-m", "cosim"]
ROOT = Path(__file__).parents[2]
SHORT = ["--until", "2 s", "--no-report"]


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), **more}


def cosim(*arguments: str, cwd: Path, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COSIM, *arguments], cwd=cwd, env=environment(**more), text=True, capture_output=True, timeout=120, check=False
    )


def manifest(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return content


def digest(folder: Path) -> str:
    text: str = manifest(folder)["digest"]
    return text


def test_runs_from_any_folder_by_bare_name(tmp_path: Path) -> None:
    done = cosim("run", "paper_leaders", *SHORT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs" / "paper_leaders").iterdir()
    assert "2 s simulated in" in done.stdout
    assert digest(folder) in done.stdout
    assert manifest(folder)["status"] == "complete"
    assert results.load(folder).array("plant.p").shape == (21, 10, 2)


@pytest.mark.parametrize(
    ("arguments", "more"),
    [
        ([], {"PYTHONHASHSEED": "1"}),
        ([], {"PYTHONHASHSEED": "4242"}),
        (["--set", "coupling.loop=python"], {}),
        (["--set", "coupling.loop=native"], {}),
        (["--set", "templates.arm.components.plant.fmu=TwoLinkArm.fmi2"], {}),
        (
            [
                "--set=templates.arm.components.plant.fmu=TwoLinkArm.fmi2",
                "--set=templates.arm.components.controller.fmu=ArmSyncController.fmi2",
            ],
            {},
        ),
    ],
    ids=["hash seed 1", "hash seed 4242", "python loop", "native loop", "plant of FMI 2.0", "both of FMI 2.0"],
)
@pytest.mark.parametrize("coupling", ["joint", "midpoint"])
def test_digest_is_the_same_however_it_is_computed(
    arguments: list[str], more: dict[str, str], coupling: str, tmp_path: Path
) -> None:
    method = ["--set", f"coupling.method={coupling}", "--set", "coupling.step=2 ms", "--until", "1 s", "--no-report"]
    for name, extra, variables in (("plain", [], {}), ("other", arguments, more)):
        done = cosim("run", "paper_leaders", *method, *extra, "--out", name, cwd=tmp_path, **variables)
        assert done.returncode == 0, done.stderr
    assert digest(tmp_path / "plain") == digest(tmp_path / "other")


def test_digest_is_the_same_under_load(tmp_path: Path) -> None:
    """Four runs at once on two cores."""
    command = [*COSIM, "run", "paper_leaderless", *SHORT, "--quiet", "--out"]
    runs = [subprocess.Popen([*command, f"r{i}"], cwd=tmp_path, env=environment()) for i in range(4)]
    assert [run.wait(120) for run in runs] == [0] * 4
    assert len({digest(tmp_path / f"r{i}") for i in range(4)}) == 1


def test_another_seed_gives_another_run(tmp_path: Path) -> None:
    cosim("run", "paper_leaders", *SHORT, "--out", "one", cwd=tmp_path)
    cosim("run", "paper_leaders", *SHORT, "--out", "two", "--seed", "2", cwd=tmp_path)
    assert digest(tmp_path / "one") != digest(tmp_path / "two")


def test_resolved_scenario_runs_again_to_the_same_digest(tmp_path: Path) -> None:
    first = cosim("run", "paper_leaderless", *SHORT, "--out", "first", cwd=tmp_path)
    again = cosim("run", "first/scenario.yaml", "--no-report", "--out", "again", cwd=tmp_path)
    assert (first.returncode, again.returncode) == (0, 0), again.stderr
    assert digest(tmp_path / "first") == digest(tmp_path / "again")


def test_quiet_prints_nothing(tmp_path: Path) -> None:
    done = cosim("run", "channel_sine", *SHORT, "--quiet", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_printed_sign_of_the_adaptation_law_ends_with_an_error_not_with_nans(tmp_path: Path) -> None:
    sign = "templates.arm.components.controller.start.adaptation_sign=1"
    done = cosim("run", "paper_leaders", "--set", sign, "--out", "wrong", "--no-report", cwd=tmp_path)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    words = done.stderr[done.stderr.index("error: ") :]
    assert words.startswith("error: agent ")
    assert ", component " in words
    assert ", at t = " in words
    assert "not finite" in words
    assert manifest(tmp_path / "wrong")["status"].startswith("aborted: agent ")
    run = results.load(tmp_path / "wrong")
    assert len(run.array("plant.p")) > 1
    assert not run.trajectories.isna().any().any()


@pytest.mark.parametrize(("method", "step", "shorter"), [("midpoint", "10 ms", "1 ms"), ("joint", "20 ms", "2 ms")])
def test_too_long_a_step_says_which_one_to_try(method: str, step: str, shorter: str, tmp_path: Path) -> None:
    coupling = ["--set", f"coupling={{method: {method}, step: {step}}}"]
    done = cosim("run", "paper_leaders", *SHORT, *coupling, "--out", "long", cwd=tmp_path)
    assert done.returncode == 3
    assert (
        f'a step of {step} is too long for the coupling {method}: try `--set coupling.step="{shorter}"`' in done.stderr
    )
    coupling[-1] = f"coupling={{method: {method}, step: {shorter}}}"
    assert cosim("run", "paper_leaders", *SHORT, *coupling, "--out", "short", cwd=tmp_path).returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_leaves_a_readable_run_folder(number: signal.Signals, tmp_path: Path) -> None:
    command = [*COSIM, "run", "paper_leaders", "--until", "10 h", "--out", "long"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment(), text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        assert run.stderr is not None
        shown = run.stderr.readline()  # the first line of progress comes when ticks are done
        assert "s simulated" in shown
        assert "disagreement" in shown
        run.send_signal(number)
        _, error = run.communicate(timeout=60)
    assert run.returncode == 128 + number
    assert "interrupted at t = " in error
    assert "Traceback" not in error
    content = manifest(tmp_path / "long")
    assert content["status"].startswith("aborted: interrupted at t = ")
    positions = results.load(tmp_path / "long").array("plant.p")
    assert len(positions) == content["ticks"]["done"] + 1 > 1


def test_interrupt_while_the_report_is_drawn(tmp_path: Path) -> None:
    assert cosim("run", "channel_sine", *SHORT, "--out", "run", cwd=tmp_path).returncode == 0
    code = (
        "import os, signal, sys\nfrom cosim.cli import main\nfrom cosim.reporting import page\n"
        "original = page._draw\n"
        "def drawing(*arguments):\n    os.kill(os.getpid(), signal.SIGINT)\n    return original(*arguments)\n"
        "page._draw = drawing\nsys.exit(main(['report', 'run']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment(), text=True, capture_output=True, check=False
    )
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "run" / "report.html").exists()
    assert cosim("report", "run", cwd=tmp_path).returncode == 0


SINE = """
seed: 1
period: 100 ms
duration: 20 s
templates:
  a:
    components: {m: {python: "cosim.components.library:Sine"}, h: {python: "cosim.components.library:Hold"}}
    publish: {phi: m.phi}
    receive: {phi: h.values, stamp: h.stamp, count: h.count}
agents: {1..2: {template: a}}
graph: {channel: own, edges: [1 -> 2, 2 -> 1]}
channels: {own: {model: python, class: "tests.network.own_channels:CLASS"}}
"""


def test_a_channel_of_ones_own(tmp_path: Path) -> None:
    for name in ("Tired", "FailingLate"):
        (tmp_path / f"{name}.yaml").write_text(SINE.replace("CLASS", name))
    ways = {"inline": [], "across": ["--distributed", "--workers", "1"]}
    for way, options in ways.items():
        done = cosim("run", "Tired.yaml", *options, "--no-report", "--out", way, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        failed = cosim("run", "FailingLate.yaml", *options, "--no-report", "--out", f"bad-{way}", cwd=tmp_path)
        assert failed.returncode == 3
        said = "own_channels:FailingLate, at tick 150 (t = 15 s): KeyError: 'a route' (own_channels.py, line"
        assert said in failed.stderr
        assert "Traceback" not in failed.stderr
        assert manifest(tmp_path / f"bad-{way}")["status"].startswith("aborted: ")
    assert len(results.load(tmp_path / "bad-inline").array("m.phi")) >= 100
    assert digest(tmp_path / "inline") == digest(tmp_path / "across")


def test_folder_that_is_not_empty_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    done = cosim("run", "paper_leaders", *SHORT, "--out", "mine", cwd=tmp_path)
    assert done.returncode == 2
    assert "not empty" in done.stderr
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]


def test_help_does_not_import_what_it_does_not_need(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom cosim.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'fmpy', 'matplotlib', 'zenoh', 'numpy', 'pydantic', 'pyarrow', 'pandas'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment(), text=True, capture_output=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_an_output_that_begins_infinite(tmp_path: Path) -> None:
    """A shorter step would not help, and NumPy's opinion is nobody's business."""
    (tmp_path / "endless.py").write_text(
        "from cosim.components.python import Output, PythonComponent\n\n\n"
        "class Endless(PythonComponent):\n    y = Output(shape=(2,))\n\n"
        "    def outputs(self, time):\n        self.y = [1.0, float('inf')]\n"
    )
    (tmp_path / "net.yaml").write_text(
        "period: 100 ms\nduration: 1 s\nagents:\n"
        '  one: {components: {node: {python: "endless:Endless"}}, record: [node.y]}\n'
    )
    done = cosim("run", "net.yaml", "--no-report", cwd=tmp_path)
    assert done.returncode == 3
    assert "error: agent one, component node, at t = 0 s: output y is not finite\n" in done.stderr
    assert "coupling.step" not in done.stderr
    assert "Warning" not in done.stderr
