"""The commands of `cosim ssp`; part of `cosim.cli`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def add(commands: Any, command: Callable[..., argparse.ArgumentParser]) -> None:
    """`cosim ssp` with all it can do."""
    ssp = commands.add_parser("ssp", help="import SSP packages", description="Import SSP packages.")
    actions = ssp.add_subparsers(title="commands", metavar="COMMAND", required=True)
    action = command(actions, "import", _import, "write a scenario of one agent from an SSP package, FMUs included")
    action.add_argument("file", type=Path, metavar="FILE", help="the .ssp package, its folder, or an .ssd file in that")
    action.add_argument("-o", "--out", type=Path, metavar="OUT", help="the new scenario (default: <name>.yaml, here)")


def _import(args: argparse.Namespace) -> int:
    from cosim.ssp.importing import import_package
    from cosim.ssp.package import ROOT

    path = args.file.resolve()
    named = path.parent if path.name == ROOT else path
    out = args.out or Path(f"{named.name if named.is_dir() else named.stem}.yaml")
    (scenario, *fmus), warnings = import_package(args.file, out)
    for warning in warnings:
        print(warning, file=sys.stderr)
    print(f"wrote {scenario} and {len(fmus)} FMU{'' if len(fmus) == 1 else 's'}; next: cosim check {scenario}")
    return 0
