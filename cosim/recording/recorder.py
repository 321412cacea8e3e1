"""Writes a run folder: the manifest, the resolved scenario, the trajectories and the fate of every message.

Memory stays bounded: rows and fates are kept in blocks and written as Parquet row groups (`cosim.recording.table`). A
run of 60 s with ten agents is one block, so nothing but a copy of 1 kB happens per tick.

When the disk fills up, `tick` or `fates` raises `RecordingError`; the caller then closes the recorder like after any
other failure, and what was recorded stays readable.
"""

from __future__ import annotations

import contextlib
import datetime
import time
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import CosimError
from cosim.plan import Plan
from cosim.recording.columns import Columns
from cosim.recording.digest import RunDigest
from cosim.recording.manifest import (
    DELIVERIES,
    MANIFEST,
    SCENARIO,
    TRAJECTORIES,
    command_line,
    describe,
    folder_problem,
    to_json,
    write_atomically,
)
from cosim.recording.table import TableFile, allocate, float_array, int_array, name_array
from network.messages import NEVER, Fate, Fates, Floats, Ints
from network.units import NANOSECONDS_PER_SECOND, to_seconds

RESERVE = ".reserve"

BLOCK_BYTES = 16 << 20
"""Recorded numbers kept in memory, and about the size of a row group."""

FATES_AT_ONCE = 1 << 18
"""Fates kept in memory, likewise."""

_RESERVE_BYTES = 1 << 18
_FATE_NAMES = [fate.name.lower() for fate in Fate]
_DELIVERY_COLUMNS = (
    ("sender", "string"),
    ("receiver", "string"),
    ("stamp", "int64"),
    ("sent", "int64"),
    ("arrival", "float64"),
    ("arrival_ns", "int64"),
    ("fate", "string"),
)


