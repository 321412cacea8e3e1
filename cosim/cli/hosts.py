"""The commands of a run whose processes are started by hand, on several hosts; part of `cosim.cli`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

SERVE_EXIT_CODES = """\
exit codes:
  0    the run is complete
  2    a mistake in the scenario or on the command line
  3    somebody did not come, was lost or left the run, or a component failed
  130  stopped with Ctrl-C (143: by SIGTERM, 129: by SIGHUP); all others are sent home
"""
EXIT_CODES = """\
exit codes:
  0    the run is complete
  2    a mistake on the command line, or the orchestrator refuses: it says why
  3    the run failed, the orchestrator does not come, is gone, or ended the run before its end
  130  stopped with Ctrl-C (143: by SIGTERM)
"""


def serve(args: argparse.Namespace) -> int:
    """`cosim serve`."""
    from cosim.distributed import hosting

    return hosting.main(args)


def join(args: argparse.Namespace) -> int:
    """`cosim emulator` and `cosim worker`."""
    from cosim.distributed import joining

    return joining.main(args)


def add_place(parser: argparse.ArgumentParser, seconds: Callable[[str], float], default_wait: str) -> None:
    """Where the processes meet."""
    parser.add_argument("--run", default="run", metavar="NAME", help="name of the run (default: %(default)s)")
    parser.add_argument("--namespace", metavar="NAME", help="keeps apart those who share a router")
    parser.add_argument("--keys", type=Path, metavar="FOLDER", help="keys of this process, from cosim keys issue")
    parser.add_argument("--insecure", action="store_true", help="do without keys where others can reach this")
    parser.add_argument(
        "--wait",
        type=seconds,
        default=default_wait,
        metavar="TIME",
        help="how long to wait for others (default: %(default)s)",
    )


def add_router(parser: argparse.ArgumentParser) -> None:
    """What `keys router` takes."""
    parser.add_argument("workers", nargs="+", metavar="WORKER", help="names of the workers that may come")
    parser.add_argument(
        "--listen", required=True, metavar="ENDPOINT", help="where the router listens, such as tls/0.0.0.0:7447"
    )
    parser.add_argument("--namespace", metavar="NAME", help="the runs that it carries (default: those without one)")
    parser.add_argument(
        "--keys",
        type=Path,
        default=Path("keys") / "router",
        metavar="FOLDER",
        help="keys of the router, from cosim keys issue (default: %(default)s)",
    )
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="default: print it")
    parser.set_defaults(action="router")


def add_guest(parser: argparse.ArgumentParser, seconds: Callable[[str], float], role: str) -> None:
    """What `emulator` and `worker` have in common."""
    parser.epilog = EXIT_CODES
    parser.set_defaults(role=role)
    parser.add_argument(
        "--connect",
        required=True,
        metavar="ENDPOINT",
        help="where cosim serve listens, or your Zenoh router, such as tls/lab-a:7447, tcp/127.0.0.1:7447",
    )
    add_place(parser, seconds, "10 min")
    parser.add_argument(
        "--files", type=Path, metavar="FOLDER", help="FMUs that are here and need not, or may not, travel"
    )
