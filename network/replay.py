"""A run's network once more: what `deliveries.parquet` says became of every message happens again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from network.channel import Batch, Channel, ChannelModel, Setting, Transmission
from network.files import file_read_by
from network.messages import NEVER, Ints
from network.units import format_duration

_COLUMNS = ("sender", "receiver", "stamp", "sent", "arrival_ns", "fate")


def read_deliveries(path: Path) -> dict[str, Any]:
    """The columns as arrays.

    Raises:
        ValueError: it cannot be read, or is no such table.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path, columns=list(_COLUMNS))
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{path}: this is no deliveries.parquet of a run: {str(error).splitlines()[0]}") from None
    return {name: table[name].to_numpy() for name in _COLUMNS}


class Replay(ChannelModel):
    """Every edge sends what the edge between agents of the same names sent in an earlier run with the same period."""

    model: Literal["replay"] = "replay"
    file: file_read_by(read_deliveries) = Field(  # type: ignore[valid-type]
        description="the deliveries.parquet of a run folder"
    )

    def open(self, setting: Setting) -> Channel:
        recorded = _period_of(Path(self.file).with_name("manifest.json"))
        if recorded not in {0, setting.period_ns}:
            this = format_duration(setting.period_ns)
            raise ValueError(f"the recorded run has a period of {format_duration(recorded)}, this one of {this}")
        return _Replay(read_deliveries(Path(self.file)), setting)

    def min_delay_ns(self) -> int:
        return 0


def _period_of(manifest: Path) -> int:
    """T of a recorded run in nanoseconds; 0 where that is not known."""
    try:
        found = json.loads(manifest.read_text(encoding="utf-8"))["period_ns"]
    except (OSError, ValueError, KeyError, TypeError):
        return 0
    return found if isinstance(found, int) else 0


class _Replay(Channel):
    def __init__(self, columns: dict[str, Any], setting: Setting) -> None:
        names = setting.links.agents
        pairs = zip(setting.links.sender.tolist(), setting.links.receiver.tolist(), strict=True)
        number = {(names[sender], names[receiver]): i for i, (sender, receiver) in enumerate(pairs)}
        senders, receivers = columns["sender"].tolist(), columns["receiver"].tolist()
        link = np.array([number.get(pair, -1) for pair in zip(senders, receivers, strict=True)], np.int64)
        missing = set(range(len(number))) - set(link.tolist())
        if missing and len(link):
            sender, receiver = next(pair for pair, i in number.items() if i in missing)
            raise ValueError(f"the recorded run has no message from {sender} to {receiver}")
        kept = link >= 0
        self._link, self._stamp, self._sent = link[kept], columns["stamp"][kept], columns["sent"][kept]
        arrival = columns["arrival_ns"][kept]
        self._delay = np.where(arrival == NEVER, NEVER, arrival - self._sent * setting.period_ns)
        if len(self._delay) and self._delay.min() < NEVER:
            raise ValueError("the recorded run has another period: messages would arrive before they are sent")
        order = np.lexsort((self._delay, self._stamp, self._link, self._sent))
        self._link, self._stamp, self._delay = self._link[order], self._stamp[order], self._delay[order]
        self._sent = self._sent[order]
        self._copy = self._copies()
        self.history = int((self._sent - self._stamp).max(initial=0))

    def _copies(self) -> Ints:
        """0, 1, … for messages of one edge, tick and stamp, in the order of arrival."""
        n = len(self._link)
        same = np.ones(n, np.bool_)
        for column in (self._link, self._stamp, self._sent):
            same[1:] &= column[1:] == column[:-1]
        same[:1] = False
        position = np.arange(n)
        return position - np.maximum.accumulate(np.where(same, 0, position))

    def transmit(self, tick: int) -> Transmission:
        (sent,) = self.transmit_many(range(tick, tick + 1)).by_tick()
        return sent

    def transmit_many(self, ticks: range) -> Batch:
        part = slice(*np.searchsorted(self._sent, (ticks.start, ticks.stop)).tolist())
        return Batch(ticks, self._sent[part], self._link[part], self._stamp[part], self._delay[part], self._copy[part])
