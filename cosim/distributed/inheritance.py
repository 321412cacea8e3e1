"""What becomes of the run folder when the orchestrator, which writes it, is killed: the emulator brings it in order.

The orchestrator leaves word of the folder among the run's temporary files before it starts any process.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

from cosim.distributed.assignment import EMULATOR
from cosim.errors import CosimError

EXIT_ORPHANED = 4
"""Exit code of a process whose orchestrator is gone."""

EXIT_OUTSIDE = 5
"""Exit code of a process that could not join its run."""

_WORD = "run-folder"
_LOCK_SECONDS = 10.0  # in which the system closes the files of a process that it has killed
_RECOVERY_SECONDS = 120.0


def leave_word(scratch: Path, folder: Path) -> None:
    """Say which folder the run writes."""
    (scratch / _WORD).write_bytes(os.fsencode(folder.absolute()))


def bequest(scratch: Path, name: str) -> Path | None:
    """The folder that the process of this name inherits, if any."""
    return run_folder(scratch) if name == EMULATOR else None


def run_folder(scratch: Path) -> Path | None:
    """The folder that the run writes, if there is word of it."""
    word = scratch / _WORD
    return Path(os.fsdecode(word.read_bytes())) if word.exists() else None


def inherit(folder: Path, exit_code: int) -> None:
    """Bring the folder in order, or end the process after a while. Whoever reads the folder later can still do it."""
    from cosim.recording.recovery import KILLED, recover

    deadline = threading.Timer(_RECOVERY_SECONDS, os._exit, (exit_code,))
    deadline.daemon = True
    deadline.start()
    try:
        status = recover(folder, _LOCK_SECONDS)["status"]
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
    else:
        if KILLED in status:
            print(f"{status.partition(': ')[2]}; everything until then is in {folder}", file=sys.stderr, flush=True)
    deadline.cancel()
