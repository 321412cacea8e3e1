"""Opening many instances of one FMU: time, memory and extractions, beside a loop in C that does nothing else.

    python -m benchmarks.instances [FMU ...] [--number 1000] [--repetitions 3] [--json]

Every measurement is a process of its own. `bare C` instantiates and initialises the FMU's library by hand
(instances.c, compiled on the spot); `component` opens and initialises netcosim's components; `agent` the agents of a
scenario, one component each, with all that a run needs of them: signals, wiring, the native loop. Memory is what the
process grows by, per instance, after the first; medians. Linux only.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmus
from fmus.build import ROOT, compile_shared, library_suffix

FMUS = ("TwoLinkArm.fmi2", "TwoLinkArm.fmi3", "ArmSyncController.fmi3")
INTERFACES = ("co-simulation", "model-exchange")
ALLOWED_FACTOR, ALLOWED_BYTES = 1.3, 20_000
"""What netcosim may need of an instance: this many times what bare C does, and this much."""


def resident() -> int:
    """Memory of the process in bytes."""
    import resource

    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def bare(path: Path, interface: str, number: int, library: str) -> dict[str, float]:
    """By hand in C."""
    from cosim.components.component import Interface
    from cosim.components.fmu.library import open_library, read

    file = read(path)
    model = open_library(file, Interface(interface))  # extracted and loaded once
    function = ctypes.CDLL(library).bare_instances
    function.restype = ctypes.c_long
    shared = str(model.dll._name).encode()
    begin = time.perf_counter()
    grown = function(shared, model.guid.encode(), file.fmi, int(interface == "model-exchange"), number)
    if grown < 0:
        raise RuntimeError(f"{path.name} refuses")
    return {"seconds": time.perf_counter() - begin, "bytes": grown / number}


def components(path: Path, interface: str, number: int, _library: str) -> dict[str, float]:
    """Netcosim's components."""
    from cosim.components.component import Interface
    from cosim.components.fmu import describe, open_fmu

    description = describe(path)

    def opened() -> Any:
        component = open_fmu("instance", path, Interface(interface), description)
        component.enter_initialization(0.0, 1.0)
        component.exit_initialization()
        return component

    return grown(opened, number)


def agents(path: Path, interface: str, number: int, _library: str) -> dict[str, float]:
    """Netcosim's agents; planning is not counted."""
    from cosim.agents.group import Agents
    from cosim.planning import plan
    from cosim.scenario.reading import read_scenario

    method = "joint" if interface == "model-exchange" else "gauss-seidel"
    record = {"components": {"plant": {"fmu": str(path)}}, "coupling": {"method": method}, "record": []}

    def planned(n: int, folder: str) -> Any:
        tree = {"name": "many", "seed": 1, "period": "100 ms", "duration": "1 s", "agents": {f"1..{n}": record}}
        file = Path(folder) / "many.yaml"
        file.write_text(json.dumps(tree))
        return plan(read_scenario(file)).plan

    with tempfile.TemporaryDirectory() as folder:
        few, many = planned(1, folder), planned(number, folder)
    kept = Agents(few)
    kept.initialise()

    def opened() -> Any:
        live = Agents(many)
        live.initialise()
        return live

    measured = grown(opened, 1)
    return measured | {"bytes": measured["bytes"] / number}


def grown(opened: Callable[[], Any], number: int) -> dict[str, float]:
    """Seconds and bytes per call, and how often an FMU was extracted meanwhile."""
    from cosim.components.fmu.library import loading

    extractions: list[Path] = []
    unpack = loading.unpack

    def counted(*arguments: Any) -> Path:
        extractions.append(unpack(*arguments))
        return extractions[-1]

    loading.unpack = counted  # type: ignore[attr-defined]
    before_first = opened() if number > 1 else None
    memory, begin = resident(), time.perf_counter()
    live = [opened() for _ in range(number)]
    seconds, memory = time.perf_counter() - begin, resident() - memory
    del live, before_first
    return {"seconds": seconds, "bytes": memory / number, "extractions": float(len(extractions))}


KINDS = {"bare C": bare, "component": components, "agent": agents}


def measure(kind: str, path: Path, interface: str, number: int, library: str) -> dict[str, float]:
    """In a process of its own."""
    arguments = ["--measure", kind, str(path), interface, library, "--number", str(number)]
    command = [sys.executable, "-m", "benchmarks.instances", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def compare(path: Path, interface: str, number: int, repetitions: int, library: str) -> dict[str, Any]:
    """Medians of all kinds, and whether the memory is what it may be."""
    runs = {kind: [measure(kind, path, interface, number, library) for _ in range(repetitions)] for kind in KINDS}
    row: dict[str, Any] = {"fmu": path.stem, "interface": interface}
    for kind, found in runs.items():
        row[f"{kind}, s"] = statistics.median(one["seconds"] for one in found)
        row[f"{kind}, kB"] = statistics.median(one["bytes"] for one in found) / 1e3
    row["allowed, kB"] = ALLOWED_FACTOR * row["bare C, kB"] + ALLOWED_BYTES / 1e3
    row["extractions"] = max(one["extractions"] for one in runs["component"])
    return row


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fmus", nargs="*", type=Path)
    parser.add_argument("--number", type=int, default=1000)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--measure", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        kind, path, interface, library = arguments.measure
        print(json.dumps(KINDS[kind](Path(path), interface, arguments.number, library)))
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        library = Path(folder) / f"bare{library_suffix()}"
        compile_shared([Path(__file__).with_suffix(".c")], library, includes=[ROOT / "include"])
        paths = arguments.fmus or [fmus.path(name) for name in FMUS]
        rows = [
            compare(path.resolve(), interface, arguments.number, arguments.repetitions, str(library))
            for path in paths
            for interface in INTERFACES
        ]
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    print(f"{arguments.number} instances, medians of {arguments.repetitions}")
    names = list(rows[0])
    print(f"| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for row in rows:
        print(f"| {' | '.join(f'{row[n]:.3g}' if isinstance(row[n], float) else row[n] for n in names)} |")


if __name__ == "__main__":
    main()
