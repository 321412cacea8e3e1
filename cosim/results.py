"""Read a run folder: as arrays, as data frames, and as the terms of the analysis.

`load(folder)` reads the manifest alone; each table is read when it is first asked for. Arrays are read with pyarrow,
and only the columns that are wanted; pandas is imported for the data frames alone.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.errors import suggest
from cosim.recording import recovery
from cosim.recording.columns import scalar_names
from cosim.recording.lock import LOCK
from cosim.recording.manifest import DELIVERIES, FORMAT, MANIFEST, SCENARIO, TRAJECTORIES, Status, folder_problem
from cosim.recording.table import indices, numbers
from network.messages import Fate, Fates, Floats, Links
from network.units import to_seconds

if TYPE_CHECKING:
    import pandas as pd


class Results:
    """A run folder.

    Attributes:
        folder: where it lies.
        manifest: `manifest.json` as it stands.
    """

    def __init__(self, folder: Path, manifest: Mapping[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest

    # --- what ran ---------------------------------------------------------------------------------------------------
    @property
    def agents(self) -> tuple[str, ...]:
        """Names, in the order of the file."""
        return tuple(agent["name"] for agent in self.manifest["agents"])

    @property
    def period_ns(self) -> int:
        """T."""
        return int(self.manifest["period_ns"])

    @cached_property
    def n_ticks(self) -> int:
        """Recorded ticks, tick 0 among them."""
        n_agents = len(self.agents)
        return int(self._trajectories.metadata.num_rows) // n_agents

    @property
    def complete(self) -> bool:
        """Whether the run reached its last tick."""
        return bool(self.manifest["status"] == "complete")

    @property
    def realtime(self) -> Mapping[str, Any] | None:
        """How the schedule of a run that was paced against the wall clock was kept; see docs/design.md."""
        account: Mapping[str, Any] | None = self.manifest.get("realtime")
        return account

    @cached_property
    def links(self) -> Links:
        """The edges, in the plan's order."""
        links = self.manifest["links"]
        sender, receiver, slot = (np.array(links[key], dtype=np.int64) for key in ("sender", "receiver", "slot"))
        return Links(self.agents, sender, receiver, slot)

    @property
    def weights(self) -> Floats:
        """(n_links,) a_ij."""
        return np.array(self.manifest["links"]["weight"], dtype=np.float64)

    @property
    def analysis(self) -> Mapping[str, Any]:
        """The roles: `position`, `velocity`, …, as under `analysis` in the scenario; None where not given."""
        roles: Mapping[str, Any] = self.manifest["analysis"]
        return roles

    @property
    def scenario(self) -> str:
        """The resolved scenario, YAML."""
        return (self.folder / SCENARIO).read_text(encoding="utf-8")

    # --- what was recorded ------------------------------------------------------------------------------------------
    @property
    def variables(self) -> Mapping[str, tuple[int, ...]]:
        """Recorded variables, `component.variable`, and their shapes (the largest, where agents differ)."""
        return {name: tuple(entry["shape"]) for name, entry in self.manifest["record"].items()}

    def unit(self, variable: str) -> str | None:
        """Unit of a recorded variable, as its component declares it."""
        unit: str | None = self.manifest["record"][variable]["unit"]
        return unit

    @property
    def time(self) -> Floats:
        """(n_ticks,) in seconds."""
        return self.times()

    def times(self, every: int = 1) -> Floats:
        """Time in seconds of every so many ticks."""
        return np.arange(0, self.n_ticks, every) * self.period_ns / 1e9

    def array(self, variable: str, every: int = 1, stop: int | None = None) -> Floats:
        """A recorded variable over time.

        Args:
            variable: `component.variable`, or one scalar of it such as `plant.p[1]`.
            every: read every so many ticks only.
            stop: read ticks before this one only.

        Returns:
            (n_ticks, n_agents, *shape); NaN where an agent does not record it.

        Raises:
            ConfigError: nothing of that name was recorded.
        """
        shape, columns = self._select(variable)
        n_agents = len(self.agents)
        parts = [np.empty((0, n_agents, *shape))]
        stop = self.n_ticks if stop is None else min(stop, self.n_ticks)
        done = 0
        for group in range(self._trajectories.num_row_groups):
            n_ticks = self._trajectories.metadata.row_group(group).num_rows // n_agents
            first, last = -done % every, min(n_ticks, stop - done)
            done += n_ticks
            if first < last:
                table = self._trajectories.read_row_group(group, columns=columns, use_threads=False)
                absent = np.full(len(table), np.nan)  # where agents' shapes differ, some corner may be nobody's
                values = np.stack(
                    [numbers(table.column(name)) if name in table.column_names else absent for name in columns], -1
                )
                parts.append(values.reshape(n_ticks, n_agents, *shape)[first:last:every].copy())
        return np.concatenate(parts)

    @cached_property
    def trajectories(self) -> pd.DataFrame:
        """One row per tick and agent: `tick`, `time`, `agent` (a categorical in the file's order), every scalar."""
        import pandas as pd

        frame = self._trajectories.read().to_pandas()
        frame["agent"] = pd.Categorical(frame["agent"], categories=list(self.agents))
        return frame

    @cached_property
    def deliveries(self) -> pd.DataFrame:
        """One row per message: `sender`, `receiver`, `stamp`, `sent`, `arrival` (NaN if lost), `arrival_ns`, `fate`."""
        import pandas as pd

        frame = self._deliveries.read().to_pandas()
        for column in ("sender", "receiver"):
            frame[column] = pd.Categorical(frame[column], categories=list(self.agents))
        frame["fate"] = pd.Categorical(frame["fate"], categories=[fate.name.lower() for fate in Fate])
        return frame

    @cached_property
    def fates(self) -> Fates:
        """The deliveries as arrays, agents by their index."""
        return self.first_fates(self.n_fates)

    @property
    def n_fates(self) -> int:
        """Rows of the deliveries."""
        return int(self._deliveries.metadata.num_rows)

    def first_fates(self, limit: int) -> Fates:
        """The first fates: as many whole row groups as have at most `limit` rows together, and one at least."""
        rows = [self._deliveries.metadata.row_group(i).num_rows for i in range(self._deliveries.num_row_groups)]
        groups = [i for i, total in enumerate(itertools.accumulate(rows)) if i == 0 or total <= limit]
        table = self._deliveries.read_row_groups(groups, use_threads=False)
        agents = {name: i for i, name in enumerate(self.agents)}
        fates = {fate.name.lower(): int(fate) for fate in Fate}
        return Fates(
            sender=indices(table.column("sender"), agents),
            receiver=indices(table.column("receiver"), agents),
            stamp=numbers(table.column("stamp")),
            sent=numbers(table.column("sent")),
            arrival_ns=numbers(table.column("arrival_ns")),
            fate=indices(table.column("fate"), fates),
        )

    def channel(self, link: int) -> str:
        """Name of the channel of an edge."""
        return str(self.manifest["links"]["channel"][link])

    def age_bound(self, link: int) -> float | None:
        """The largest age of information, in seconds and read at ticks, that the channel of an edge can produce."""
        channel = self.manifest["channels"][self.channel(link)]
        return None if channel["age_bound_ns"] is None else to_seconds(channel["age_bound_ns"])

    # --- files ------------------------------------------------------------------------------------------------------
    def _select(self, variable: str) -> tuple[tuple[int, ...], list[str]]:
        """Shape and columns of a variable or of one scalar."""
        if variable in self.variables:
            shape = self.variables[variable]
            return shape, scalar_names(variable, shape)
        columns = self.manifest["columns"]
        if variable in columns:
            return (), [variable]
        raise folder_problem(
            self.folder, f"{variable!r} was not recorded{suggest(variable, [*self.variables, *columns])}"
        )

    @cached_property
    def _trajectories(self) -> Any:
        return _open(self.folder / TRAJECTORIES, ["agent"])

    @cached_property
    def _deliveries(self) -> Any:
        return _open(self.folder / DELIVERIES, ["sender", "receiver", "fate"])