class Status(StrEnum):
    """What `status` in the manifest says; the reason follows `aborted`, as in `aborted: interrupted at t = 3 s`."""

    RUNNING = "running"
    COMPLETE = "complete"
    ABORTED = "aborted"


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
        self._plan = plan
        self._columns = Columns.of(plan.agents)
        names = [agent.name for agent in plan.agents]
        self._digest = RunDigest(plan.period_ns, zip(names, self._columns.of_agent, strict=True))
        self._details = dict(details or {})
        self._manifest: dict[str, Any] = {}
        self._started = 0.0

        ticks_at_once = max(1, block_bytes // (8 * max(1, self._columns.width)))
        arriving = sum(port.variable.size for agent in plan.agents for _, port in agent.record)
        self._block = np.empty((min(ticks_at_once, plan.ticks + 1), arriving))
        self._kept = 0  # rows of the block in use
        self._written = 0  # ticks in the file
        self._fates: list[Fates] = []
        self._n_fates = 0

    def open(self) -> None:
        """Create the folder with a manifest of status `running`, and the scenario.

        Raises:
            ConfigError: the folder is not empty, or cannot be written.
        """
        self._started = time.perf_counter()
        created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        self._manifest = {
            "created": created,
            "command": command_line(),
            **describe(self._plan, self._columns),
            **self._details,
        }
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.iterdir()):
                raise folder_problem(
                    self.folder, "the folder is not empty; remove it, or choose another one with --out"
                )
            with contextlib.ExitStack() as undo:
                self._create_files(undo)
                undo.pop_all()
        except OSError as error:
            where = Path(error.filename or self.folder)
            raise folder_problem(where, f"cannot write the run folder: {error.strerror or error}") from None

    def add(self, details: Mapping[str, Any]) -> None:
        """Further entries for the manifest, which are known only at the end; `close` writes them."""
        self._manifest |= details

    def tick(self, tick: int, row: Floats) -> None:
        """Record a tick.

        Args:
            tick: 0, 1, 2, … in order.
            row: agent by agent, its recorded scalars in the order of `AgentPlan.record`. It is copied.

        Raises:
            RecordingError: the disk is full.
        """
        if tick != self._written + self._kept:
            raise ValueError(f"tick {tick} was recorded after tick {self._written + self._kept - 1}")
        self._block[self._kept] = row
        self._kept += 1
        if self._kept == len(self._block):
            self._write_rows()

    def fates(self, fates: Fates) -> None:
        """Record fates, in their order. The arrays are kept, not copied.

        Raises:
            RecordingError: the disk is full.
        """
        if len(fates):
            self._fates.append(fates)
            self._n_fates += len(fates)
            if self._n_fates >= FATES_AT_ONCE:
                self._write_fates()

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
        for step in (self._write_rows, self._write_fates, self._close_files):
            try:
                step()
            except RecordingError as error:
                failures.append(error)
        if failures and status == Status.COMPLETE:
            status = f"{Status.ABORTED}: {failures[0]}"
        digest = self._digest.hexdigest()
        with contextlib.suppress(FileNotFoundError):
            (self.folder / RESERVE).unlink()
        try:
            self._write_manifest(status, wall, digest)
        except OSError as error:
            failures.append(RecordingError(f"cannot write {self.folder / MANIFEST}: {error.strerror}"))
        if failures:
            raise failures[0]
        return digest

    # --- rows -------------------------------------------------------------------------------------------------------
    def _write_rows(self) -> None:
        """Move the block to the file."""
        values, self._kept = self._block[: self._kept], 0
        if not len(values) or self._trajectories.failure:
            return
        if self._columns.source is not None:
            values = values[:, self._columns.source]
        n_agents = len(self._plan.agents)
        written = self._trajectories.append(self._row_arrays(values), n_agents) // n_agents
        self._digest.rows(values[:written])
        self._written += written
        self._check(self._trajectories)

    def _row_arrays(self, values: Floats) -> list[Any]:
        """The columns of the trajectories for ticks of values (n_ticks, width)."""
        n_ticks, n_agents = len(values), len(self._plan.agents)
        ticks = np.repeat(np.arange(self._written, self._written + n_ticks), n_agents)
        arrays = [
            int_array(ticks),
            float_array(ticks * self._plan.period_ns / NANOSECONDS_PER_SECOND),
            name_array(np.tile(np.arange(n_agents), n_ticks), [agent.name for agent in self._plan.agents]),
        ]
        for positions in self._columns.positions:
            recorded = positions >= 0
            valid = None if recorded.all() else np.tile(recorded, n_ticks)
            arrays.append(float_array(values[:, positions].reshape(-1), valid))
        return arrays

    # --- fates ------------------------------------------------------------------------------------------------------
    def _write_fates(self) -> None:
        """Move the fates that are kept to the file."""
        fates, self._fates, self._n_fates = self._fates, [], 0
        if not fates or self._deliveries.failure:
            return
        table = np.stack(
            [
                np.concatenate(column)
                for column in zip(
                    *((f.sender, f.receiver, f.stamp, f.sent, f.arrival_ns, f.fate) for f in fates), strict=True
                )
            ]
        )
        written = self._deliveries.append(self._fate_arrays(table))
        self._digest.fates(table[:, :written].T)
        self._check(self._deliveries)

    def _fate_arrays(self, table: Ints) -> list[Any]:
        """The columns of the deliveries for fates (6, n)."""
        sender, receiver, stamp, sent, arrival_ns, fate = table
        agents = [agent.name for agent in self._plan.agents]
        return [
            name_array(sender, agents),
            name_array(receiver, agents),
            int_array(stamp),
            int_array(sent),
            float_array(arrival_ns / NANOSECONDS_PER_SECOND, arrival_ns != NEVER),
            int_array(arrival_ns),
            name_array(fate, _FATE_NAMES),
        ]

    # --- files ------------------------------------------------------------------------------------------------------
    def _create_files(self, undo: contextlib.ExitStack) -> None:
        """All files of the run folder; `undo` removes them again."""

        def remove(name: str) -> None:
            (self.folder / name).unlink(missing_ok=True)

        undo.callback(remove, SCENARIO)
        (self.folder / SCENARIO).write_text(self._plan.scenario, encoding="utf-8")
        undo.callback(remove, MANIFEST)
        self._write_manifest(Status.RUNNING)
        undo.callback(remove, RESERVE)
        with (self.folder / RESERVE).open("xb") as reserve:
            allocate(reserve.fileno(), 0, _RESERVE_BYTES)
        columns = [("tick", "int64"), ("time", "float64"), ("agent", "string")]
        columns += [(name, "float64") for name in self._columns.names]
        undo.callback(remove, TRAJECTORIES)
        self._trajectories = TableFile(self.folder / TRAJECTORIES, columns)
        undo.callback(self._trajectories.close)
        undo.callback(remove, DELIVERIES)
        self._deliveries = TableFile(self.folder / DELIVERIES, _DELIVERY_COLUMNS)

    def _check(self, table: TableFile) -> None:
        """Raise if the table took less than it was given."""
        if table.failure is not None:
            recorded = to_seconds(max(0, self._written - 1) * self._plan.period_ns)
            raise RecordingError(
                f"cannot write {table.path}: {table.failure.strerror or table.failure}; "
                f"the run is recorded until t = {recorded:.9g} s. Free some space, or choose another disk with --out"
            )

    def _close_files(self) -> None:
        failed = []
        for table in (self._trajectories, self._deliveries):
            try:
                table.close()
            except OSError as error:
                failed.append(f"cannot write {table.path}: {error.strerror or error}")
        if failed:
            raise RecordingError("; ".join(failed))

    def _write_manifest(self, status: str, wall: float | None = None, digest: str | None = None) -> None:
        simulated = to_seconds(max(0, self._written - 1) * self._plan.period_ns)
        text = to_json(
            {
                "name": self._plan.name,
                "title": self._plan.title,
                "seed": self._plan.seed,
                "status": status,
                "digest": digest,
                "ticks": {"planned": self._plan.ticks, "done": max(0, self._written - 1)},
                "simulated_s": simulated,
                "wall_s": None if wall is None else round(wall, 6),
                "speed": round(simulated / wall, 3) if wall else None,
                **self._manifest,
            }
        )
        write_atomically(self.folder / MANIFEST, text)
