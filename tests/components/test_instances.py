"""Live FMUs: life cycles, values of every type, start values, and what happens when one fails."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE

import fmpy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fmus
from cosim.components.component import Interface, Value
from cosim.components.fmu import FmuComponent, describe, library, open_fmu
from cosim.errors import ComponentError, ConfigError
from fmus import build
from tests.components.probe import TYPES, description2, description3, write_fmu

ME, CS = Interface.MODEL_EXCHANGE, Interface.CO_SIMULATION
ROOT = Path(__file__).parents[2]

Open = Callable[..., FmuComponent]
EXPORT = '__attribute__((visibility("default")))'


@pytest.fixture
def opened(probes: dict[int, Path]) -> Iterator[Open]:
    """`opened(3, CS, fails="step_error")`: a probe with start values, ended when the test ends."""
    live: list[FmuComponent] = []

    def open_one(fmi: int, interface: Interface, path: Path | None = None, **start: Value) -> FmuComponent:
        file = path or probes[fmi]
        description = describe(file)
        live.append(open_fmu("probe", file, interface, description))
        for name, value in start.items():
            live[-1].start(description.variables[name], (value,))
        return live[-1]

    yield open_one
    for component in live:
        component.terminate()


def initialised(component: FmuComponent) -> FmuComponent:
    component.enter_initialization(0.0, 1.0)
    component.exit_initialization()
    return component


def get(component: FmuComponent, name: str) -> list[float]:
    return list(component.get(component.description.variables[name]).tolist())


def put(component: FmuComponent, name: str, *values: float) -> None:
    component.set(component.description.variables[name], np.array(values, dtype=np.float64))


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_tolerance_of_its_own_solver(probe_library: Path, tmp_path: Path, fmi: int) -> None:
    """In Co-Simulation an FMU is told what its default experiment says, unless the scenario says another."""
    text = (description2() if fmi == 2 else description3()).replace(
        "<ModelVariables>", '<DefaultExperiment tolerance="1e-5"/><ModelVariables>'
    )
    path = write_fmu(tmp_path / "x.fmu", probe_library, text)
    description = describe(path)
    for interface, used, said in (
        (CS, description, ["[Warning] told the tolerance 1e-05"]),
        (CS, replace(description, tolerance=1e-9), ["[Warning] told the tolerance 1e-09"]),
        (ME, description, []),
    ):
        component = initialised(open_fmu("probe", path, interface, used))
        component.terminate()
        assert list(component.log.lines) == said


# --- life cycles ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("fmi", [2, 3])
def test_co_simulation_of_the_arm(fmi: int) -> None:
    path = fmus.path(f"TwoLinkArm.fmi{fmi}")
    description = describe(path)
    arm = open_fmu("arm", path, CS, description)
    arm.start(description.variables["p"], (0.3, 0.0))
    initialised(arm)
    arm.set(description.variables["u"], np.array([1.0, 0.5]))
    arm.step(0.0, 0.01)
    assert arm.get(description.variables["p"])[0] != 0.3
    arm.terminate()
    arm.terminate()


@pytest.mark.parametrize("fmi", [2, 3])
def test_model_exchange_of_the_arm(fmi: int) -> None:
    path = fmus.path(f"TwoLinkArm.fmi{fmi}")
    description = describe(path)
    arm = open_fmu("arm", path, ME, description)
    arm.start(description.variables["p"], (0.3, 0.1))
    initialised(arm)
    assert arm.update_discrete_states() is None
    arm.enter_continuous_time_mode()
    assert arm.n_states == 4
    assert arm.get_states().tolist() == [0.3, 0.1, 0.0, 0.0]
    arm.set_time(0.5)
    arm.set_states(np.array([0.0, 0.0, 1.0, 2.0]))
    assert arm.derivatives()[:2].tolist() == [1.0, 2.0]
    assert not arm.completed_step()
    arm.enter_event_mode()
    arm.terminate()


def test_instances_share_a_library_but_no_values(opened: Open) -> None:
    one, two = opened(3, CS), opened(3, CS)
    for component, value in ((one, 1.5), (two, 2.5)):
        initialised(component)
        put(component, "vector_in", value, value)
    assert get(one, "vector_out") == [1.5, 1.5]
    assert get(two, "vector_out") == [2.5, 2.5]
    assert get(two, "instances")[0] == get(one, "instances")[0] + 1


def test_an_fmu_for_one_instance_gets_a_library_of_its_own(probe_library: Path, tmp_path: Path, opened: Open) -> None:
    once = '<CoSimulation modelIdentifier="probe" canBeInstantiatedOnlyOncePerProcess="true"'
    text = description3().replace('<CoSimulation modelIdentifier="probe"', once)
    path = write_fmu(tmp_path / "once.fmu", probe_library, text)
    assert [get(initialised(opened(3, CS, path)), "instances") for _ in range(3)] == [[1.0]] * 3


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interface", [ME, CS])
def test_ending_before_initialisation(opened: Open, fmi: int, interface: Interface) -> None:
    opened(fmi, interface).terminate()


def test_an_ended_instance_cannot_be_called(opened: Open) -> None:
    component = initialised(opened(3, CS))
    component.terminate()
    with pytest.raises(ComponentError, match="cannot be called any more"):
        component.step(0.0, 0.1)


def test_opening_leaves_the_working_directory_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "unresolved.c"
    source.write_text(f"int not_there(void);\n{EXPORT} int fmi3GetVersion(void) {{ return not_there(); }}\n")
    build.compile_shared([source], tmp_path / f"probe{build.library_suffix()}")
    path = write_fmu(tmp_path / "x.fmu", tmp_path / f"probe{build.library_suffix()}", description3())
    with pytest.raises(ConfigError, match=r"cannot be loaded: .*not_there"):
        open_fmu("broken", path, CS, describe(path))
    assert Path.cwd() == tmp_path


def test_another_file_than_was_described_is_refused(probes: dict[int, Path], tmp_path: Path) -> None:
    description = describe(probes[3])
    with pytest.raises(ComponentError, match="SHA-256 differs"):
        open_fmu("probe", probes[2], CS, description)


@pytest.mark.parametrize(("fmi", "text"), [(2, description2()), (3, description3())])
def test_the_log_says_why_instantiation_fails(probe_library: Path, tmp_path: Path, fmi: int, text: str) -> None:
    token = text.replace('="probe"', '="other"', 1)
    path = write_fmu(tmp_path / f"x{fmi}.fmu", probe_library, token.replace('modelIdentifier="other"', "", 1))
    with pytest.raises(ComponentError) as caught:
        open_fmu("probe", path, CS, describe(path))
    assert caught.value.log == "[Error] wrong token"
    assert "its library gives no instance; `cosim check` shows what it prints" in caught.value.message


# --- values ---------------------------------------------------------------------------------------------------------
RANGES = {"Int8": 2**7, "Int16": 2**15, "Int32": 2**31, "Int64": 2**63}


@given(value=st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_values_take_the_type_of_their_variable(probes: dict[int, Path], value: float) -> None:
    component = initialised(open_fmu("probe", probes[3], CS, describe(probes[3])))
    for name in TYPES:
        put(component, f"{name}_in", value)
        (read,) = get(component, f"{name}_out")
        if name == "Boolean":
            assert read == (value != 0.0)
        elif name == "Float32":
            assert read == value
        else:
            top = RANGES[name.removeprefix("U")] if name != "Enumeration" else 2**63
            low, high = (0, 2 * top) if name.startswith("U") else (-top, top)
            assert low <= read <= high
            if low <= value < high - 0.5:
                assert read == np.rint(value)
    component.terminate()


def test_arrays_of_both_versions(opened: Open) -> None:
    for fmi in (2, 3):
        component = initialised(opened(fmi, CS))
        put(component, "vector_in", 1.25, -2.5)
        assert get(component, "vector_out") == [1.25, -2.5]


def test_an_array_sized_by_a_structural_parameter(probes: dict[int, Path]) -> None:
    description = describe(probes[3], {"n": 5})
    component = open_fmu("probe", probes[3], ME, description)
    component.start(description.variables["n"], (5,))
    component.start(description.variables["vector_in"], (1.0, 2.0, 3.0, 4.0, 5.0))
    initialised(component)
    assert get(component, "vector_out") == [1.0, 2.0, 3.0, 4.0, 5.0]
    component.terminate()


def test_an_array_of_size_zero_is_not_touched(probes: dict[int, Path]) -> None:
    description = describe(probes[3], {"n": 0})
    component = open_fmu("probe", probes[3], CS, description)
    component.start(description.variables["n"], (0,))
    initialised(component)
    put(component, "vector_in")
    assert get(component, "vector_out") == []
    component.terminate()


def test_texts_and_bytes_are_no_numbers(opened: Open) -> None:
    component = initialised(opened(3, CS))
    with pytest.raises(ComponentError, match="label is of type String: it holds no numbers"):
        get(component, "label")
    with pytest.raises(ComponentError, match="blob is of type Binary: it holds no numbers"):
        get(component, "blob")


# --- start values ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("fmi", [2, 3])
def test_start_values_of_every_kind(opened: Open, fmi: int) -> None:
    component = initialised(opened(fmi, CS, Enumeration_in="two", Boolean_in=True, Int32_in=-7, label="Ärmchen"))
    assert get(component, "Enumeration_out") == [2.0]
    assert get(component, "Boolean_out") == [1.0]
    assert get(component, "Int32_out") == [-7.0]


def test_bytes_as_a_start_value(opened: Open) -> None:
    component = initialised(opened(3, CS, fails="step_error", blob="6D6F 746f72"))
    with pytest.raises(ComponentError) as caught:
        component.step(0.0, 0.1)
    assert caught.value.log == "[Error] motor gives up at t = 0"


@pytest.mark.parametrize("value", ["6d6", "0xff", 616263, True])
def test_wrong_bytes(opened: Open, value: Value) -> None:
    with pytest.raises(ComponentError, match="blob takes bytes in hexadecimal digits, in quotes"):
        opened(3, CS, blob=value)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("Enumeration_in", "tow", "Enumeration_in has no item 'tow' (did you mean 'two'?)"),
        ("Boolean_in", 2, "Boolean_in takes true or false, not 2"),
        ("Boolean_in", "yes", "Boolean_in takes true or false, not 'yes'"),
        ("Int32_in", 1.5, "Int32_in takes a whole number, not 1.5"),
        ("Int32_in", True, "Int32_in takes a number, not True"),
        ("Int32_in", 2**40, "the start value of Int32_in is refused: it does not fit into Int32"),
        ("x", "fast", "x takes a number, not 'fast'"),
        ("label", 3, "label takes a text, not 3"),
    ],
)
@pytest.mark.parametrize("fmi", [2, 3])
def test_wrong_start_values(opened: Open, fmi: int, name: str, value: Value, said: str) -> None:
    component = opened(fmi, CS)
    with pytest.raises(ComponentError) as caught:
        component.start(component.description.variables[name], (value,))
    assert caught.value.message == said


def test_a_start_value_for_each_element(opened: Open) -> None:
    component = opened(3, CS)
    with pytest.raises(ComponentError, match="vector_in takes 2 values, not 3"):
        component.start(component.description.variables["vector_in"], (1.0, 2.0, 3.0))


def test_a_refused_start_value_names_the_variable() -> None:
    path = fmus.path("TwoLinkArm")
    description = describe(path)
    arm = open_fmu("arm", path, CS, description)
    derivative = next(v for v in description.variables.values() if v.name.startswith("der("))
    with pytest.raises(ComponentError) as caught:
        arm.start(derivative, (0.0,) * derivative.size)
    assert caught.value.message.startswith(f"the start value of {derivative.name} is refused: fmi3SetFloat64 returned")
    assert caught.value.log is not None
    arm.terminate()


# --- failures -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fmi", "fails", "said"),
    [
        (2, "step_discards", "fmi2DoStep returned Discard: it only got to t = 0.2 s"),
        (3, "step_discards", "fmi3DoStep returned Discard"),
        (2, "step_error", "fmi2DoStep returned Error"),
        (3, "step_error", "fmi3DoStep returned Error"),
        (2, "step_fatal", "fmi2DoStep returned Fatal"),
        (3, "step_fatal", "fmi3DoStep returned Fatal"),
        (3, "step_stops", "asks to end the simulation (terminateSimulation)"),
        (3, "step_early", "fmi3DoStep returned early, at t = 0.225 s"),
    ],
)
def test_failing_steps(opened: Open, fmi: int, fails: str, said: str) -> None:
    component = initialised(opened(fmi, CS, fails=fails, label="the arm"))
    with pytest.raises(ComponentError) as caught:
        component.step(0.2, 0.1)
    assert caught.value.message == said
    if "returned" in said and "early" not in said:
        status = said.split()[2].rstrip(":")
        assert caught.value.log == f"[{status}] the arm gives up at t = 0.2"


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_discarded_step_leaves_the_instance_usable(opened: Open, fmi: int) -> None:
    component = initialised(opened(fmi, CS, fails="step_discards"))
    for _ in range(2):
        with pytest.raises(ComponentError, match="Discard"):
            component.step(0.0, 0.1)
    assert get(component, "x") == [1.0]


@pytest.mark.parametrize("fails", ["step_error", "step_fatal"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_nothing_is_called_after_a_failure(opened: Open, fmi: int, fails: str) -> None:
    component = initialised(opened(fmi, CS, fails=fails))
    with pytest.raises(ComponentError, match="DoStep returned"):
        component.step(0.0, 0.1)
    with pytest.raises(ComponentError, match="has failed or ended"):
        get(component, "x")
    component.terminate()


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        ("never_settles", "its discrete states did not settle within 100 updates at one instant"),
        ("update_stops", "asks to end the simulation (terminateSimulation)"),
        ("update_error", "returned Error"),
    ],
)
@pytest.mark.parametrize("fmi", [2, 3])
def test_failing_events(opened: Open, fmi: int, fails: str, said: str) -> None:
    component = initialised(opened(fmi, ME, fails=fails))
    assert component.update_discrete_states() == 0.03
    component.set_time(0.5)
    with pytest.raises(ComponentError) as caught:
        component.update_discrete_states()
    assert said in caught.value.message


@pytest.mark.parametrize("fmi", [2, 3])
def test_only_the_latest_lines_are_kept(opened: Open, fmi: int) -> None:
    component = initialised(opened(fmi, CS, fails="step_discards"))
    for i in range(2 * library.LOG_LINES):
        with pytest.raises(ComponentError):
            component.step(float(i), 0.1)
    assert len(component.log.lines) == library.LOG_LINES
    assert component.log.last == f"[Discard] probe gives up at t = {2 * library.LOG_LINES - 1}"


def test_instances_of_fmi2_have_logs_of_their_own(opened: Open) -> None:
    one, two = (initialised(opened(2, CS, fails="step_discards", label=label)) for label in ("one", "two"))
    for component in (one, two):
        with pytest.raises(ComponentError):
            component.step(0.0, 0.1)
    assert one.log.last == "[Discard] one gives up at t = 0"
    assert two.log.last == "[Discard] two gives up at t = 0"


def test_nothing_is_printed(opened: Open, capfd: pytest.CaptureFixture[str]) -> None:
    for fmi in (2, 3):
        with pytest.raises(ComponentError):
            initialised(opened(fmi, CS, fails="step_error")).step(0.0, 0.1)
    assert capfd.readouterr() == ("", "")


def test_threads_open_and_step_side_by_side(probes: dict[int, Path]) -> None:
    results: list[float] = []

    def work() -> None:
        component = initialised(open_fmu("probe", probes[3], CS, describe(probes[3])))
        component.step(0.0, 0.1)
        results.extend(get(component, "x"))
        component.terminate()

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [2.0] * 8


# --- the temporary folder -------------------------------------------------------------------------------------------
SCRIPT = """
import sys, tempfile
from pathlib import Path
import fmus
from cosim.components.component import Interface
from cosim.components.fmu import describe, open_fmu
path = fmus.path("TwoLinkArm")
components = [open_fmu("arm", path, Interface.CO_SIMULATION, describe(path)) for _ in range(3)]
(folder,) = Path(tempfile.gettempdir()).glob("cosim-*")
files = sorted(str(p.relative_to(folder)).split("/", 1)[1] for p in folder.glob("*/**/*") if p.is_file())
print(oct(folder.stat().st_mode & 0o777), files)
if sys.argv[1] == "fail":
    raise SystemExit("gone wrong")
