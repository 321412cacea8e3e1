"""The process `cosim`: a command is run, its errors are printed, and it ends with an exit code."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

from cosim.cli.parser import make_parser
from cosim.cli.printing import print_problems
from cosim.errors import ConfigError, CosimError
from cosim.screen import discard, is_gone, prepare


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; no error that a user can cause gives a traceback.

    Args:
        arguments: those of the process by default.

    Returns:
        The exit code.
    """
    args = make_parser().parse_args(arguments)
    previous = {number: signal.signal(number, _terminate) for number in _end_requests()}
    try:
        code: int = args.command(args)
        sys.stdout.flush()
    except ConfigError as error:
        print_problems(error.problems)
        return error.exit_code
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except OSError as error:
        if error.filename is not None:
            raise
        gone = is_gone(sys.stdout, error)
        if isinstance(error, BrokenPipeError) and not gone:
            raise
        discard(sys.stdout)  # or Python would try again at exit
        if gone:  # whoever read it has seen enough
            return 0
        print(f"error: cannot write the output: {error.strerror}", file=sys.stderr)
        return CosimError.exit_code
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    return code


def command() -> NoReturn:
    """The process `cosim`: `main`, and its end."""
    prepare()
    try:
        code = main()
    except SystemExit as asked:
        if isinstance(asked.code, str):
            raise
        code = asked.code or 0
    if "cosim.components.fmu.library" in sys.modules:
        from cosim.spawning import leave

        leave(code)
    sys.exit(code)


def _end_requests() -> list[int]:
    """The signals that ask for an end; what `nohup` has told this process to ignore, it goes on to ignore."""
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


def _terminate(number: int, _: FrameType | None) -> NoReturn:
    """End through Python, so that temporary folders are removed, with the code that the signal would have given."""
    sys.exit(128 + number)
