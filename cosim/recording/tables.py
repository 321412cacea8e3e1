"""The two Parquet files of a run folder: what is in them, and how it gets there from the numbers of a run."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.plan import Plan
from cosim.recording.columns import Columns, arriving_names
from cosim.recording.digest import RunDigest
from cosim.recording.manifest import DELIVERIES, TRAJECTORIES
from cosim.recording.table import Finished, TableFile, bound, float_array, int_array, name_array
from network.messages import NEVER, Fate, Floats, Ints
from network.units import NANOSECONDS_PER_SECOND

FATE_NAMES = [fate.name.lower() for fate in Fate]
FATE_BYTES = 48
"""A fate as six whole numbers."""

_DELIVERY_COLUMNS = (
    ("sender", "string"),
    ("receiver", "string"),
    ("stamp", "int64"),
    ("sent", "int64"),
    ("arrival", "float64"),
    ("arrival_ns", "int64"),
    ("fate", "string"),
)
_WIDTHS = {"string": 4, "int64": 8, "float64": 8}


@dataclass(frozen=True)
class Layout:
    """What the tables hold, whoever fills them.

    Attributes:
        period_ns: T.
        agents: their names.
        arriving: per agent, the scalars of its row as they arrive.
    """

    period_ns: int
    agents: tuple[str, ...]
    arriving: tuple[tuple[str, ...], ...]

    @classmethod
    def of(cls, plan: Plan) -> Layout:
        """That of a plan's run."""
        names = tuple(agent.name for agent in plan.agents)
        return cls(plan.period_ns, names, tuple(arriving_names(agent) for agent in plan.agents))

    @cached_property
    def columns(self) -> Columns:
        """Where each scalar goes."""
        return Columns.of_names(self.arriving)

    @property
    def width(self) -> int:
        """Numbers that arrive per tick."""
        return sum(map(len, self.arriving))

    def digest(self) -> RunDigest:
        """One that has seen nothing yet."""
        return RunDigest(self.period_ns, zip(self.agents, self.columns.of_agent, strict=True))

    def encode(self) -> bytes:
        """As bytes, for `decode`; agents that record the same share it."""
        kinds = {names: i for i, names in enumerate(dict.fromkeys(self.arriving))}
        tree = {
            "period_ns": self.period_ns,
            "agents": self.agents,
            "kinds": list(kinds),
            "kind": [kinds[names] for names in self.arriving],
        }
        return json.dumps(tree).encode()

    @classmethod
    def decode(cls, data: bytes) -> Layout:
        """What was encoded."""
        tree = json.loads(data)
        kinds = [tuple(names) for names in tree["kinds"]]
        return cls(tree["period_ns"], tuple(tree["agents"]), tuple(kinds[i] for i in tree["kind"]))


class RunTables:
    """Trajectories and deliveries, open for writing.

    Args:
        folder: the run folder.
        layout: of what will come.
        finished: what a writer that was killed left of trajectories and deliveries; None to create them.

    Raises:
        OSError: they cannot be opened, or the disk is full already.
    """

    def __init__(self, folder: Path, layout: Layout, finished: tuple[Finished, Finished] | None = None) -> None:
        self._layout = layout
        columns = [("tick", "int64"), ("time", "float64"), ("agent", "string")]
        self._trajectory_columns = [*columns, *((name, "float64") for name in layout.columns.names)]
        first, second = (None, None) if finished is None else finished
        self._trajectories = TableFile(folder / TRAJECTORIES, self._trajectory_columns, first)
        try:
            self._deliveries = TableFile(folder / DELIVERIES, _DELIVERY_COLUMNS, second)
        except BaseException:
            self._trajectories.abandon()
            raise
        self.ticks = self._trajectories.rows // len(layout.agents)
        """In the file."""

    @property
    def files(self) -> tuple[TableFile, TableFile]:
        """Both."""
        return self._trajectories, self._deliveries

    @property
    def failed(self) -> TableFile | None:
        """A file that takes no more."""
        return next((table for table in self.files if table.failure is not None), None)

    def check(self) -> None:
        """Raise what a file that takes no more has met.

        Raises:
            OSError: that.
        """
        for table in self.files:
            if table.failure is not None:
                raise table.failure

    def append(
        self, values: Floats, fates: Ints, make_room: Callable[[OSError], None] | None = None
    ) -> tuple[Floats, Ints]:
        """Write ticks and fates as a row group each.

        Args:
            values: (n_ticks, width) as they arrived.
            fates: (6, n).
            make_room: called if the disk is full, before a last attempt.

        Returns:
            What was written, the values in the order of the columns: all, unless a file `failed`.
        """
        if self._layout.columns.source is not None:
            values = values[:, self._layout.columns.source]
        n_agents = len(self._layout.agents)
        if len(values):
            values = values[: self._trajectories.append(self._row_arrays(values), n_agents, make_room) // n_agents]
            self.ticks += len(values)
        if fates.size:
            fates = fates[:, : self._deliveries.append(self._fate_arrays(fates), 1, make_room)]
        return values, fates

    def close(self) -> None:
        """Write the footers.

        Raises:
            OSError: one of them could not be written, and that file is lost; the other one is closed.
        """
        try:
            self._trajectories.close()
        finally:
            self._deliveries.close()

    def abandon(self) -> None:
        """Close the files as they are."""
        for table in self.files:
            table.abandon()

    def room(self, n_ticks: int, n_fates: int) -> int:
        """No more space is needed to append so much and to close the files."""
        names = sum(len(name.encode()) + 4 for name in self._layout.agents)
        n_rows = n_ticks * len(self._layout.agents)
        return _room(self._trajectory_columns, n_rows, names) + _room(_DELIVERY_COLUMNS, n_fates, 2 * names)

    def _row_arrays(self, values: Floats) -> list[Any]:
        """The columns of the trajectories for ticks of values (n_ticks, width)."""
        n_ticks, n_agents = len(values), len(self._layout.agents)
        ticks = np.repeat(np.arange(self.ticks, self.ticks + n_ticks), n_agents)
        arrays = [
            int_array(ticks),
            float_array(ticks * self._layout.period_ns / NANOSECONDS_PER_SECOND),
            name_array(np.tile(np.arange(n_agents), n_ticks), self._layout.agents),
        ]
        for positions in self._layout.columns.positions:
            recorded = positions >= 0
            valid = None if recorded.all() else np.tile(recorded, n_ticks)
            arrays.append(float_array(values[:, positions].reshape(-1), valid))
        return arrays

    def _fate_arrays(self, table: Ints) -> list[Any]:
        """The columns of the deliveries for fates (6, n)."""
        sender, receiver, stamp, sent, arrival_ns, fate = table
        return [
            name_array(sender, self._layout.agents),
            name_array(receiver, self._layout.agents),
            int_array(stamp),
            int_array(sent),
            float_array(arrival_ns / NANOSECONDS_PER_SECOND, arrival_ns != NEVER),
            int_array(arrival_ns),
            name_array(fate, FATE_NAMES),
        ]


def _room(columns: Sequence[tuple[str, str]], n_rows: int, names: int) -> int:
    """Of a row group of so many rows, with its part of the footer; `names` bytes go into its dictionaries."""
    per_row = sum(8 * _WIDTHS[kind] + 1 for _, kind in columns)  # in bits, with validity
    footer = sum(2 * len(name.encode()) + 256 for name, _ in columns)
    return bound(n_rows * per_row // 8 + names + 4096, n_rows, len(columns)) + footer
