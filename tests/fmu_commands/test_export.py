"""`cosim fmu export`: a Python class as an FMU gives the class's own trajectories, here and in another tool."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description

from cosim.cli import main
from cosim.conformance import Verdict, check
from cosim.errors import RunEndedError
from cosim.planning import plan
from cosim.scenario.reading import read_scenario
from tests.components.misbehaving import cosim
from tests.distributed.networks import Record, in_process

MODULE = '''
import sys

from cosim.components.python import Discard, EndSimulation, Input, Output, Parameter
from cosim.components.python import PythonComponent, State, Structural


class Motor(PythonComponent):
    """Two of them on one shaft, with a spring between."""

    inertia = Parameter([0.01, 0.02], shape=(2,), unit="kg.m2")
    friction = Parameter(0.1, unit="N.m.s/rad", description="of both")
    label = Parameter("motor", dtype="String")
    locked = Parameter(False, dtype="Boolean")
    mode = Parameter(1, items={"soft": 1, "hard": 2})
    torque = Input(unit="N.m")
    w = State([0.0, 1.0], shape=(2,), unit="rad/s")
    angle = State(0.5, unit="rad")
    power = Output(unit="W", depends_on=("torque",))

    def derivatives(self, time):
        twist = 0.1 * self.mode * self.angle
        moments = [self.torque - twist - self.friction * self.w[0], twist - self.friction * self.w[1]]
        slope = [0.0, 0.0] if self.locked else moments / self.inertia
        return {"w": slope, "angle": self.w[0] - self.w[1]}

    def outputs(self, time):
        self.power = self.torque * self.w[0]


class Follow(PythonComponent):
    count = Structural()
    gain = Parameter(0.5, unit="N.m.s/rad")
    w = Input(unit="rad/s", shape=(2,))
    heard = Input(shape=("count",), unit="rad")
    stamp = Input(-1, shape=("count",), dtype="Int64")
    torque = Output(unit="N.m", depends_on=("w", "heard", "stamp"))

    def outputs(self, time):
        fresh = self.stamp >= 0
        self.torque = self.gain * ((self.heard[fresh].mean() if fresh.any() else 3.0) - self.w[1])


class Stepping(PythonComponent):
    """y counts u, by itself."""

    u = Input()
    y = Output(depends_on=())

    def step(self, time, step):
        self.y = self.y + step * self.u


class Talking(Stepping):
    def step(self, time, step):
        print("the FMU prints")
        print("the FMU complains", file=sys.stderr)
        if time > 0.8:
            raise ValueError("the FMU has enough")


class Counting(Stepping):
    def __init__(self):
        self.past = [0.0]

    def step(self, time, step):
        self.past.append(self.u * time)
        self.y = sum(self.past)


class Tied(Stepping):
    def __init__(self):
        self.function = lambda: 1


class Device(Stepping):
    save = None


class Ending(Stepping):
    def step(self, time, step):
        self.y = time
        if time > 0.25:
            raise EndSimulation("enough")


class Bursting(PythonComponent):
    x = State(1.0)

    def derivatives(self, time):
        return {"x": self.x}

    def event(self, time):
        if time > 0.25:
            raise EndSimulation("enough")


class Hasty(Stepping):
    def step(self, time, step):
        self.y = self.y + step
        if step > 0.003:
            raise Discard("too long")
'''
SCENARIO = """
period: 100 ms
duration: 1 s
templates:
  motor:
    components:
      motor: {{{motor}, start: {{w: [0.25, 0.5], friction: 0.2, mode: hard}}}}
      follow: {{{follow}, start: {{gain: 0.75}}}}
    connections: [motor.w -> follow.w, follow.torque -> motor.torque]
    publish: {{w: motor.angle}}
    receive: {{w: follow.heard, stamp: follow.stamp{count}}}
    record: [motor.w, motor.angle, motor.power, follow.torque]
    coupling: {{method: {method}, loop: {loop}}}
agents:
  1..3: {{template: motor}}
