"""Delay and loss as they were measured over time: a CSV file that is played again and again."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from network.channel import Batch, Setting
from network.files import file_read_by
from network.impairments.impairment import Impairment, Stage, under_way_in, uniforms
from network.impairments.order import InOrder
from network.messages import NEVER, Floats, Ints
from network.units import Duration, parse_duration, parse_probability

_COLUMNS = ("time", "delay", "loss")


@dataclass(frozen=True)
class Recording:
    """(m,) times in nanoseconds, from 0 and rising; from each on, the delay in nanoseconds and the share of losses."""

    time_ns: Ints
    delay_ns: Ints
    loss: Floats


def read_recording(path: Path) -> Recording:
    """A CSV file with the columns `time`, `delay` and, if wanted, `loss`: seconds, or numbers with their units.

    Raises:
        ValueError: it cannot be read, is empty, or a line is malformed; the message has the line.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error):
        raise ValueError(f"{path}: this is no CSV file") from None
    header = [name.strip() for name in rows[0]] if rows else []
    if not {"time", "delay"} <= set(header) or not set(header) <= set(_COLUMNS):
        raise ValueError(f"{path}:1: the first line names the columns: time,delay or time,delay,loss")
    table: list[tuple[int, int, float]] = []
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise ValueError(f"{path}:{number}: {len(row)} cells, not {len(header)}")
        cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
        try:
            time, delay = parse_duration(cells["time"]), parse_duration(cells["delay"])
            loss = parse_probability(cells.get("loss") or 0.0)
        except ValueError as error:
            raise ValueError(f"{path}:{number}: {error}") from None
        if delay < 0 or (table and time <= table[-1][0]):
            raise ValueError(f"{path}:{number}: times must rise, and delays must not be negative")
        table.append((time, delay, loss))
    if len(table) < 2:
        raise ValueError(f"{path}: at least two lines of data are needed: the last one says when it begins anew")
    if all(loss >= 1 for _, _, loss in table[:-1]):
        raise ValueError(f"{path}: every message would be lost")
    time_ns, delay_ns, losses = zip(*table, strict=True)
    first = time_ns[0]
    return Recording(np.array(time_ns, np.int64) - first, np.array(delay_ns, np.int64), np.array(losses, np.float64))


class Recorded(Impairment):
    """A CSV file, or a mapping with more. Each line holds until the next; the last one is where it begins anew."""

    short_form: ClassVar[dict[str, Any]] = {"type": "string"}
    short_field = "file"

    file: file_read_by(read_recording) = Field(  # type: ignore[valid-type]
        description="columns time, delay and loss"
    )
    start: Duration = Field(0, description="where in the recording the run begins")
    spread: bool = Field(False, description="whether each edge begins elsewhere in it, drawn from the seed")
    fifo: bool = Field(True, description="whether messages keep their order")

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value

    def open(self, setting: Setting) -> Stage:
        return _Recorded(self, setting)

    def min_delay_ns(self) -> int:
        return int(read_recording(Path(self.file)).delay_ns[:-1].min())

    def max_delay_ns(self) -> int | None:
        recording = read_recording(Path(self.file))
        return None if recording.loss[:-1].any() else int(recording.delay_ns[:-1].max())


class _Recorded(Stage):
    def __init__(self, model: Recorded, setting: Setting) -> None:
        self._recording = read_recording(Path(model.file))
        self._cycle = int(self._recording.time_ns[-1])
        phase = setting.draws.uniform("recording", 0) if model.spread else np.zeros(len(setting.links))
        self._phase = model.start + (phase * self._cycle).astype(np.int64)
        self._draws = setting.draws
        self._period_ns = setting.period_ns
        self._in_order = InOrder(setting) if model.fifo else None

    def apply(self, batch: Batch) -> Batch:
        delay = batch.delay_ns.copy()
        for copy, which in under_way_in(batch):
            since = batch.sent[which] * self._period_ns + delay[which] + self._phase[batch.link[which]]
            line = np.searchsorted(self._recording.time_ns, since % self._cycle, side="right") - 1
            lost = uniforms(self._draws, "recorded loss", batch, copy, which) < self._recording.loss[line]
            delay[which] = np.where(lost, NEVER, delay[which] + self._recording.delay_ns[line])
        after = batch.with_delay(delay)
        return after if self._in_order is None else self._in_order.apply(after)