"""


@pytest.mark.parametrize("ending", ["normal", "fail"])
def test_the_temporary_folder_is_private_and_removed(tmp_path: Path, ending: str) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, ending], env=environment, capture_output=True, text=True, check=False
    )
    library = f"binaries/{fmpy.platform_tuple}/TwoLinkArm{fmpy.sharedLibraryExtension}"
    assert result.stdout.split(" ", 1)[1].strip() == repr([library]), result.stderr
    assert os.name == "nt" or result.stdout.startswith("0o700 ")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_member_is_refused_when_unpacked(probe_library: Path, tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3(), {"resources/data.txt": "some data"})
    path.write_bytes(path.read_bytes().replace(b"some data", b"some dada"))
    with pytest.raises(ConfigError, match="cannot be unpacked: Bad CRC"):
        library.open_library(library.read(path), Interface.CO_SIMULATION)


OPEN = """
import fmus, os, signal
from cosim.components import fmu
from cosim.components.component import Interface
path = fmus.path("TwoLinkArm")
arm = fmu.open_fmu("arm", path, Interface.CO_SIMULATION, fmu.describe(path))
print(os.listdir(os.environ["TMPDIR"]), flush=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="there an open file cannot be removed")
def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}

    def run(ending: str) -> subprocess.Popen[str]:
        return subprocess.Popen([sys.executable, "-c", OPEN + ending], env=environment, text=True, stdout=PIPE)

    with run("signal.pause()") as alive:
        assert alive.stdout is not None
        (living,) = ast.literal_eval(alive.stdout.readline())
        with run("os.kill(os.getpid(), signal.SIGKILL)") as killed:
            output, _ = killed.communicate(timeout=60)
        assert killed.returncode < 0
        assert len(ast.literal_eval(output)) == 2
        with run("") as next_one:
            output, _ = next_one.communicate(timeout=60)
        assert living in ast.literal_eval(output), "a living process keeps its folder"
        assert [path.name for path in tmp_path.iterdir()] == [living]
        alive.kill()
