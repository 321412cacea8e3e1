"""Micro steps per second of the native loop, of one written by hand in C, of the loop in Python through FMPy, and of
that loop with the plant in a process of its own.

    python -m benchmarks.coupling [--repetitions 15] [--json]

All advance one arm with its controller (FMI 3.0) and make the same FMI calls; before they are timed, their
results are compared bit by bit. Medians of interleaved repetitions; ratios are medians of the repetitions' ratios.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np

import fmus
from cosim.agents.coupling import PythonLoop
from cosim.agents.mailbox import Updates
from cosim.agents.memory import LoopMemory
from cosim.agents.wiring import wire
from cosim.components.component import Component, Floats
from cosim.components.fmu import FmuComponent
from cosim.components.opening import await_open, describe, open_components
from cosim.kernel import Member, NativeBlock
from cosim.plan import AgentPlan, ComponentPlan, Connection, CouplingPlan, Isolation, MailboxPlan, Method, Port
from fmus.build import ROOT, compile_shared, library_suffix
from network.messages import Mail, MessageLayout
from network.units import to_seconds

PERIOD_NS = 100_000_000
COUPLINGS = {
    "joint, Runge-Kutta 4, 5 ms": CouplingPlan(Method.JOINT, 5_000_000),
    "Co-Simulation (gauss-seidel), 1 ms": CouplingPlan(Method.GAUSS_SEIDEL, 1_000_000),
}
TICKS = {"bare C": 200, "native loop": 200, "Python loop": 2, "plant isolated": 2}
CALLS = (
    *("SetTime", "SetContinuousStates", "GetContinuousStates", "GetContinuousStateDerivatives"),
    *("CompletedIntegratorStep", "EnterEventMode", "UpdateDiscreteStates", "EnterContinuousTimeMode"),
    *("DoStep", "GetFloat64", "SetFloat64"),
)
_NONE = np.empty(0, np.int64)
NO_UPDATES = Updates([0, 0], [], [], np.empty((0, 2)))
NO_MAIL = Mail(np.zeros(2, np.int64), _NONE, _NONE, _NONE, np.empty((0, 0)))


class Fmu(ctypes.Structure):
    """See coupling.c."""

    _fields_ = (("instance", ctypes.c_void_p), ("calls", ctypes.c_void_p * len(CALLS)))


class Pair(ctypes.Structure):
    """See coupling.c."""

    _fields_ = (
        ("arm", Fmu),
        ("controller", Fmu),
        ("references", ctypes.c_uint32 * 6),
        ("p_v", ctypes.c_double * 4),
        ("u", ctypes.c_double * 2),
    )


def plan(coupling: CouplingPlan, isolation: Isolation | None = None) -> AgentPlan:
    """An agent that hears nobody and is heard by nobody; its plant in a process of its own, if so wished."""

    def component(name: str, model: str, structural: dict[str, int]) -> ComponentPlan:
        path = fmus.path(model)
        description = describe(path, None, structural)
        start = {"p": (0.5, -0.8)} if name == "plant" else {name: (n,) for name, n in structural.items()}
        return ComponentPlan(name, path, None, description, start, isolation if name == "plant" else None)

    components = (
        component("plant", "TwoLinkArm", {}),
        component("controller", "ArmSyncController", {"n_neighbours": 0}),
    )

    def port(index: int, name: str) -> Port:
        return Port(index, components[index].description.variables[name])

    return AgentPlan(
        index=0,
        name="1",
        components=components,
        connections=(
            *(Connection(port(0, name), port(1, name)) for name in ("p", "v")),
            Connection(port(1, "u"), port(0, "u")),
        ),
        publish=(),
        mailbox=MailboxPlan({}, None, None, None),
        neighbours=(),
        weights=(),
        coupling=coupling,
        record=tuple((name, port(0, name)) for name in ("p", "v")),
    )


class Contestant:
    """One agent and one of the loops."""

    def __init__(self, name: str, coupling: CouplingPlan, library: ctypes.CDLL) -> None:
        agent = plan(coupling, Isolation(10_000_000_000) if name == "plant isolated" else None)
        layout = MessageLayout((), ())
        wiring = wire(agent, layout)
        self.components: list[Component] = open_components(agent)
        await_open(agent, self.components)
        memory = LoopMemory([(wiring.n_signals, 2)])
        python = PythonLoop(wiring, self.components, coupling, memory.state(0))
        python.initialise(0, 10**6 * PERIOD_NS)
        self.tick = 0
        self.steps_per_tick = PERIOD_NS // coupling.step_ns
        self._advance: Callable[[int, int], object]
        if name == "bare C":
            self._advance = self._bare(agent, library)
        elif name == "native loop":
            block = NativeBlock([Member(0, wiring, self.components, coupling)], memory, PERIOD_NS)
            self._advance = lambda start, _: block.advance(start // PERIOD_NS, 1, NO_MAIL)
        else:
            self._advance = lambda start, end: python.advance(start, end, NO_UPDATES)
        self._recorded = wiring.recorded

    def _bare(self, agent: AgentPlan, library: ctypes.CDLL) -> Callable[[int, int], object]:
        joint = agent.coupling.method is Method.JOINT
        function = library.bare_joint if joint else library.bare_steps
        function.argtypes = (ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int, ctypes.c_double)
        fmus_ = [self._native(cast(FmuComponent, component)) for component in self.components]
        names = [(0, "p"), (0, "v"), (0, "u"), (1, "p"), (1, "v"), (1, "u")]
        variables = [agent.components[c].description.variables[name] for c, name in names]
        references = (ctypes.c_uint32 * 6)(*(variable.references[0] for variable in variables))
        pair = self._pair = Pair(*fmus_, references)
        pair.u[:] = self.components[1].get(variables[5])
        n = self.steps_per_tick

        def advance(start_ns: int, end_ns: int) -> None:
            start, end, h = to_seconds(start_ns), to_seconds(end_ns), to_seconds(end_ns - start_ns) / n
            if not function(ctypes.addressof(pair), start, end, n, h):
                raise RuntimeError("an FMI call failed")

        return advance

    @staticmethod
    def _native(component: FmuComponent) -> Fmu:
        native = component.native()
        return Fmu(native.instance, (ctypes.c_void_p * len(CALLS))(*(native.address(f"fmi3{call}") for call in CALLS)))

    def advance(self, ticks: int) -> None:
        """Carry on for some periods."""
        for _ in range(ticks):
            self._advance(self.tick * PERIOD_NS, (self.tick + 1) * PERIOD_NS)
            self.tick += 1

    def result(self, agent: AgentPlan) -> Floats:
        """Angles and velocities of the arm."""
        return np.concatenate([self.components[0].get(port.variable) for _, port in agent.record])

    def close(self) -> None:
        """End the components."""
        for component in self.components:
            component.terminate()


def require_same_bits(coupling: CouplingPlan, library: ctypes.CDLL) -> None:
    """All loops give the same after ten periods."""
    results = set()
    for name in TICKS:
        contestant = Contestant(name, coupling, library)
        contestant.advance(10)
        results.add(contestant.result(plan(coupling)).tobytes())
        contestant.close()
    if len(results) != 1:
        raise RuntimeError("the loops give different results")


def measure(coupling: CouplingPlan, library: ctypes.CDLL, repetitions: int) -> dict[str, list[float]]:
    """Seconds per micro step of every loop, repetition by repetition."""
    contestants = {name: Contestant(name, coupling, library) for name in TICKS}
    seconds: dict[str, list[float]] = {name: [] for name in TICKS}
    for _ in range(repetitions + 1):  # the first is a warm-up
        for name, contestant in contestants.items():
            start = time.perf_counter()
            contestant.advance(TICKS[name])
            seconds[name].append((time.perf_counter() - start) / (TICKS[name] * contestant.steps_per_tick))
    for contestant in contestants.values():
        contestant.close()
    return {name: values[1:] for name, values in seconds.items()}


def ratio(above: Sequence[float], below: Sequence[float]) -> float:
    """Median of the ratios of measurements made one after the other."""
    return statistics.median(a / b for a, b in zip(above, below, strict=True))


def bare_library(folder: Path) -> ctypes.CDLL:
    """coupling.c, compiled as the kernel is."""
    output = folder / f"bare{library_suffix()}"
    compile_shared([Path(__file__).with_suffix(".c")], output, includes=[ROOT / "include"])
    return ctypes.CDLL(str(output))


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        library = bare_library(Path(name))
        for label, coupling in COUPLINGS.items():
            require_same_bits(coupling, library)
            seconds = measure(coupling, library, arguments.repetitions)
            rows.append(
                {
                    "coupling": label,
                    **{name: 1 / statistics.median(values) for name, values in seconds.items()},
                    "native / bare": ratio(seconds["native loop"], seconds["bare C"]),
                    "Python / native": ratio(seconds["Python loop"], seconds["native loop"]),
                }
            )
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    print(f"micro steps per second, median of {arguments.repetitions}; ratios of times")
    print(f"| coupling | {' | '.join(TICKS)} | native / bare | Python / native |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        speeds = " | ".join(f"{row[name]:,.0f}" for name in TICKS)
        print(f"| {row['coupling']} | {speeds} | {row['native / bare']:.2f} | {row['Python / native']:.0f} |")


if __name__ == "__main__":
    main()