def load(folder: str | Path) -> Results:
    """Open a run folder. If the process that recorded it was killed, what it had recorded is recovered first.

    Raises:
        ConfigError: it is none, or of another version of the format; or the run goes on, or cannot be recovered.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    if not folder.is_dir():
        raise folder_problem(
            folder, "there is no such folder" if not folder.exists() else "this is a file, not a run folder"
        )
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise folder_problem(folder, f"this is no run folder: it has no {MANIFEST}{_inside(folder)}") from None
    except (OSError, ValueError) as error:
        raise folder_problem(path, f"cannot be read: {error}") from None
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise folder_problem(
            path, f"format {found!r} is not the one that this version reads ({FORMAT}); run the scenario again"
        )
    if manifest["status"] == Status.RUNNING:
        manifest = recovery.recover(folder)
    elif (folder / LOCK).exists():
        recovery.tidy(folder)
    return Results(folder, manifest)


def _inside(folder: Path) -> str:
    """A hint for whoever names the folder that holds the run folders."""
    runs = sorted(path.parent.name for path in folder.glob(f"*/{MANIFEST}"))
    return f" (did you mean {str(folder / runs[-1])!r}?)" if runs else ""


def _open(path: Path, dictionaries: list[str]) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path, read_dictionary=dictionaries)
    except FileNotFoundError:
        raise folder_problem(path, "the run folder lacks this file") from None
    except (OSError, pa.ArrowInvalid) as error:
        raise folder_problem(path, f"cannot be read: {error}") from None
