"""Components in processes of their own: the same numbers, and whatever they do hurts nobody else."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim import scratch
from cosim.components.isolation.calls import ProtocolError, calls, fault, results
from cosim.components.isolation.process import HostProcess
from cosim.errors import ConfigError, RunError
from cosim.logs import discard
from cosim.plan import Loop
from cosim.results import load
from fmus import build
from tests.components.misbehaving import ROOT, cosim, digest, scenario
from tests.components.probe import description3, write_fmu
from tests.distributed.networks import Record, in_process, planned

pytestmark = pytest.mark.skipif(os.name == "nt", reason="takes a pair of sockets to inherit")

ARMS = """\
period: 100 ms
duration: 300 ms
templates:
  arm:
    components:
      plant: {{fmu: TwoLinkArm.fmi{plant}, start: {{p: [0.3, 0.1]}}{isolate}}}
      controller: {{fmu: ArmSyncController.fmi{controller}{isolate}}}
    connections: [plant.p -> controller.p, plant.v -> controller.v, controller.u -> plant.u]
    publish: {{p: plant.p, v_hat: controller.v_hat}}
    receive:
      period: controller.T
      count: controller.n_neighbours
      stamp: controller.neighbour_stamp
      time: controller.neighbour_time
      weight: controller.weight
      p: controller.neighbour_p
      v_hat: controller.neighbour_v_hat
agents:
  1..2: {{template: arm}}
coupling: {{method: {method}}}
graph: {{channel: slow, edges: [1 -> 2, 2 -> 1]}}
channels:
  slow: {{model: netem, delay: 37 ms}}
"""

MOTORS = """\
period: 100 ms
duration: 500 ms
agents:
  1:
    components:
      sine: {{python: "cosim.components.library:Sine"{isolate}}}
      hold: {{python: "cosim.components.library:Hold"{isolate}}}
    connections: [sine.phi -> hold.values]
