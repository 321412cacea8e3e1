"""Steps that are not done when the call returns: discarded, pending, or the last one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cosim.components.component import Interface
from cosim.components.fmu import FmuComponent, describe, fmi2, open_fmu
from cosim.errors import ComponentError, DiscardedStepError
from cosim.running.inline import run
from tests.accuracy.test_step_control import Accounted
from tests.components.probe import description2, description3, write_fmu
from tests.distributed.networks import planned

Open = Callable[[Path, str], FmuComponent]


@pytest.fixture
def opened() -> Iterator[Open]:
    """An initialised probe in Co-Simulation that fails in some way; x' = 10."""
    live: list[FmuComponent] = []

    def open_one(path: Path, fails: str) -> FmuComponent:
        description = describe(path)
        live.append(open_fmu("probe", path, Interface.CO_SIMULATION, description))
        live[-1].start(description.variables["fails"], (fails,))
        live[-1].enter_initialization(0.0, 1.0)
        live[-1].exit_initialization()
        return live[-1]

    yield open_one
    for one in live:
        one.terminate()


def x(probe: FmuComponent) -> float:
    return float(probe.get(probe.description.variables["x"])[0])


@pytest.fixture(scope="module")
def asynchronous(probe_library: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = description2().replace("<CoSimulation ", '<CoSimulation canRunAsynchronuously="true" ')
    return write_fmu(tmp_path_factory.mktemp("asynchronous") / "probe.fmu", probe_library, text)


# --- Discard ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_discarded_step_is_made_in_halves(opened: Open, probes: dict[int, Path], fmi: int) -> None:
    """The probe makes steps up to 3 ms; one that it discards has changed its state, which is restored."""
    probe = opened(probes[fmi], "step_discards_long")
    for i in range(5):
        probe.step_in_halves(0.01 * i, 0.01, 2)
        assert x(probe) == pytest.approx(1.0 + 0.1 * (i + 1), abs=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_halves_have_a_limit(opened: Open, probes: dict[int, Path], fmi: int) -> None:
    probe = opened(probes[fmi], "step_discards_long")
    with pytest.raises(DiscardedStepError, match=r"the shortest step that `retries` allows \(0.005 s\)"):
        probe.step_in_halves(0.0, 0.01, 1)


@pytest.mark.parametrize("fmi", [2, 3])
def test_other_failures_are_not_tried_again(opened: Open, probes: dict[int, Path], fmi: int) -> None:
    with pytest.raises(ComponentError, match="returned Error"):
        opened(probes[fmi], "step_error").step_in_halves(0.0, 0.01, 5)


@pytest.mark.parametrize("isolate", ["", ", isolate: true"])
@pytest.mark.parametrize(("fmi", "capability"), [(2, "canGetAndSetFMUstate"), (3, "canGetAndSetFMUState")])
def test_step_control_makes_a_discarded_step_shorter(
    fmi: int, capability: str, isolate: str, probe_library: Path, tmp_path: Path
) -> None:
    """The probe makes steps up to 3 ms; a step of the control is two of half the length, but also one of the whole."""
    text = description2() if fmi == 2 else description3()
    text = text.replace("modelIdentifier=", f'{capability}="true" modelIdentifier=')
    path = write_fmu(tmp_path / "probe.fmu", probe_library, text)
    plan = planned(
        "period: 100 ms\nduration: 500 ms\nagents:\n  1:\n"
        f"    components: {{probe: {{fmu: {path}, start: {{fails: step_discards_long}}{isolate}}}}}\n"
        "    record: [probe.x]\ncoupling: {method: midpoint, tolerance: 1e-6}\n"
    )
    seen = Accounted()
    run(plan, [seen])
    assert [row[0] for row in seen.rows] == pytest.approx([1.0 + k for k in range(6)])
    (account,) = seen.accounts
    assert account.longest <= 0.003
    assert account.rejected > 0


# --- Pending ----------------------------------------------------------------------------------------------------------
def test_a_pending_step_is_waited_for(opened: Open, asynchronous: Path) -> None:
    probe = opened(asynchronous, "step_pending")
    probe.step(0.0, 0.01)
    assert x(probe) == pytest.approx(1.1)


def test_a_pending_step_that_fails(opened: Open, asynchronous: Path) -> None:
    with pytest.raises(ComponentError, match="fmi2DoStep returned Error"):
        opened(asynchronous, "step_pending_error").step(0.0, 0.01)


def test_a_step_that_stays_pending(opened: Open, asynchronous: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fmi2, "PENDING_DEADLINE", 0.02)
    with pytest.raises(ComponentError, match=r"returned Pending, and its step is not done after 0.02 s"):
        opened(asynchronous, "step_pending_forever").step(0.0, 0.01)


def test_a_pending_step_that_was_not_announced(opened: Open, probes: dict[int, Path]) -> None:
    with pytest.raises(ComponentError, match="declares that it does not step asynchronously"):
        opened(probes[2], "step_pending").step(0.0, 0.01)


# --- the last one -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_component_that_asks_for_the_end(opened: Open, probes: dict[int, Path], fmi: int) -> None:
    """FMI 2.0 says so by Discard and the status `fmi2Terminated`."""
    with pytest.raises(ComponentError, match="asks to end the simulation"):
        opened(probes[fmi], "step_stops").step(0.0, 0.01)
