"""The commands of `cosim fmu`; part of `cosim.cli`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

TEST_EXIT_CODES = """\
exit codes:
  0    no problems
  2    problems, or it cannot be tried out at all
"""


def add(commands: Any, command: Callable[..., argparse.ArgumentParser], seconds: Callable[[str], float]) -> None:
    """`cosim fmu` with all it can do."""
    fmu = commands.add_parser("fmu", help="work on FMU files", description="Work on FMU files.")
    actions = fmu.add_subparsers(title="commands", metavar="COMMAND", required=True)

    inspect = command(actions, "inspect", _inspect, "say what an FMU is, what it has, and what is wrong with it")
    inspect.add_argument("file", metavar="FILE", help="the FMU, or the name of a shipped one")
    inspect.add_argument("--all", action="store_true", help="local variables as well")

    wire = command(actions, "wire", _wire, "write a scenario of one agent around an FMU, to start from")
    wire.add_argument("file", metavar="FILE", help="the FMU, or the name of a shipped one")
    wire.add_argument("--role", default="plant", metavar="NAME", help="of the component (default: %(default)s)")
    wire.add_argument("-o", "--out", type=Path, metavar="OUT", help="the new file (default: standard output)")

    test = command(actions, "test", _test, "try out an FMU or a Python component, in a process of its own")
    test.add_argument(
        "target", metavar="FILE|CLASS", help="the FMU, the name of a shipped one, or package.module:Class"
    )
    test.add_argument(
        "--start",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="start value of a variable where its own will not do; repeatable",
    )
    test.add_argument(
        "--deadline", type=seconds, default=10.0, metavar="TIME", help="longest time of one check (default: 10 s)"
    )
    test.epilog = TEST_EXIT_CODES

    export = command(actions, "export", _export, "make an FMU of a Python component; takes the extra 'export'")
    export.add_argument("target", metavar="CLASS", help="package.module:Class")
    export.add_argument("-o", "--out", type=Path, metavar="OUT", help="the new file (default: <Class>.fmu, here)")
    export.add_argument(
        "--size",
        metavar="NAME=N",
        action="append",
        default=[],
        help="value of a structural parameter, which is fixed in the FMU; repeatable",
    )
    export.add_argument(
        "--with",
        dest="files",
        type=Path,
        metavar="PATH",
        action="append",
        default=[],
        help="a file or folder that the class needs as well, besides its own module or package; repeatable",
    )

    about = "write what an FMU says of itself, for others to plan with while the FMU stays"
    strip = command(actions, "strip", _strip, about)
    strip.add_argument("file", type=Path, metavar="FILE", help="the FMU")
    strip.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help="the new file (default: <name>.description.fmu, here)"
    )


def _inspect(args: argparse.Namespace) -> int:
    from cosim.fmu_commands import find
    from cosim.fmu_commands.inspecting import report

    print(report(find(args.file), everything=args.all))
    return 0


def _wire(args: argparse.Namespace) -> int:
    from cosim.components.fmu.archive import refuse
    from cosim.errors import ConfigError, Problem
    from cosim.fmu_commands.stub import scenario
    from cosim.scenario.spec import check_component

    try:
        check_component(args.role)
    except ValueError as error:
        raise ConfigError([Problem(f"--role: {error}")]) from None
    text = scenario(args.file, args.role, args.out.parent if args.out else Path())
    if args.out is None:
        print(text, end="")
        return 0
    try:
        with args.out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise refuse(args.out, "exists already; choose another name with -o or remove it") from None
    except OSError as error:
        raise refuse(args.out, f"cannot be written: {error.strerror}") from error
    print(f"wrote {args.out}; next: cosim check {args.out}")
    return 0


def _test(args: argparse.Namespace) -> int:
    import yaml

    from cosim.conformance import check
    from cosim.errors import ConfigError, Problem
    from cosim.fmu_commands import find

    start = {}
    for text in args.start:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigError([Problem(f"--start {text}: write NAME=VALUE")])
        start[name] = yaml.safe_load(value)
    target = args.target if ":" in args.target and not Path(args.target).exists() else find(args.target)
    report = check(target, start=start, deadline=args.deadline)
    print(report)
    return 2 if report.problems else 0


def _export(args: argparse.Namespace) -> int:
    from cosim.errors import ConfigError, Problem
    from cosim.fmu_commands.exporting import export

    sizes = {}
    for text in args.size:
        name, _, number = text.partition("=")
        if not name or not number.isdecimal():
            raise ConfigError([Problem(f"--size {text}: write NAME=N")])
        sizes[name] = int(number)
    out = export(args.target, args.out, sizes, args.files)
    print(f"wrote {out}: {args.target} as an FMU; next: cosim fmu test {out}")
    return 0


def _strip(args: argparse.Namespace) -> int:
    from cosim.components.fmu.stripping import write_stripped

    out = write_stripped(args.file, args.out)
    print(f"wrote {out}: what {args.file.name} says of itself, and its SHA-256")
    return 0
