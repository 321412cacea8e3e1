"""The shipped arm as other tools would name its variables, and networks of it, mapped and unmapped."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import fmus
from cosim.plan import Plan
from tests.distributed.networks import Record, in_process
from tests.scenario.scenarios import BASE, changed, planned

NAMES = {
    "u[1]": "tau_shoulder",
    "u[2]": "tau_elbow",
    "p[1]": "q1",
    "p[2]": "q2",
    "v[1]": "qd1",
    "v[2]": "qd2",
}
"""What the other tool calls the arm's variables."""

PLANT = """\
        fmu: TwoLinkArm
        start: {p: {uniform: [-1, 1]}, v: 0}
"""
CONNECTIONS = """\
    connections:
      - plant.p -> controller.p
      - plant.v -> controller.v
      - controller.u -> plant.u
"""
MAPPED = """\
        fmu: other.fmu
        inputs: {u: [tau_shoulder, tau_elbow]}
        outputs: {p: [q1, q2], v: [qd1, qd2]}
        start: {p: {uniform: [-1, 1]}, v: 0}
"""


def renamed(path: Path, names: Mapping[str, str] = NAMES, fmu: str = "TwoLinkArm.fmi2") -> Path:
    """The FMU with other names, of variables or of units."""
    with zipfile.ZipFile(fmus.path(fmu)) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                text = content.decode()
                for old, new in names.items():
                    assert f'"{old}"' in text
                    text = text.replace(f'"{old}"', f'"{new}"')
                content = text.encode()
            target.writestr(name, content)
    return path


def network(folder: Path, *changes: tuple[str, str], loop: str = "native", method: str = "joint") -> Plan:
    """The network of `tests.scenario.scenarios`, changed."""
    step = "5 ms" if method == "joint" else "1 ms"
    coupling = ("method: joint, step: 5 ms", f"method: {method}, step: {step}, loop: {loop}")
    return planned(folder, changed(coupling, *changes, text=BASE)).plan


def played(folder: Path, *changes: tuple[str, str], loop: str = "native", method: str = "joint") -> Record:
    """What the network gives."""
    record, error = in_process(network(folder, *changes, loop=loop, method=method))
    assert error is None
    return record
