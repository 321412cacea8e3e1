"""A run folder whose process was killed is made whole: all that it had recorded becomes readable.

Whatever is interrupted here can be done again: the folder changes its status last.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import ConfigError
from cosim.recording import spool
from cosim.recording.atomic import remove_left, write_atomically
from cosim.recording.external import convert
from cosim.recording.lock import RECOVERY, RUN, FolderLock, Held, look
from cosim.recording.manifest import (
    DELIVERIES,
    HIDDEN,
    MANIFEST,
    RESERVE,
    TRAJECTORIES,
    Status,
    folder_problem,
    to_json,
    with_outcome,
)
from cosim.recording.table import indices, numbers
from cosim.recording.tables import FATE_NAMES, Layout, RunTables
from network.units import to_seconds

KILLED = "the process that recorded it was killed"
"""What the manifest says of such a run."""

_RECOVERY_SECONDS = 600.0
_POLL_SECONDS = 0.02


def recover(folder: Path, patience: float = 0.0) -> Mapping[str, Any]:
    """Bring a run folder in order if its process left it without doing so. If several try at once, one does it.

    Args:
        folder: with a manifest.
        patience: seconds to wait for a process that is about to end.

    Returns:
        The manifest, which says `running` no more.

    Raises:
        ConfigError: the run goes on; or it cannot be recovered, and nothing is lost by having tried.
    """
    if sys.platform == "win32":
        raise _still_running(folder)
    try:
        lock = _lock(folder, patience)
    except Held:
        raise _still_running(folder) from None
    except OSError as error:
        raise _refusal(folder, error) from None
    try:
        manifest: Mapping[str, Any] = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        convert(folder)
        if manifest["status"] == Status.RUNNING:
            manifest = _rebuild(folder, manifest)
        for name in HIDDEN:
            (folder / name).unlink(missing_ok=True)
        remove_left(folder / MANIFEST)
    except (OSError, ValueError) as error:
        raise _refusal(folder, error) from None
    finally:
        lock.release()
    return manifest


def tidy(folder: Path) -> None:
    """Remove what a process left that was killed at the very end."""
    with contextlib.suppress(ConfigError):
        recover(folder)


def occupied(folder: Path) -> str:
    """Why a folder that is not empty takes no new run."""
    try:
        look(folder)  # before the manifest, which a run that begins writes last
        status = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["status"]
    except Held:
        return "a run is being recorded here; choose another folder with --out"
    except (OSError, ValueError, LookupError, TypeError):
        return "the folder is not empty; remove it, or choose another one with --out"
    held = f"a run ({status})"
    if status == Status.RUNNING:
        held = f"a run whose process was killed (`cosim report {folder}` recovers what it had recorded)"
    return f"the folder holds {held}; remove it, or choose another one with --out"


def _lock(folder: Path, patience: float) -> FolderLock:
    """Hold the folder, after a recovery that is under way."""
    began = time.monotonic()
    while True:
        try:
            return FolderLock(folder, RECOVERY)
        except Held as held:
            if time.monotonic() - began > (patience if held.purpose == RUN else _RECOVERY_SECONDS):
                raise
        time.sleep(_POLL_SECONDS)


def _rebuild(folder: Path, manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """Move the spool to the tables, end these, and say so."""
    left = spool.read(folder)
    (folder / RESERVE).unlink(missing_ok=True)  # for this
    tables = RunTables(folder, left.layout, left.finished)
    try:
        tables.append(left.values, left.fates)
        tables.check()
        tables.close()
    except BaseException:
        tables.abandon()
        raise
    reached = to_seconds((tables.ticks - 1) * left.layout.period_ns)
    until = f"; recorded until t = {reached:.9g} s" if tables.ticks else " before the first tick"
    status = f"{Status.ABORTED}: {KILLED}{until}"
    manifest = with_outcome(manifest, status, tables.ticks, digest=digest_of(folder, left.layout))
    write_atomically(folder / MANIFEST, to_json(manifest))
    return manifest


def digest_of(folder: Path, layout: Layout) -> str:
    """The digest of what the tables hold."""
    import pyarrow.parquet as pq

    digest, columns, n_agents = layout.digest(), layout.columns, len(layout.agents)
    with pq.ParquetFile(folder / TRAJECTORIES) as file:
        for group in range(file.num_row_groups):
            table = file.read_row_group(group, columns=list(columns.names), use_threads=False)
            n_ticks = file.metadata.row_group(group).num_rows // n_agents
            values = np.empty((n_ticks, columns.width))
            for name, positions in zip(columns.names, columns.positions, strict=True):
                recorded = positions >= 0
                values[:, positions[recorded]] = numbers(table.column(name)).reshape(n_ticks, n_agents)[:, recorded]
            digest.rows(values)
    agents = {name: i for i, name in enumerate(layout.agents)}
    fates = {name: i for i, name in enumerate(FATE_NAMES)}
    with pq.ParquetFile(folder / DELIVERIES, read_dictionary=["sender", "receiver", "fate"]) as file:
        for group in range(file.num_row_groups):
            table = file.read_row_group(group, use_threads=False)
            names = indices(table.column("sender"), agents), indices(table.column("receiver"), agents)
            times = [numbers(table.column(name)) for name in ("stamp", "sent", "arrival_ns")]
            digest.fates(np.stack([*names, *times, indices(table.column("fate"), fates)], axis=1))
    return digest.hexdigest()


def _still_running(folder: Path) -> ConfigError:
    return folder_problem(folder, "the run is still going on; there is nothing to read yet")


def _refusal(folder: Path, error: OSError | ValueError) -> ConfigError:
    reason = (error.strerror if isinstance(error, OSError) else None) or error
    where = Path(getattr(error, "filename", None) or folder)
    return folder_problem(where, f"the run's process was killed, and what it recorded cannot be recovered: {reason}")
