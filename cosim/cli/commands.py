"""What each command does with its arguments. It imports what it needs when it runs, so that `cosim --help` is quick."""

from __future__ import annotations

import argparse
import gc
from pathlib import Path
from typing import NoReturn

from cosim.cli.printing import print_problems
from cosim.errors import ConfigError, Location, Problem


def run(args: argparse.Namespace) -> int:
    """Run a scenario."""
    gc.disable()  # until it begins: a start creates much and drops nothing
    try:
        from cosim.running import command

        return command.main(args)
    finally:
        gc.enable()


def spawned(args: argparse.Namespace) -> NoReturn:
    """Be a worker or the emulator of a run across processes."""
    gc.disable()  # until it is prepared
    from cosim.distributed import serving

    serving.main(args)


def report(args: argparse.Namespace) -> int:
    """Draw a run's report again."""
    from cosim.reporting import report

    return report.main(args)


def check(args: argparse.Namespace) -> int:
    """Validate a scenario and open its components."""
    from cosim import planning
    from cosim.running import check

    planned = planning.load(args.config, args.set, seed=args.seed, until=args.until)
    absent = check.open_all(planned.plan, args.step_deadline)
    print(check.describe(planned.plan))
    print_problems([*planned.warnings, *absent])
    return 0


def channel(args: argparse.Namespace) -> int:
    """Play a channel, fit one, or explain its parameters."""
    from cosim.channel import command

    return command.main(args)


def keys(args: argparse.Namespace) -> int:
    """Make or show keys."""
    from cosim import keys

    return keys.main(args)


def init(args: argparse.Namespace) -> int:
    """Copy a shipped scenario."""
    from cosim.scenario import configs
    from cosim.scenario.names import scenario_name

    source = configs.shipped(args.source)
    target = Path(args.name if args.name.endswith((".yaml", ".yml")) else f"{args.name}.yaml")
    try:
        scenario_name(target.stem)
    except ValueError as error:
        raise ConfigError([Problem(str(error))]) from None
    text = source.read_text(encoding="utf-8").replace(f"\nname: {source.stem}\n", f"\nname: {target.stem}\n", 1)
    beside = configs.companions(args.source)
    try:
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
        for path in beside:
            copy = target.parent / path
            if not copy.exists():
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes((source.parent / path).read_bytes())
    except FileExistsError:
        raise ConfigError(
            [Problem("exists already; choose another name or remove it", Location(str(target)))]
        ) from None
    except OSError as error:
        raise ConfigError([Problem(f"cannot be written: {error.strerror}", Location(str(target)))]) from None
    files = "".join(f" with {path}" for path in beside)
    print(f"wrote {target}, a copy of {source.stem}{files}; next: cosim check {target}")
    return 0


def schema(args: argparse.Namespace) -> int:  # noqa: ARG001 - as every command
    """Print the JSON schema of scenarios."""
    import json

    from cosim.scenario.spec import json_schema

    print(json.dumps(json_schema(), indent=2, ensure_ascii=False))
    return 0