coupling: {{method: {method}}}
"""


def hosts(folder: Path) -> list[str]:
    """The processes of isolated components whose temporary files are below `folder`."""
    lines = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    return [str(line) for line in lines if b"isolation.host" in line and str(folder).encode() in line]


def assert_nothing_left(folder: Path) -> None:
    assert list((folder / "tmp").iterdir()) == []
    assert hosts(folder) == []


def played(text: str) -> tuple[Record, Exception | None]:
    return in_process(planned(text))


# --- the same numbers ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("method", "plant", "controller"),
    [
        ("joint", 2, 3),
        ("joint, integrator: dormand-prince", 3, 2),
        ("midpoint", 2, 3),
        ("midpoint, tolerance: 1e-4", 3, 2),
        ("gauss-seidel, tolerance: 1e-3", 2, 3),
        ("jacobi", 3, 2),
    ],
)
def test_arms_are_the_same(method: str, plant: int, controller: int) -> None:
    one, other = (
        planned(ARMS.format(method=method, isolate=isolate, plant=plant, controller=controller))
        for isolate in ("", ", isolate: true")
    )
    assert {agent.coupling.loop for agent in other.agents} == {Loop.PYTHON}
    assert all(agent.coupling.control is None or agent.coupling.control.rollback for agent in other.agents)
    assert in_process(one) == in_process(other)


@pytest.mark.parametrize("method", ["joint", "gauss-seidel"])
def test_python_components_are_the_same(method: str) -> None:
    one, other = (played(MOTORS.format(method=method, isolate=isolate)) for isolate in ("", ", isolate: true"))
    assert one == other
    assert one[0].ticks


@pytest.mark.parametrize("fmi", [2, 3])
def test_events_of_the_probe_are_the_same(probes: dict[int, Path], fmi: int) -> None:
    """Time events, state events and jumps of states."""
    one, other = (
        played(scenario(probes[fmi], "nothing", isolate, method="joint")) for isolate in ("", ", isolate: true")
    )
    assert one[1] is None
    assert one == other


def test_across_processes_too(probes: dict[int, Path], tmp_path: Path) -> None:
    text = scenario(probes[3], "step_prints")
    plain = cosim(tmp_path, "run", "net.yaml", "--out", "plain", "--no-report", text=text)
    isolated = cosim(
        tmp_path,
        *("run", "net.yaml", "--out", "isolated", "--no-report", "--distributed", "--workers", "2"),
        *("--set", "templates.probe.components.probe.isolate=true"),
    )
    assert digest(plain) == digest(isolated)
    assert [file.name for file in (tmp_path / "isolated" / "logs").iterdir()] == ["bad.probe.log"]
    again = cosim(tmp_path, "run", "isolated/scenario.yaml", "--out", "again", "--no-report")
    assert digest(again) == digest(plain)
    assert "isolate" in (tmp_path / "again" / "scenario.yaml").read_text()
    assert_nothing_left(tmp_path)


# --- what it does hurts nobody else -------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fails", "said", "last"),
    [
        ("step_crashes", r"its process was killed by signal 11 \(SIGSEGV\)", "about to crash"),
        ("step_hangs", r"did not answer within 5 s, and its process was killed", "going round in circles"),
        ("step_scribbles", r"its process says what it must not: .*", None),
        ("step_error", r"fmi3DoStep returned Error", "[Error] the probe gives up at t = 0"),
    ],
)
def test_the_run_ends_in_good_order(
    probes: dict[int, Path], tmp_path: Path, fails: str, said: str, last: str | None
) -> None:
    deadline = 5 if fails == "step_hangs" else 100  # others may take their time, as for a core dump
    text = scenario(probes[3], fails, f", isolate: {{deadline: {deadline} s}}")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", text=text)
    assert done.returncode == 3
    at = "0" if fails == "step_error" else "0.36"
    assert re.search(rf"^error: agent bad, component probe, at t = {at} s: {said}$", done.stderr, re.MULTILINE)
    if last:
        assert f"its last log line: {last}" in done.stderr
        assert (tmp_path / "out" / "logs" / "bad.probe.log").read_text().splitlines()[-1] == last
    run = load(tmp_path / "out")
    assert run.manifest["status"].startswith("aborted: agent bad, component probe")
    assert run.trajectories["tick"].max() == (0 if fails == "step_error" else 3)
    assert_nothing_left(tmp_path)


def test_runs_of_one_interpreter_leave_nothing_in_it() -> None:
    for _ in range(2):
        _, error = played(MOTORS.format(method="joint", isolate=", isolate: true"))
        assert error is None
        known = set(scratch._own)
    assert all(Path(path).exists() for path in known)


def test_what_belongs_to_a_process_is_its_own(probes: dict[int, Path], tmp_path: Path) -> None:
    before = Path.cwd(), dict(os.environ)
    record, error = played(scenario(probes[3], "step_wanders", ", isolate: true"))
    assert error is None
    assert (Path.cwd(), dict(os.environ)) == before
    assert record.ticks == played(scenario(probes[3], "nothing"))[0].ticks


def test_each_instance_is_the_only_one_of_its_process(probes: dict[int, Path]) -> None:
    text = scenario(probes[3], "nothing").replace("[probe.x]", "[probe.instances]")
    text = text.replace(f"fmu: {probes[3]}", f"fmu: {probes[3]}, isolate: true")
    record, error = played(text)
    assert error is None
    assert np.frombuffer(record.ticks[-1][1]).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("hangs", [False, True], ids=["in the midst of steps", "while it hangs"])
def test_it_ends_with_its_agents_process(probes: dict[int, Path], tmp_path: Path, hangs: bool) -> None:
    text = scenario(probes[3], "step_hangs" if hangs else "nothing", ", isolate: {deadline: 100 s}")
    (tmp_path / "net.yaml").write_text(text.replace("duration: 1 s", "duration: 10000 s"))
    (tmp_path / "tmp").mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "cosim", "run", "net.yaml", "--out", "out", "--no-report"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path / "tmp")},
        stderr=subprocess.DEVNULL,
    )
    log = tmp_path / "out" / "logs" / "bad.probe.log"
    spool = tmp_path / "out" / ".spool"
    await_true(lambda: log.exists() if hangs else spool.exists() and spool.read_bytes().strip(b"\0") != b"")
    process.send_signal(signal.SIGKILL)
    process.wait()
    await_true(lambda: not hosts(tmp_path))


def await_true(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_file_that_cannot_be_loaded(tmp_path: Path) -> None:
    source, library = tmp_path / "unresolved.c", tmp_path / f"probe{build.library_suffix()}"
    export = '__attribute__((visibility("default")))'
    source.write_text(f"int not_there(void);\n{export} int fmi3GetVersion(void) {{ return not_there(); }}\n")
    build.compile_shared([source], library)
    path = write_fmu(tmp_path / "broken.fmu", library, description3())
    _, error = played(scenario(path, "nothing", ", isolate: true").replace("  good: {template: probe}\n", ""))
    assert isinstance(error, ConfigError)
    assert "component probe: broken.fmu cannot be loaded: " in str(error)
    assert "not_there" in str(error)


def test_start_values_that_are_refused(probes: dict[int, Path]) -> None:
    plan = planned(scenario(probes[3], "nothing", ", isolate: true"))
    bad = plan.agents[1].components[0]
    plan = replace(plan, agents=(replace(plan.agents[1], components=(replace(bad, start={"label": (3,)}),)),))
    _, error = in_process(plan)
    assert isinstance(error, RunError)
    assert str(error) == "agent bad, component probe, at t = 0 s: label takes a text, not 3"


def test_a_process_that_does_not_die_is_left_behind_with_a_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that waits for a disk takes no signal until that answers; here the signal is withheld."""
    process = HostProcess(discard)
    monkeypatch.setattr("cosim.spawning._DEATH_SECONDS", 0.01)
    monkeypatch.setattr(os, "killpg", lambda *_: None)
    process.kill()
    assert "the process of a component (process " in capsys.readouterr().err
    process._process.wait(60)  # it saw its standard input end


# --- what comes from the process is not trusted -------------------------------------------------------------------
@given(body=st.binary(max_size=200), count=st.integers(0, 2**32 - 1))
def test_bytes_of_any_kind_are_no_more_than_a_fault(body: bytes, count: int) -> None:
    for read in (lambda: results(count, body), lambda: list(calls(count, body)), lambda: fault(body)):
        with suppress(ProtocolError):
            read()
