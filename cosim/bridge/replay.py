"""A recording in place of the outside."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cosim.bridge import Taken
from cosim.bridge.checking import fitting
from cosim.components.component import Floats
from cosim.errors import ConfigError, Location, Problem, suggest
from cosim.plan import BridgePlan
from cosim.recording.table import numbers
from network.messages import Fates
from network.payload import PayloadError


class Replay:
    """Takes at every tick what an earlier run took, and publishes nothing; see `cosim.bridge.Bridge`.

    Args:
        plan: of the bridge. A key that is not in the recording never brings anything.

    Raises:
        ConfigError: the file cannot be used.
    """

    def __init__(self, plan: BridgePlan) -> None:
        self._path, subscribe = plan.replay or Path(), plan.subscribe
        self.where = plan.where
        self._values: dict[int, dict[int, Floats]] = {}
        ticks, keys, values = self._read()
        index_of = {subscription.key: index for index, subscription in enumerate(subscribe)}
        for tick, key, row in zip(ticks, keys, values, strict=True):
            if key not in index_of:
                raise self._problem(f"nothing subscribes to {key!r}{suggest(str(key), index_of)}")
            size = subscribe[index_of[key]].size
            if not np.isfinite(row[:size]).all() or not np.isnan(row[size:]).all() or len(row) < size:
                numbers_ = "1 finite number" if size == 1 else f"{size} finite numbers"
                raise self._problem(f"at tick {tick}, {key!r} has other than {numbers_}")
            try:
                fitting(subscribe[index_of[key]], row[:size])
            except PayloadError as error:
                raise self._problem(f"at tick {tick}, {key!r} {str(error).removeprefix('it ')}") from None
            self._values.setdefault(tick, {})[index_of[key]] = row[:size].copy()

    def _problem(self, message: str) -> ConfigError:
        return ConfigError([Problem(f"cannot be replayed: {message}", Location(str(self._path)))])

    def _read(self) -> tuple[list[int], list[str], Floats]:
        """Ticks, keys and rows of values, NaN where there are none."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            table = pq.read_table(self._path)
            columns = [name for name in table.column_names if name.startswith("value[")]
            if table["tick"].type != pa.int64() or table["tick"].null_count:
                raise KeyError("the ticks are not whole numbers")  # noqa: TRY301
            values = [numbers(table[name]) for name in columns]
            keys = table["key"].to_pylist()
            return table["tick"].to_pylist(), keys, np.column_stack([np.zeros((len(keys), 0)), *values])
        except FileNotFoundError:
            raise self._problem("there is no such file") from None
        except (OSError, KeyError, pa.ArrowException) as error:
            raise self._problem(f"it is no table of ticks, keys and values ({str(error).splitlines()[0]})") from error

    def take(self, tick: int) -> Taken:
        values: Mapping[int, Floats] = self._values.get(tick, {})
        return values

    def tick(self, tick: int, row: Floats) -> None:
        """Nothing is published."""

    def fates(self, fates: Fates) -> None:
        """Not needed."""

    def account(self) -> list[str]:
        return [f"replayed new values of {len(self._values)} ticks"]
