"""A component asks for the end of a run, which is no failure: exit code 0, and everything until then is there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cosim.results import load
from tests.components.misbehaving import cosim, digest

SCENARIO = """\
period: 100 ms
duration: 1 s
agents:
  good: {{components: {{probe: {{fmu: {fmu}}}}}, publish: {{x: probe.x}}, record: [probe.x]}}
  bad:
    components: {{probe: {{fmu: {fmu}, start: {{fails: {fails}}}{isolate}}}}}
    publish: {{x: probe.x}}
    record: [probe.x]
coupling: {{method: {method}, step: 10 ms}}
graph: {{channel: slow, edges: [good -> bad, bad -> good]}}
channels: {{slow: {{model: netem, delay: 250 ms}}}}
"""
WAYS = {
    "native loop": ([], ""),
    "Python loop": (["--set", "coupling.loop=python"], ""),
    "across processes": (["--distributed", "--workers", "2"], ""),
    "a process of its own": ([], ", isolate: true"),
}


def manifest(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "out" / "manifest.json").read_text())
    return found


CASES = [pytest.param(2, "gauss-seidel", "step_stops", id="2"), pytest.param(3, "joint", "update_stops", id="3")]


@pytest.mark.parametrize(("fmi", "method", "fails"), CASES)
def test_all_ways(probes: dict[int, Path], tmp_path: Path, fmi: int, method: str, fails: str) -> None:
    """To run it agree."""
    digests, ended = set(), []
    for number, (options, isolate) in enumerate(WAYS.values()):
        folder = tmp_path / str(number)  # a socket's path must be short
        folder.mkdir()
        text = SCENARIO.format(fmu=probes[fmi], method=method, fails=fails, isolate=isolate)
        done = cosim(folder, "run", "net.yaml", "--out", "out", "--no-report", *options, text=text)
        digests.add(digest(done))
        found = manifest(folder)
        assert found["status"] == "complete"
        assert found["ticks"]["planned"] == 10
        ended.append((found["ended"], found["ticks"]["done"]))
    assert len(digests) == 1
    assert all(one == ended[0] for one in ended)
    (account, ticks) = ended[0]
    assert (account["agent"], account["component"]) == ("bad", "probe")
    assert account["message"] == "asks to end the simulation (terminateSimulation)"
    assert ticks == int(account["time_s"] / 0.1)
    fates = load(tmp_path / "0" / "out").deliveries.fate.value_counts()
    assert fates["in_flight"] == 2 * min(3, ticks + 1)


def test_what_people_see(probes: dict[int, Path], tmp_path: Path) -> None:
    text = SCENARIO.format(fmu=probes[3], method="gauss-seidel", fails="step_stops", isolate="")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--estimate-error", text=text)
    assert done.returncode == 0, done.stderr
    found = manifest(tmp_path)
    simulated, time = found["simulated_s"], found["ended"]["time_s"]
    assert f"{simulated:g} s of 1 s simulated" in done.stdout
    line = f"at t = {time:.9g} s by component probe of agent bad, which asked for it"
    assert f"  ended                    {line}\n" in done.stdout
    assert line in (tmp_path / "out" / "report.html").read_text()
    again = cosim(tmp_path, "run", "out/scenario.yaml", "--out", "again", "--no-report")
    assert digest(again) == found["digest"]
    assert again.returncode == 0


def test_before_the_run_begins_it_is_a_failure(tmp_path: Path) -> None:
    text = "period: 100 ms\nduration: 1 s\nagents:\n  one: {components: {part: {python: 'never:Begins'}}}\n"
    (tmp_path / "never.py").write_text(
        "from cosim.components.python import EndSimulation, Output, PythonComponent\n"
        "class Begins(PythonComponent):\n"
        "    y = Output()\n"
        "    def initialise(self, time):\n"
        "        raise EndSimulation('nothing to do')\n"
    )
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", text=text)
    assert done.returncode == 3
    assert "agent one, component part, at t = 0 s: asks to end the simulation: nothing to do" in done.stderr