graph: {{channel: slow, edges: [1 -> 2, 2 -> 3, 3 -> 1]}}
channels: {{slow: {{model: netem, delay: [10 ms, 250 ms], loss: 10 %}}}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the module and its classes as FMUs."""
    path = tmp_path_factory.mktemp("export")
    (path / "driven_motors.py").write_text(MODULE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        patch.syspath_prepend(path)
        assert main(["fmu", "export", "driven_motors:Motor"]) == 0
        assert main(["fmu", "export", "driven_motors:Follow", "--size", "count=1", "-o", "following.fmu"]) == 0
        for name in ("Stepping", "Counting", "Tied", "Device", "Hasty", "Talking", "Ending", "Bursting"):
            assert main(["fmu", "export", f"driven_motors:{name}"]) == 0
    return path


def played(folder: Path, **parts: str) -> Record:
    scenario = folder / "net.yaml"
    scenario.write_text(SCENARIO.format(**parts))
    record, error = in_process(plan(read_scenario(scenario)).plan)
    assert error is None
    return record


PYTHON = {"motor": 'python: "driven_motors:Motor"', "follow": 'python: "driven_motors:Follow"'}
FMU = {"motor": "fmu: ./Motor.fmu", "follow": "fmu: ./following.fmu"}


@pytest.mark.parametrize("loop", ["native", "python"])
def test_the_fmu_gives_the_trajectories_of_the_class(folder: Path, monkeypatch: pytest.MonkeyPatch, loop: str) -> None:
    monkeypatch.syspath_prepend(folder)
    expected = played(folder, **PYTHON, count=", count: follow.count", method="joint", loop="python")
    assert played(folder, **FMU, count="", method="joint", loop=loop) == expected


STEPPING = """
period: 100 ms
duration: 1 s
agents:
  one:
    components:
      source: {{python: "cosim.components.library:Sine"}}
      counter: {{{counter}}}
    connections: [source.phi -> counter.u]
    record: [source.phi, counter.y]
    coupling: {{method: {method}, step: 2 ms}}
"""


@pytest.mark.parametrize("method", ["midpoint", "gauss-seidel", "jacobi"])
def test_a_class_that_steps_itself(folder: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    monkeypatch.syspath_prepend(folder)
    records = []
    for counter in ('python: "driven_motors:Stepping"', "fmu: ./Stepping.fmu"):
        (folder / "one.yaml").write_text(STEPPING.format(counter=counter, method=method))
        record, error = in_process(plan(read_scenario(folder / "one.yaml")).plan)
        assert error is None
        records.append(record)
    assert records[0] == records[1]


@pytest.mark.parametrize("loop", ["native", "python"])
def test_what_it_prints_goes_to_the_run_folder(folder: Path, tmp_path: Path, loop: str) -> None:
    """Although its Python is that of this process, as of every FMU that PythonFMU makes."""
    text = STEPPING.format(counter=f"fmu: {folder / 'Talking.fmu'}", method="jacobi").replace("100 ms", "500 ms")
    if loop == "native":
        text = text.replace('source: {python: "cosim.components.library:Sine"}', "source: {fmu: DoubleIntegrator}")
        text = text.replace("source.phi", "source.p")
    text = text.replace("2 ms", f"500 ms, loop: {loop}").replace("1 s", "2 s")
    done = cosim(tmp_path, "run", "net.yaml", "--out", "out", "--no-report", text=text)
    assert done.returncode == 3
    assert "component counter, at t = 1 s: fmi3DoStep returned" in done.stderr
    assert "the FMU prints" not in done.stdout + done.stderr
    assert "the FMU complains" not in done.stdout + done.stderr
    printed = (tmp_path / "out" / "logs" / "output.log").read_text()
    assert printed.count("the FMU prints\n") == printed.count("the FMU complains\n") == 3


def test_it_keeps_to_the_rules(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(folder)
    for name, interfaces in (("Motor", 2), ("following", 2), ("Stepping", 1)):
        report = check(folder / f"{name}.fmu")
        report.require()
        restored = [f for f in report.findings if (f.check, f.verdict) == ("save and restore", Verdict.OK)]
        assert len(restored) == interfaces


SERIALIZED = """
import numpy, sys
from fmpy import extract, read_model_description
from fmpy.fmi3 import FMU3Slave

def opened():
    fmu = FMU3Slave(guid=description.guid, unzipDirectory=folder, instanceName="one",
                    modelIdentifier=description.coSimulation.modelIdentifier)
    fmu.instantiate()
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    return fmu

def drive(fmu):
    for i in range(5):
        fmu.setFloat64([u], [1.0 + i])
        fmu.doStep(0.1 * (n + i), 0.1)
    return fmu.getFloat64([y])[0]

folder, description = extract(sys.argv[1]), read_model_description(sys.argv[1])
assert description.coSimulation.canSerializeFMUstate
u, y = (next(v.valueReference for v in description.modelVariables if v.name == name) for name in "uy")
one, n = opened(), 0
drive(one)
state = one.getFMUState()
data = one.serializeFMUState(state)
one.freeFMUState(state)
n = 5
expected = drive(one)
other = opened()
state = other.deserializeFMUState(data)
for fmu in (other, one):
    fmu.setFMUState(state)
    assert drive(fmu) == expected > 0.0
one.reset()
one.enterInitializationMode()
one.exitInitializationMode()
one.setFMUState(state)
assert drive(one) == expected
"""


def elsewhere(folder: Path, script: str, *arguments: str) -> str:
    """What a script prints in another process."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, *arguments],
        cwd=folder,
        text=True,
        capture_output=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_another_tool_carries_a_state_from_one_instance_to_another(folder: Path, tmp_path: Path) -> None:
    elsewhere(tmp_path, SERIALIZED, str(folder / "Counting.fmu"))


@pytest.mark.parametrize(
    ("name", "can"),
    [("Counting", (True, True)), ("Stepping", (True, True)), ("Tied", (True, False)), ("Device", (False, False))],
)
def test_what_an_fmu_says_that_it_can(folder: Path, name: str, can: tuple[bool, bool]) -> None:
    co_simulation = read_model_description(folder / f"{name}.fmu").coSimulation
    assert (co_simulation.canGetAndSetFMUstate, co_simulation.canSerializeFMUstate) == can


@pytest.mark.parametrize("name", ["Ending", "Bursting"])
def test_a_request_to_end(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.syspath_prepend(folder)
    seen = []
    for part in (f'python: "driven_motors:{name}"', f"fmu: ./{name}.fmu"):
        text = f"period: 100 ms\nduration: 1 s\nagents:\n  1:\n    components: {{part: {{{part}}}}}\n"
        (folder / "ending.yaml").write_text(text)
        record, error = in_process(plan(read_scenario(folder / "ending.yaml")).plan)
        assert isinstance(error, RunEndedError)
        seen.append((record, error.agent, error.component, error.time))
    assert seen[0] == seen[1]
    assert len(seen[0][0].ticks) == 3


@pytest.mark.parametrize("coupling", ["step: 10 ms, retries: 2", "tolerance: 1e-3"])
def test_discarded_steps(folder: Path, monkeypatch: pytest.MonkeyPatch, coupling: str) -> None:
    monkeypatch.syspath_prepend(folder)
    records = []
    for part in ('python: "driven_motors:Hasty"', "fmu: ./Hasty.fmu"):
        text = f"period: 100 ms\nduration: 500 ms\nagents:\n  1:\n    components: {{part: {{{part}}}}}\n"
        (folder / "hasty.yaml").write_text(text + f"coupling: {{method: gauss-seidel, {coupling}}}\n")
        record, error = in_process(plan(read_scenario(folder / "hasty.yaml")).plan)
        assert error is None
        records.append(record)
    assert records[0] == records[1]


ELSEWHERE = """
import sys
sys.path[:] = [path for path in sys.path if {repository!r} not in path]
from fmpy import simulate_fmu
result = simulate_fmu({fmu!r}, fmi_type={kind!r}, stop_time=1.0, output_interval=0.01, start_values={{"torque": 0.1}})
import cosim
assert "resources" in cosim.__file__, cosim.__file__
print(result["angle"][-1])
"""


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_another_tool_runs_it_without_netcosim_or_the_module(folder: Path, tmp_path: Path, kind: str) -> None:
    repository = str(Path(__file__).parents[2])
    script = ELSEWHERE.format(repository=repository + "/cosim", fmu=str(folder / "Motor.fmu"), kind=kind)
    printed = elsewhere(tmp_path, script)
    from scipy.integrate import solve_ivp

    def slope(_t: float, x: np.ndarray) -> list[float]:
        twist = 0.1 * x[2]
        return [(0.1 - twist - 0.1 * x[0]) / 0.01, (twist - 0.1 * x[1]) / 0.02, x[0] - x[1]]

    exact = solve_ivp(slope, (0, 1), [0.0, 1.0, 0.5], rtol=1e-10, atol=1e-12).y[2, -1]
    assert float(printed.split()[-1]) == pytest.approx(exact, abs=1e-4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["driven_motors:Moter"], "module driven_motors has no class 'Moter' (did you mean 'Motor'?)"),
        (["driven_motors:Follow", "--size", "n=1"], "driven_motors:Follow has no structural parameter 'n'"),
        (["driven_motors:Follow", "--size", "count=many"], "--size count=many: write NAME=N"),
        (["driven_motors:Motor"], "Motor.fmu exists already; choose another name with -o or remove it"),
        (["driven_motors:Motor", "-o", "nowhere/Motor.fmu"], "cannot be written: No such file or directory"),
    ],
)
def test_mistakes(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(folder)
    assert main(["fmu", "export", *arguments]) == 2
    assert sentence in capsys.readouterr().err


def test_without_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "pythonfmu3.builder", None)
    monkeypatch.chdir(folder)
    assert main(["fmu", "export", "driven_motors:Motor", "-o", "other.fmu"]) == 2
    assert "pip install 'netcosim[export]'" in capsys.readouterr().err
