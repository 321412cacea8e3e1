"""Scenarios with a probe that does what an FMU must not, through the real command line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.components.probe import FAILS

ROOT = Path(__file__).parents[2]


def scenario(probe: Path, fails: str, isolate: str = "", method: str = "jacobi", fmi_label: str = "the probe") -> str:
    """Two agents, of which the second does from t = 0.35 s on what `fails` says; the first is only there."""
    return f"""\
name: misbehaving
period: 100 ms
duration: 1 s
templates:
  probe:
    components: {{probe: {{fmu: {probe}}}}}
    record: [probe.x]
agents:
  good: {{template: probe}}
  bad:
    template: probe
    components: {{probe: {{start: {{fails: {FAILS.index(fails)}, label: {fmi_label}}}{isolate}}}}}
coupling: {{method: {method}, step: 10 ms}}
"""


MEASURE = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
with open("largest", "w") as file:
    file.write(str(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss))
sys.exit(code)
"""
"""Runs a command, and leaves a file with the memory of its largest process in kB."""


def cosim(folder: Path, *arguments: str, text: str = "", measured: bool = False) -> subprocess.CompletedProcess[str]:
    """`cosim …` in `folder`, all its temporary files there too; `text` becomes net.yaml; `measured`: see `MEASURE`."""
    if text:
        (folder / "net.yaml").write_text(text, encoding="utf-8")
    (folder / "tmp").mkdir(exist_ok=True)
    return subprocess.run(
        [*([sys.executable, "-c", MEASURE] if measured else []), sys.executable, "-m", "cosim", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder / "tmp")},
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )


def digest(done: subprocess.CompletedProcess[str]) -> str:
    """That of a run that went well."""
    assert done.returncode == 0, done.stderr
    return next(line.split()[1] for line in done.stdout.splitlines() if line.strip().startswith("digest"))
