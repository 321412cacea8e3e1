"""The folder of a run: a new one for it, and one that can be read however the run ended."""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cosim.errors import ClusterError, CosimError, NetworkError, OverrunError, RunError
from cosim.logs import LOG_FOLDER
from cosim.recording.manifest import folder_problem
from cosim.recording.recorder import Recorder


@contextmanager
def run_folder(name: str, out: Path | None) -> Iterator[Path]:
    """`out`, or a new `runs/<name>/<timestamp>` below the current folder; a second run in one second gets a number.

    A new one is made at once, so that nobody else takes it, and is gone afterwards if nothing is in it.

    Raises:
        ConfigError: it cannot be made.
    """
    if out is not None:
        yield out
        return
    stamp = time.strftime("%Y-%m-%dT%H-%M-%S")
    for i in itertools.count():
        folder = Path("runs") / name / (f"{stamp}-{i}" if i else stamp)
        try:
            folder.mkdir(parents=True)
            break
        except FileExistsError as error:
            if not folder.exists():  # a file is where a folder should be
                raise folder_problem(folder, f"cannot make the run folder: {error.strerror}; try --out") from None
        except OSError as error:
            raise folder_problem(folder, f"cannot make the run folder: {error.strerror}; try --out") from None
    try:
        yield folder
    finally:
        with suppress(OSError):
            os.removedirs(folder)


def close_interrupted(recorder: Recorder, tick: int, period: float) -> None:
    """Leave a readable run folder behind a request to stop.

    Args:
        recorder: of the run.
        tick: that was reached; below 0 before the first one.
        period: T in seconds.
    """
    reached = "before the first tick" if tick < 0 else f"at t = {tick * period:.9g} s"
    with suppress(CosimError):
        recorder.close(f"aborted: interrupted {reached}")
    print(f"interrupted {reached}; everything until then is in {recorder.folder}", file=sys.stderr)


def close_after(error: BaseException, recorder: Recorder) -> None:
    """Leave a readable run folder behind a failure."""
    reason = str(error) if isinstance(error, CosimError) else f"{type(error).__name__}: {error}"
    with suppress(CosimError):  # the first failure is the one to tell
        recorder.close(f"aborted: {(reason.splitlines() or [type(error).__name__])[0]}")
    if isinstance(error, (RunError, ClusterError, NetworkError, OverrunError)):
        print(f"everything until then is in {recorder.folder}", file=sys.stderr)
    if isinstance(error, RunError):
        _point_to_logs(recorder)


def _point_to_logs(recorder: Recorder) -> None:
    """They may say more than the error does."""
    if (recorder.place / LOG_FOLDER).exists():
        print(f"what components logged and printed is in {recorder.folder / LOG_FOLDER}", file=sys.stderr)


class Keeper:
    """What a run leaves that is ended by force."""

    recorder: Recorder | None = None
    """Once it is open."""

    def keep(self, error: CosimError, *, in_order: bool) -> None:
        if self.recorder is None:
            return
        folder = self.recorder.folder
        if in_order:
            close_after(error, self.recorder)
            if isinstance(error, RunError):
                return
            print(f"everything until then is in {folder}", file=sys.stderr)
        else:
            print(f"`cosim report {folder}` saves what was computed until then", file=sys.stderr)
        _point_to_logs(self.recorder)
