"""The arguments of every command, and what `--help` says of them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from cosim.cli import commands

if TYPE_CHECKING:
    from fractions import Fraction

_Parser = TypeVar("_Parser", bound=argparse.ArgumentParser)
EXIT_CODES = """\
exit codes:
  0    success
  2    a mistake in the scenario or on the command line
  3    a run failed: a component refused or broke down
  130  stopped with Ctrl-C (143: by SIGTERM, 129: by SIGHUP)
"""


class _Version(argparse.Action):
    """Looks the version up only when asked."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"cosim (netcosim {version('netcosim')})")
        parser.exit()


def make_parser() -> argparse.ArgumentParser:
    """That of `cosim`; a command's function is in `command`, and takes the arguments."""
    from cosim.cli import fmu as cli_fmu
    from cosim.cli import ssp as cli_ssp

    parser = argparse.ArgumentParser(
        prog="cosim",
        description="Co-simulation of networked multi-agent systems: FMUs, who hears whom, and what the network does.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    group = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    run = _command(group, "run", commands.run, "run a scenario and draw its report")
    _add_scenario(run)
    _add_results(run)
    run.add_argument(
        "--estimate-error",
        action="store_true",
        help="play it with half the micro steps first, and say how large the error of the coupling is",
    )
    across = run.add_argument_group("across processes, with the same results")
    across.add_argument("--distributed", action="store_true", help="run emulator and agents in processes of their own")
    across.add_argument(
        "--workers",
        metavar="N",
        help="processes that carry the agents, or 'per-agent' (default: the scenario's, else cores)",
    )
    across.add_argument(
        "--on-worker-loss",
        choices=("abort", "restart"),
        help="end the run, or replace a worker that is killed, ends or hangs (default: the scenario's, or abort)",
    )
    _add_step_deadline(run)

    check = _command(
        group, "check", commands.check, "validate a scenario, open its components, and say what can be expected"
    )
    _add_scenario(check)
    _add_step_deadline(check)

    report = _command(group, "report", commands.report, "draw the report of a finished run again")
    report.add_argument("run", type=Path, metavar="RUN", help="folder of the run")

    init = _command(group, "init", commands.init, "copy a shipped scenario, to start from")
    init.add_argument("name", metavar="NAME", help="the copy becomes NAME.yaml")
    init.add_argument(
        "--from",
        dest="source",
        metavar="CONFIG",
        default="paper_leaders",
        help="shipped scenario (default: %(default)s)",
    )

    _command(group, "schema", commands.schema, "print the JSON schema of a scenario, for editors")
    _add_channel(group)
    _add_keys(group)
    cli_fmu.add(group, _command, _seconds)
    cli_ssp.add(group, _command)
    _add_hosts(group)
    process = group.add_parser("_process")  # what `cosim run --distributed` starts; not for people
    process.add_argument("name")
    process.add_argument("run")
    process.add_argument("endpoint")
    process.add_argument("scratch", type=Path)
    process.set_defaults(command=commands.spawned)
    return parser


class _Intermixed(argparse.ArgumentParser):
    """Takes an argument that may be left out also after options."""

    _inside = False

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        if self._inside:
            return super().parse_known_args(args, namespace)
        self._inside = True
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._inside = False


def _add_channel(group: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    channel = _command(group, "channel", commands.channel, "play a channel alone: what would a controller get?")
    channel.add_argument(
        "profile",
        nargs="?",
        metavar="PROFILE",
        help="a shipped profile such as wifi_busy; a profile's file; SCENARIO:CHANNEL, such as mixed_network:bursts, "
        "with the edges of the run; or a channel as in a scenario, such as '{model: netem, delay: 20 ms, loss: 2 %%}'",
    )
    channel.add_argument(
        "--fit", type=Path, metavar="LOG", help="make a profile from a measured log: CSV, or what ping prints"
    )
    channel.add_argument(
        "--round-trip",
        action="store_true",
        help="the delays of the log are there and back, as ping's are by themselves",
    )
    channel.add_argument("--list", action="store_true", help="show the shipped profiles")
    channel.add_argument(
        "--explain",
        nargs="?",
        const="",
        metavar="PARAMETER",
        help="what a parameter means, such as gemodel or delay.jitter; without one, which there are",
    )
    played = channel.add_argument_group("how it is played (default: as in the scenario, where there is one)")
    played.add_argument("--ticks", type=int, metavar="N", help="messages per edge (default: 10000)")
    played.add_argument("--edges", type=int, metavar="N", help="that have the channel, independently (default: 1)")
    played.add_argument("--period", metavar="TIME", help="from one message to the next (default: 100 ms)")
    played.add_argument("--size", metavar="BYTES", help="of a message, where a rate is set (default: 32 B)")
    played.add_argument("--seed", type=int, metavar="N", help="default: 1")
    channel.add_argument(
        "--out", type=Path, metavar="DIR", help="where page and figures go (default: runs/channels/<name>)"
    )
    channel.add_argument(
        "--no-report", dest="report", action="store_false", help="leave out the figures and channel.html"
    )


def _add_keys(group: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    from cosim.cli import hosts as cli_hosts

    about = "make the keys with which processes on several hosts prove who they are"
    keys = group.add_parser("keys", help=about, description=f"{about[0].upper()}{about[1:]}.")
    actions = keys.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Intermixed)
    init = _command(actions, "init", commands.keys, "make a certificate authority for a team")
    issue = _command(actions, "issue", commands.keys, "issue the keys of a process")
    issue.add_argument("name", metavar="NAME", help="of the process, such as orchestrator, emulator, worker-1")
    issue.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="HOST",
        help="name or address at which others find a process that listens; repeatable",
    )
    issue.add_argument("--days", type=int, metavar="N", help="how long they are valid (default: a year)")
    show = _command(actions, "show", commands.keys, "say what keys there are, for which hosts, and until when")
    router = _command(actions, "router", commands.keys, "configure a Zenoh router that lets in a run's processes")
    cli_hosts.add_router(router)
    for action, command in ((init, "init"), (issue, "issue"), (show, "show")):
        action.add_argument(
            "folder", nargs="?", type=Path, default=Path("keys"), metavar="FOLDER", help="default: keys"
        )
        action.set_defaults(action=command)


def _factor(text: str) -> Fraction:
    from cosim.running.pacing import parse_factor

    try:
        return parse_factor(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _add_results(parser: argparse.ArgumentParser) -> None:
    """What `run` and `serve` have in common."""
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where the results go (default: runs/<name>/<timestamp>)"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but problems")
    parser.add_argument(
        "--no-report", dest="report", action="store_false", help="leave out the figures and report.html"
    )
    paced = parser.add_argument_group("against the wall clock, with the same results")
    paced.add_argument(
        "--realtime",
        type=_factor,
        nargs="?",
        const="1",
        metavar="FACTOR",
        help="simulated seconds per second of wall time (default: 1)",
    )
    paced.add_argument(
        "--overrun",
        choices=("warn", "abort", "stretch"),
        help="when a tick is complete only after its deadline: say so and catch up, end the run, or move the schedule "
        "(default: warn)",
    )


def _add_step_deadline(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    parser.add_argument(
        "--step-deadline",
        type=_seconds,
        default=30.0,
        metavar="TIME",
        help="longest time in which nobody gets further, such as '2 min' (default: 30 s)",
    )


def _add_hosts(group: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    from cosim.cli import hosts as cli_hosts

    serve = _command(
        group, "serve", cli_hosts.serve, "run a scenario with an emulator and workers that are started by hand"
    )
    serve.epilog = cli_hosts.SERVE_EXIT_CODES
    _add_scenario(serve)
    where = serve.add_mutually_exclusive_group(required=True)
    where.add_argument(
        "--listen", metavar="ENDPOINT", help="where the others connect to, such as tls/0.0.0.0:7447, tcp/127.0.0.1:7447"
    )
    where.add_argument("--connect", metavar="ENDPOINT", help="your own Zenoh router, where the others connect as well")
    cli_hosts.add_place(serve, _seconds, "10 min")
    serve.add_argument(
        "--workers",
        metavar="N",
        help="how many workers to suggest, or 'per-agent' (default: the scenario's, else cores)",
    )
    _add_results(serve)
    _add_step_deadline(serve)

    emulator = _command(group, "emulator", cli_hosts.join, "emulate the network of a run that cosim serve plays")
    cli_hosts.add_guest(emulator, _seconds, "emulator")
    worker = _command(group, "worker", cli_hosts.join, "carry agents of a run that cosim serve plays")
    cli_hosts.add_guest(worker, _seconds, "worker")
    worker.add_argument(
        "--agents",
        metavar="AGENTS",
        help="that this worker carries, such as 1..5 or 1,4..6; with --name alone, those that the scenario gives it",
    )
    worker.add_argument(
        "--name", metavar="NAME", help="of this worker (default: as its keys say, else made from the host's)"
    )


def _seconds(text: str) -> float:
    from network.units import parse_duration, to_seconds

    try:
        duration = parse_duration(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if duration <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} leaves no time")
    return to_seconds(duration)


def _command(group: argparse._SubParsersAction[_Parser], name: str, command: object, summary: str) -> _Parser:
    parser = group.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}{'' if summary.endswith('?') else '.'}",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(command=command)
    return parser


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    """What `run` and `check` have in common."""
    parser.add_argument("config", metavar="CONFIG", help="a YAML file, or a shipped scenario by its bare name")
    parser.add_argument("--seed", type=int, metavar="N", help="instead of the scenario's")
    parser.add_argument("--until", metavar="TIME", help="duration instead of the scenario's, such as '30 s'")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one value, such as coupling.step='1 ms' or agents.4.components.plant.start.v=0.1; repeatable",
    )
