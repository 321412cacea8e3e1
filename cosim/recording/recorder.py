"""Writes a run folder: the manifest, the resolved scenario, the trajectories and the fate of every message.

Memory stays bounded: rows and fates are kept in blocks and written as Parquet row groups (`cosim.recording.table`). A
run of 60 s with ten agents is one block, so nothing but a copy of 1 kB happens per tick.

When the disk fills up, `tick` or `fates` raises `RecordingError`; the caller then closes the recorder like after any
other failure, and what was recorded stays readable.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import CosimError
from cosim.plan import EXTERNAL, Plan
from cosim.recording import manifest
from cosim.recording.atomic import write_atomically
from cosim.recording.external import LOG, ExternalLog, convert
from cosim.recording.lock import RUN, FolderLock, Held
from cosim.recording.manifest import (
    DELIVERIES,
    HIDDEN,
    MANIFEST,
    RESERVE,
    SCENARIO,
    TRAJECTORIES,
    Status,
    folder_problem,
)
from cosim.recording.recovery import occupied
from cosim.recording.spool import Spool, stacked
from cosim.recording.table import FULL, allocate
from cosim.recording.tables import Layout, RunTables
from network.messages import Fates, Floats, Ints
from network.units import to_seconds

BLOCK_BYTES = 16 << 20
"""Recorded numbers kept in memory, and about the size of a row group."""

FATES_AT_ONCE = 1 << 18
"""Fates kept in memory, likewise."""

_RESERVE_BYTES = 1 << 18


class RecordingError(CosimError):
    """The run folder takes no more. What it holds so far is readable."""

    exit_code = 3


class Recorder:
    """An observer of a run. The call order is `open`, then `tick` and `fates`, then `close`.

    Args:
        plan: what runs.
        folder: the run folder; it must not exist, or be empty.
        details: further entries for the manifest, such as the number of processes.
        block_bytes: how many bytes of rows to keep in memory. It changes the row groups, not the digest.

    Attributes:
        folder: as it was given.
        place: where that is, whichever folder an FMU makes the current one.
    """

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        details: Mapping[str, Any] | None = None,
        *,
        block_bytes: int = BLOCK_BYTES,
    ) -> None:
        self.folder = folder
        self.place = folder.absolute()
        self._plan = plan
        self._layout = Layout.of(plan)
        self._digest = self._layout.digest()
        self._details = dict(details or {})
        self._manifest: dict[str, Any] = {}
        self._started = 0.0
        self._start: float | None = None  # seconds until tick 0

        ticks_at_once = max(1, block_bytes // (8 * max(1, self._layout.width)))
        # One more than there are: the last tick, which may have a deadline, is not held up by writing.
        self._block = np.empty((min(ticks_at_once, plan.ticks + 2), self._layout.width))
        self._kept = 0  # rows of the block in use
        self._fates: list[Ints] = []
        self._waiting: list[Ints] = []  # those since the last tick, which go to the spool with the next
        self._n_fates = 0
        self._external: ExternalLog | None = None
        self._failure: RecordingError | None = None
        self._full: OSError | None = None  # for which the spool was given up

    def open(self) -> None:
        """Create the folder with a manifest of status `running`, and the scenario.

        Raises:
            ConfigError: the folder is not empty, or cannot be written.
        """
        self._started = time.perf_counter()
        self._manifest = manifest.begin(self._plan, self._layout.columns, self._details)
        try:
            self.place.mkdir(parents=True, exist_ok=True)
            if any(self.place.iterdir()):
                raise folder_problem(self.folder, occupied(self.place))
            with contextlib.ExitStack() as undo:
                self._create_files(undo)
                undo.pop_all()
        except Held:
            raise folder_problem(self.folder, occupied(self.place)) from None
        except OSError as error:
            where = self._shown(error.filename or self.place)
            raise folder_problem(where, f"cannot write the run folder: {error.strerror or error}") from None

    def add(self, details: Mapping[str, Any]) -> None:
        """Further entries for the manifest, or other ones; they are written when it is."""
        self._manifest |= details

    def tick(self, tick: int, row: Floats) -> None:
        """Record a tick.

        Args:
            tick: 0, 1, 2, … in order.
            row: agent by agent, its recorded scalars in the order of `AgentPlan.record`. It is copied.

        Raises:
            RecordingError: the disk is full.
        """
        self._check(tick)
        self._take_rows(row[None])

    def fates(self, fates: Fates) -> None:
        """Record fates, in their order.

        Raises:
            RecordingError: the disk is full.
        """
        if self._failure is not None:
            raise self._failure
        self._take_fates(_table(fates, 0, len(fates)))

    def course(self, first: int, rows: Floats, fates: Fates, counts: Sequence[int]) -> None:
        """Record ticks that follow each other, each with the fates of the period that it begins.

        Args:
            first: number of the first one.
            rows: (n_ticks, width) see `tick`. They are copied.
            fates: of all of them, one after the other.
            counts: of each tick, how many those are.

        Raises:
            RecordingError: the disk is full.
        """
        self._check(first)
        ends, begin = [0, *accumulate(counts)], 0
        while begin < len(rows):
            stop = min(len(rows), begin + len(self._block) - self._kept)
            before = _table(fates, ends[begin], ends[stop - 1])
            self._take_rows(rows[begin:stop], before)
            self._take_fates(_table(fates, ends[stop - 1], ends[stop]))
            begin = stop

    def _check(self, tick: int) -> None:
        """It must be this tick's turn."""
        if self._failure is not None:
            raise self._failure
        if tick != self._tables.ticks + self._kept:
            raise ValueError(f"tick {tick} was recorded after tick {self._tables.ticks + self._kept - 1}")
        if self._start is None:
            self._start = time.perf_counter() - self._started

    def _take_rows(self, rows: Floats, before: Ints | None = None) -> None:
        """As many as there is room for in the block, and (6, n) the fates before the last of them."""
        if before is not None and before.size:
            self._keep(before)
        kept = self._block[self._kept : self._kept + len(rows)]
        kept[:] = rows
        self._kept += len(rows)
        try:
            self._spool.record(kept, self._waiting)
        except OSError as error:
            self._after(error)
        self._waiting.clear()
        if self._kept == len(self._block):
            self._flush()

    def _take_fates(self, table: Ints) -> None:
        if table.size:
            self._keep(table)
        if self._n_fates >= FATES_AT_ONCE:
            self._flush()

    def _keep(self, table: Ints) -> None:
        self._fates.append(table)
        self._waiting.append(table)
        self._n_fates += table.shape[1]

    def external(self, tick: int, taken: Mapping[int, Floats]) -> None:
        """Record what was taken from outside at a tick, before it is used.

        Raises:
            RecordingError: the disk is full.
        """
        if taken and self._external is not None:
            try:
                self._external.add(tick, taken)
            except OSError as error:
                raise self._error(self.place / EXTERNAL, error) from None

    def close(self, status: str) -> str:
        """Write what is left, end both files and bring the manifest up to date.

        Args:
            status: `Status.COMPLETE`, or `aborted: ` and why.

        Returns:
            The digest of what the files hold.

        Raises:
            RecordingError: not everything could be written. If the run was complete, the manifest says that it was
                aborted, and why.
        """
        wall = time.perf_counter() - self._started
        failures: list[CosimError] = []
        for step in (self._write, self._close_files, self._close_external):
            try:
                step()
            except RecordingError as error:
                failures.append(error)
        if failures and status == Status.COMPLETE:
            status = f"{Status.ABORTED}: {failures[0]}"
        digest = self._digest.hexdigest()
        (self.place / RESERVE).unlink(missing_ok=True)
        try:
            self._write_manifest(status, wall, digest)
        except OSError as error:
            failures.append(RecordingError(f"cannot write {self.folder / MANIFEST}: {error.strerror}"))
        else:
            self._spool.remove()
        self._spool.close()
        self._lock.release()
        if failures:
            raise failures[0]
        return digest

    # --- to the tables ----------------------------------------------------------------------------------------------
    def _flush(self) -> None:
        """Move all that is kept to the tables, and go on if there is room for what comes.

        Raises:
            RecordingError: there is none.
        """
        self._write()
        if self._full is None:
            return
        try:
            if self._full.errno not in FULL:
                raise self._full
            self._spool.take_room()
        except OSError as error:
            self._failure = self._error(self.place, error)
            raise self._failure from None
        self._full = None

    def _after(self, error: OSError) -> None:
        """The spool takes no more: what it has makes a shorter row group, if the disk has room for that."""
        if error.errno not in FULL:
            self._make_room(error)
        self._flush()

    def _write(self) -> None:
        """Move all that is kept to the tables, as a row group each.

        Raises:
            RecordingError: they did not take all of it.
        """
        values, fates = self._block[: self._kept], stacked(self._fates)
        self._kept, self._fates, self._n_fates = 0, [], 0
        self._waiting.clear()
        if not len(values) and not fates.size:
            return
        values, fates = self._tables.append(values, fates, self._make_room)
        self._digest.rows(values)
        self._digest.fates(fates.T)
        try:
            self._spool.finish(self._tables)
        except OSError as error:
            self._make_room(error)
            with contextlib.suppress(OSError):
                self._spool.finish(self._tables)
        failed = self._tables.failed
        if failed is not None:
            self._failure = self._error(failed.path, failed.failure)
            raise self._failure

    def _make_room(self, error: OSError) -> None:
        """Give up the spool: what it held is about to be written."""
        self._full = error
        self._spool.drop()

    def _shown(self, path: Path | str) -> Path:
        """A path within the folder, as the user wrote that one."""
        path = Path(path)
        return self.folder / path.relative_to(self.place) if path.is_relative_to(self.place) else path

    def _error(self, path: Path, error: OSError | None) -> RecordingError:
        recorded = to_seconds(max(0, self._tables.ticks - 1) * self._plan.period_ns)
        return RecordingError(
            f"cannot write {self._shown(path)}: {getattr(error, 'strerror', None) or error}; "
            f"the run is recorded until t = {recorded:.9g} s. Free some space, or choose another disk with --out"
        )

    # --- files ------------------------------------------------------------------------------------------------------
    def _create_files(self, undo: contextlib.ExitStack) -> None:
        """All files of the run folder; `undo` removes them again."""
        self._lock = FolderLock(self.place, RUN)
        undo.callback(self._lock.release)
        for name in (SCENARIO, TRAJECTORIES, DELIVERIES, MANIFEST, *HIDDEN):
            undo.callback((self.place / name).unlink, missing_ok=True)
        (self.place / SCENARIO).write_text(self._plan.scenario, encoding="utf-8")
        with (self.place / RESERVE).open("xb") as reserve:
            allocate(reserve.fileno(), 0, _RESERVE_BYTES)
        self._tables = RunTables(self.place, self._layout)
        undo.callback(self._tables.abandon)
        self._spool = Spool(self.place, self._layout, self._tables)
        undo.callback(self._spool.close)
        if self._plan.bridge.subscribe:
            undo.callback((self.place / LOG).unlink, missing_ok=True)
            self._external = ExternalLog(self.place, self._plan.bridge.subscribe)
            undo.callback(self._external.close)
        self._write_manifest(Status.RUNNING)  # the last of all: it says that there is something to recover

    def _close_files(self) -> None:
        try:
            self._tables.close()
        except OSError as error:
            raise RecordingError(
                f"cannot write {self._shown(error.filename or self.place)}: {error.strerror or error}"
            ) from error

    def _close_external(self) -> None:
        if self._external is None:
            return
        self._external.close()
        try:
            convert(self.place)
        except OSError as error:
            raise RecordingError(f"cannot write {self.folder / EXTERNAL}: {error.strerror or error}") from error

    def _write_manifest(self, status: str, wall: float | None = None, digest: str | None = None) -> None:
        n_ticks = self._tables.ticks if digest else 0
        outcome = manifest.with_outcome(self._manifest, status, n_ticks, wall, self._start, digest)
        write_atomically(self.place / MANIFEST, manifest.to_json(outcome))


def _table(fates: Fates, begin: int, end: int) -> Ints:
    """(6, n) some of the fates."""
    return np.concatenate([column[begin:end] for column in fates.columns]).reshape(6, -1)
