"""Runs whose processes are started by hand: real commands, in any order, their refusals, what they leave behind."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

import fmus
from cosim import cli
from cosim.components.fmu.stripping import strip
from tests.components import misbehaving
from tests.components.probe import FAILS
from tests.distributed.networks import ring, scenario
from tests.distributed.started import PATIENCE, ROOT, Started, free_port, started
from tests.scenario.scenarios import changed

Start = Callable[..., Started]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a command, each in a folder of its own."""
    with ExitStack() as stack:
        yield lambda place, *arguments: stack.enter_context(started(tmp_path / place, *arguments))


def digest(folder: Path) -> str:
    content: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    assert content["status"] == "complete"
    return str(content["digest"])


def plain_digest(tmp_path: Path, *arguments: str) -> str:
    """Of the in-process run."""
    with started(tmp_path / "plain", "run", *arguments, "--no-report", "--quiet", "--out", "out") as run:
        run.succeed()
    return digest(tmp_path / "plain" / "out")


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Digest of a second of the ten arms."""
    return plain_digest(tmp_path_factory.mktemp("arms"), "paper_leaders", "--until", "1 s")


ARMS = ("paper_leaders", "--until", "1 s", "--no-report", "--out", "out")


@pytest.mark.parametrize("order", ["serve, emulator, worker", "worker, serve, emulator", "emulator, worker, serve"])
def test_any_order_gives_the_digest_of_the_in_process_run(order: str, start: Start, tmp_path: Path, arms: str) -> None:
    tcp = order.startswith("worker")
    where = f"tcp/127.0.0.1:{free_port()}" if tcp else f"unixsock-stream/{tmp_path}/hub"
    commands = {
        "serve": [("s", "serve", *ARMS, "--listen", where)],
        "emulator": [("e", "emulator", "--connect", where)],
        "worker": [
            ("a", "worker", "--connect", where, "--agents", "1-3, 5"),
            ("b", "worker", "--connect", where, "--agents", "4,6..10", "--name", "lab-b"),
        ],
    }
    running: dict[str, Started] = {}
    for role in order.split(", "):
        for place, *command in commands[role]:
            running[place] = start(place, *command)
            if role != "serve" and "s" not in running:
                running[place].hear(f"nobody answers at {where}; waiting for it")
    output = running["s"].succeed()
    for place in "eab":
        code, _, said = running[place].end()
        assert (code, said.splitlines()[-1]) == (0, "the run is over"), said
    assert digest(tmp_path / "s" / "out") == arms
    assert f"  cosim emulator --connect {where}\n" in output
    assert not (tmp_path / "hub").exists()


def test_a_run_that_an_agent_ends_is_over_for_everybody(start: Start, tmp_path: Path) -> None:
    (tmp_path / "net.yaml").write_text(scenario(4, ring(4), faults={3: ("Ending", 0.85)}))
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", str(tmp_path / "net.yaml"), "--listen", where, "--out", "out", "--no-report")
    others = [start("e", "emulator", "--connect", where)]
    others += [start(f"w{i}", "worker", "--connect", where, "--agents", i) for i in ("1..2", "3..4")]
    assert "by component node of agent 3, which asked for it" in serve.succeed()
    for other in others:
        code, _, said = other.end()
        assert code == 0
        assert re.search(r"the run is over: agent 3, component node, at t = 0\.8\d* s: asks to end the simul", said), (
            said
        )
    assert digest(tmp_path / "s" / "out") == plain_digest(tmp_path, str(tmp_path / "net.yaml"))


def test_the_commands_that_serve_prints_are_those_to_type(start: Start, tmp_path: Path) -> None:
    text = scenario(5, ring(5)) + "workers: {lab-a: '5, 1..2', lab-b: 3..4}\n"
    (tmp_path / "net.yaml").write_text(text)
    where = f"tcp/127.0.0.1:{free_port()}"
    options = ("--run", "mine", "--namespace", "lab", "--out", "out", "--no-report")
    serve = start("s", "serve", str(tmp_path / "net.yaml"), "--listen", where, *options)
    serve.hear("waiting for the emulator, lab-a (agents 1, 2, 5), lab-b (agents 3, 4)")
    assert serve.process.stdout is not None
    printed = [serve.process.stdout.readline() for _ in range(4)][1:]
    assert printed == [
        f"  cosim emulator --connect {where} --run mine --namespace lab\n",
        f"  cosim worker --connect {where} --run mine --namespace lab --name lab-a\n",
        f"  cosim worker --connect {where} --run mine --namespace lab --name lab-b\n",
    ]
    others = [start(f"other-{i}", *line.split()[1:]) for i, line in enumerate(printed)]
    for other in others:
        other.succeed()
    serve.succeed()
    assert digest(tmp_path / "s" / "out") == plain_digest(tmp_path, str(tmp_path / "net.yaml"))


# --- files ------------------------------------------------------------------------------------------------------------
def test_files_travel_but_for_the_one_that_stays_with_its_owner(start: Start, tmp_path: Path) -> None:
    """A plant that travels, a controller that does not."""
    arm, secret = fmus.path("TwoLinkArm").read_bytes(), fmus.path("ArmSyncController").read_bytes()
    for place in ("s", "partner"):
        (tmp_path / place).mkdir()
    (tmp_path / "s" / "my arm.fmu").write_bytes(arm)
    (tmp_path / "partner" / "secret.fmu").write_bytes(secret)
    (tmp_path / "s" / "told.fmu").write_bytes(strip(tmp_path / "partner" / "secret.fmu"))
    text = changed(
        ("fmu: TwoLinkArm\n", "fmu: ./my arm.fmu\n"),
        ("  2: {components: {controller: {start", "  2: {components: {controller: {fmu: told.fmu, start"),
    )
    (tmp_path / "s" / "net.yaml").write_text(text)
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", "net.yaml", "--listen", where, "--out", "out", "--no-report")
    serve.hear("waiting for")
    emulator = start("e", "emulator", "--connect", where)
    others = start("a", "worker", "--connect", where, "--agents", "1, 3")

    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "secret.fmu").write_bytes(arm)
    code, _, said = start("b", "worker", "--connect", where, "--agents", "2", "--name", "b").end()
    assert code == 2
    assert "error: secret.fmu (SHA-256 " in said
    assert "only its owner has it: put it into the folder of --files" in said
    assert "secret.fmu is another file (SHA-256 " in said
    serve.hear("b (agent 2): b failed: secret.fmu (SHA-256 ")

    again = start("b", "worker", "--connect", where, "--agents", "2", "--name", "b", "--files", "../partner")
    for command in (serve, emulator, others, again):
        command.succeed()
    for name in ("told.fmu", "secret.fmu"):
        text = text.replace(name, "../partner/secret.fmu")
    (tmp_path / "s" / "whole.yaml").write_text(text)
    assert digest(tmp_path / "s" / "out") == plain_digest(tmp_path, "../s/whole.yaml")
    kept = [path for place in "eab" for path in (tmp_path / place).rglob("*.fmu")]
    assert kept == [tmp_path / "b" / "secret.fmu"]


def test_an_fmu_that_goes_elsewhere_takes_no_log_with_it(start: Start, tmp_path: Path, probes: dict[int, Path]) -> None:
    fails = FAILS.index("step_wanders")
    wanders = f"  good: {{template: probe, components: {{probe: {{start: {{fails: {fails}}}}}}}}}\n"
    text = misbehaving.scenario(probes[3], "step_prints").replace("  good: {template: probe}\n", wanders)
    (tmp_path / "net.yaml").write_text(text)
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", str(tmp_path / "net.yaml"), "--listen", where, "--no-report")
    emulator = start("e", "emulator", "--connect", where)
    worker = start("a", "worker", "--connect", where, "--agents", "good, bad")
    code, _, said = worker.end()
    assert code == 0, said
    (folder,) = re.findall("what its components logged is in (.*)", said)
    assert "the probe printed at t = " in (tmp_path / "a" / folder / "output.log").read_text()
    for other in (serve, emulator):
        other.succeed()


def test_python_classes_must_be_the_same_on_all_hosts(start: Start, tmp_path: Path) -> None:
    for place, sign in (("s", "-"), ("a", "+")):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.py").write_text(
            "from cosim.components.python import PythonComponent, State\n"
            "class Mine(PythonComponent):\n"
            "    x = State(1.0)\n"
            f"    def derivatives(self, time): return {{'x': {sign}self.x}}\n"
        )
    (tmp_path / "s" / "net.yaml").write_text(
        "period: 100 ms\nduration: 1 s\nagents: {1..2: {components: {mine: {python: 'mine:Mine'}}, record: [mine.x]}}\n"
    )
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", "net.yaml", "--listen", where)
    other, none = (start(place, "worker", "--connect", where, "--agents", n) for place, n in (("a", "1"), ("b", "2")))
    code, _, said = other.end()
    assert code == 2
    assert f"other files than those that the orchestrator has: {tmp_path}/a/mine.py (of agents 1, 2)" in said
    code, _, said = none.end()
    assert code == 2
    assert "there is no Python module 'mine'" in said
    serve.signal(signal.SIGINT)
    assert serve.end()[0] == 130
    assert not (tmp_path / "s" / "runs").exists()


# --- refusals and ends ------------------------------------------------------------------------------------------------
def test_who_is_refused_and_who_is_sent_home(start: Start, tmp_path: Path) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    serve = start("s", "serve", *ARMS, "--listen", where)
    serve.hear("waiting for")
    present = [start("e", "emulator", "--connect", where), start("a", "worker", "--connect", where, "--agents", "1..5")]
    for _ in present:
        serve.hear("is ready")
    for command, said in (
        (["worker", "--agents", "4..6"], r"agents 4, 5 are carried by "),
        (["worker", "--agents", "9..11"], "there is no agent 11; the agents are 1..10"),
        (["worker", "--agents", "1..."], "names no agent"),
        (
            ["worker", "--name", "lab-c"],
            "say which agents lab-c carries, with --agents; without a worker: agents 6..10",
        ),
        (["emulator"], "the name emulator is taken: process "),
        (["worker", "--agents", "6", "--run", "other"], "may not join run other: the orchestrator there plays run run"),
        (["serve", *ARMS, "--listen", where], "another program listens there already"),
    ):
        refused = start("refused", *command, *([] if "serve" in command else ["--connect", where]))
        code, _, error = refused.end()
        assert code == 2, error
        assert said in error
        assert error.splitlines()[-1].startswith("error: "), error
    serve.signal(signal.SIGINT)
    assert serve.end()[0] == 130
    for command in present:
        code, _, error = command.end()
        assert code == 3
        assert "error: the orchestrator ended the run before its end: it was stopped" in error
    assert not (tmp_path / "s" / "out").exists()


def test_the_orchestrator_is_killed(start: Start, tmp_path: Path) -> None:
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", "paper_leaders", "--until", "10 h", "--listen", where, "--out", "out")
    others = [
        start("e", "emulator", "--connect", where),
        start("a", "worker", "--connect", where, "--agents", "1..10"),
    ]
    for other in others:
        other.hear("the run begins")
    serve.signal(signal.SIGKILL)
    for other in others:
        code, _, error = other.end()
        assert code == 3
        assert "error: the orchestrator is gone: " in error


def test_the_orchestrator_is_stopped_and_goes_on(start: Start, tmp_path: Path) -> None:
    """The others are gone by then, and are not the ones to blame."""
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", "paper_leaders", "--until", "10 h", "--listen", where, "--out", "out", "--no-report")
    others = [
        start("e", "emulator", "--connect", where),
        start("a", "worker", "--connect", where, "--agents", "1..10"),
    ]
    serve.hear("s simulated")
    serve.signal(signal.SIGSTOP)
    for other in others:
        assert "error: the orchestrator is gone: " in other.end()[2]
    serve.signal(signal.SIGCONT)
    code, _, said = serve.end()
    assert code == 3
    assert re.search(r"  the orchestrator itself did not listen for \S+ s before that", said), said


def test_a_worker_leaves_while_the_run_goes_on(start: Start, tmp_path: Path) -> None:
    where = f"unixsock-stream/{tmp_path}/hub"
    serve = start("s", "serve", "paper_leaders", "--until", "10 h", "--listen", where, "--out", "out", "--no-report")
    emulator = start("e", "emulator", "--connect", where)
    leaver, other = (
        start(name, "worker", "--connect", where, "--agents", agents, "--name", name)
        for name, agents in (("lab-a", "1..4"), ("lab-b", "5..10"))
    )
    serve.hear("s simulated")
    late = start("late", "worker", "--connect", where, "--agents", "1..4")
    assert "the orchestrator refuses: the run has begun" in late.end()[2]
    leaver.signal(signal.SIGINT)
    assert leaver.end()[0] == 130
    code, _, error = serve.end()
    assert code == 3
    assert re.search(r"error: lab-a \(agents 1..4\) was lost at tick \d+ \(t = \S+ s\): it left the run", error)
    assert "everything until then is in out" in error
    for command in (emulator, other):
        code, _, error = command.end()
        assert code == 3
        assert "the orchestrator ended the run before its end: lab-a (agents 1..4) was lost at tick " in error


def test_nobody_waits_for_ever(start: Start, tmp_path: Path) -> None:
    where = f"unixsock-stream/{tmp_path}/hub"
    worker = start("a", "worker", "--connect", where, "--agents", "1", "--wait", "1 s", "--name", "a")
    code, _, error = worker.end()
    assert code == 3
    assert f"error: a: nobody answers at {where}" in error
    early = start("b", "worker", "--connect", where, "--agents", "1..7")
    early.hear("nobody answers")
    serve = start("s", "serve", *ARMS, "--listen", where, "--wait", "8 s")
    code, _, error = serve.end()
    assert code == 3
    assert "error: not there after 8 s: the emulator, agents 8..10" in error
    code, _, error = early.end()
    assert code == 3
    assert not (tmp_path / "s" / "out").exists()


# --- mistakes on the command line -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("serve paper_leaders", "one of the arguments --listen --connect is required"),
        (
            "serve paper_leaders --listen tcp/127.0.0.1",
            "tcp/127.0.0.1: write tcp/HOST:PORT, such as tcp/192.0.2.7:7447",
        ),
        ("serve paper_leaders --listen 127.0.0.1:7447", "127.0.0.1:7447: write tls/HOST:PORT (or unixsock-stream/PATH"),
        ("serve paper_leaders --listen tcp/0.0.0.0:7447", "without keys anybody who reaches this host could"),
        (
            "serve paper_leaders --listen tls/0.0.0.0:7447",
            "TLS needs keys: --keys FOLDER; to make them: cosim keys init",
        ),
        ("serve paper_leaders --listen tcp/127.0.0.1:7447 --run a/b", "run 'a/b': write letters, digits"),
        ("serve paper_leaders --listen tcp/127.0.0.1:7447 --workers 0", "write a number from 1, or 'per-agent'"),
        ("serve nothing --listen tcp/127.0.0.1:7447", "nothing"),
        ("worker --connect tcp/127.0.0.1:7447", "say which agents this worker carries, such as --agents 1..5"),
        ("worker --connect tcp/127.0.0.1:7447 --name a/b", "process 'a/b': write letters, digits"),
        ("worker --connect tcp/127.0.0.1:7447 --agents 1 --files nowhere", "--files nowhere: there is no such folder"),
        ("emulator --connect tcp/no-such-host.invalid:7447 --insecure", "the host 'no-such-host.invalid' is unknown"),
        ("emulator --connect tcp/127.0.0.1:7447 --wait soon", "'soon' is not a time"),
        ("emulator", "the following arguments are required: --connect"),
    ],
)
def test_mistakes(command: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = cli.main(command.split())
    except SystemExit as error:
        code = int(error.code or 0)
    assert code == 2
    assert said in capsys.readouterr().err


# --- a router of the user's -------------------------------------------------------------------------------------------
ROUTER = """\
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("open", flush=True)
    sys.stdin.read()
"""


def test_two_runs_share_the_router_of_a_user(start: Start, tmp_path: Path, arms: str) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    with subprocess.Popen(
        [sys.executable, "-c", ROUTER, where], cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as router:
        try:
            assert router.stdout is not None
            assert router.stdout.readline() == "open\n"
            early = start("early", "worker", "--connect", where, "--agents", "1..10", "--namespace", "one")
            early.hear("run run has not begun to wait for its processes; waiting for it")
            running = [early]
            for name in ("one", "two"):
                place = ("--connect", where, "--namespace", name)
                running.append(start(f"s-{name}", "serve", *ARMS, *place))
                running.append(start(f"e-{name}", "emulator", *place))
            running.append(start("other", "worker", "--connect", where, "--agents", "1..10", "--namespace", "two"))
            for command in running:
                command.succeed()
        finally:
            router.communicate("", PATIENCE)
    assert digest(tmp_path / "s-one" / "out") == digest(tmp_path / "s-two" / "out") == arms
