"""Both loops over FMUs whose states a structural parameter sizes, mapped or not: the same digest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cosim.cli import main

AXES = Path(__file__).parents[1] / "accuracy" / "axes.yaml"


def digest(scenario: str, out: Path, *settings: str) -> str:
    command = ["run", scenario, "--out", str(out), "--until", "1 s", "--quiet", "--no-report"]
    assert main([*command, *(part for setting in settings for part in ("--set", setting))]) == 0
    return str(json.loads((out / "manifest.json").read_text(encoding="utf-8"))["digest"])


@pytest.mark.parametrize(
    "scenario", [str(AXES), "mixed_plants", "consensus"], ids=["axes", "mixed_plants", "consensus"]
)
@pytest.mark.parametrize(("method", "step"), [("joint", "10 ms"), ("midpoint", "2 ms")])
def test_loops_agree(scenario: str, method: str, step: str, tmp_path: Path) -> None:
    settings = f"coupling.method={method}", f"coupling.step={step}"
    native = digest(scenario, tmp_path / "native", *settings)
    assert native == digest(scenario, tmp_path / "python", *settings, "coupling.loop=python")
