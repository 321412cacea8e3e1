"""Measured logs: one message per line, as CSV or as `ping` prints it.

CSV: the first line names the columns, separated by commas, semicolons or tabs. `delay` is needed, and `seq` or `time`;
others are ignored. A name may carry its unit, as in `delay_ms`; without one, numbers are seconds, or have their unit
with them, as in `12.3 ms`. An empty delay, `lost`, `nan`, `-` or `*` is a loss, and so is a sequence number that is
missing between the first and the last. `#` begins a comment.

ping: what Linux's (with `-D`, which gives the times, and `-O` if wanted) and BSD's and macOS's print. Delays are those
of round trips.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.errors import ConfigError, Location, Problem, suggest
from network.messages import Floats
from network.units import parse_duration

LEAST = 20
"""Messages of which something can be said."""

_MOST_PROBLEMS = 10
_LARGEST_GAP = 1_000_000
_LOST = frozenset({"", "lost", "nan", "-", "*", "timeout"})
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SEQUENCE_NUMBERS = 65536  # of ICMP; then they begin anew


@dataclass(frozen=True)
class Log:
    """A measured log, in the order of sending.

    Attributes:
        name: of the file.
        delay: (n,) seconds; NaN where the message was lost.
        sent: (n,) seconds; NaN where it is not known.
        duplicates: messages that arrived more than once.
        round_trip: whether the delays are of the way there and back.
    """

    name: str
    delay: Floats
    sent: Floats
    duplicates: int
    round_trip: bool

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(n,) whether each message was lost."""
        return np.isnan(self.delay)

    @property
    def arrived(self) -> Floats:
        """(m,) the delays of what arrived."""
        return self.delay[~self.lost]

    @property
    def period(self) -> float | None:
        """Median time from one message to the next, in seconds; None where it is not known."""
        steps = np.diff(self.sent)
        steps = steps[np.isfinite(steps)]
        return float(np.median(steps)) if len(steps) and np.median(steps) > 0 else None

    @property
    def reordered(self) -> bool:
        """Whether a message overtook one that had left before, by more than rounding; False where that is not seen."""
        arrival = (self.sent + self.delay)[~self.lost]
        arrival = arrival[np.isfinite(arrival)]
        return bool((np.diff(arrival) < -0.01 * (self.period or 0.0)).any())


@dataclass(frozen=True)
class _Entry:
    seq: int | None
    sent: float
    delay: float


def read(path: Path, *, round_trip: bool = False) -> Log:
    """The log in a file.

    Args:
        path: the file.
        round_trip: whether the delays of a CSV file are of the way there and back, as those of ping always are.

    Raises:
        ConfigError: it cannot be read, or lines are malformed; each with its place.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError([Problem(f"cannot be read: {error.strerror}", Location(str(path)))]) from None
    except UnicodeDecodeError:
        raise ConfigError([Problem("this is no text, but a binary file", Location(str(path)))]) from None
    lines = text.splitlines()
    problems: list[Problem] = []
    is_ping = any(_PING.search(line) for line in lines[:50])
    entries = list(_read_ping(str(path), lines, problems) if is_ping else _read_csv(str(path), lines, problems))
    if problems:
        left_out = len(problems) - _MOST_PROBLEMS
        more = [Problem(f"{left_out} more lines are malformed", Location(str(path)))] if left_out > 0 else []
        raise ConfigError(problems[:_MOST_PROBLEMS] + more)
    return _log(path, entries, round_trip=is_ping or round_trip)


def _log(path: Path, entries: Sequence[_Entry], *, round_trip: bool) -> Log:
    """Entries in the order of sending, every message once, with those that are missing."""
    where = Location(str(path))
    if entries and all(entry.seq is not None for entry in entries):
        numbers = np.array([entry.seq for entry in entries], np.int64)
        order = np.argsort(numbers, kind="stable")
        first, last = int(numbers.min()), int(numbers.max())
        if last - first - len(entries) > _LARGEST_GAP:
            said = f"sequence numbers from {first} to {last}, but only {len(entries)} messages"
            raise ConfigError([Problem(said, where)])
        n = last - first + 1
        delay, sent = np.full(n, np.nan), np.full(n, np.nan)
        copies = np.zeros(n, np.int64)
        for i in order[::-1].tolist():  # the first line of a number is set last, and holds
            entry, index = entries[i], int(numbers[i]) - first
            copies[index] += not np.isnan(entry.delay)
            if not np.isnan(entry.delay) or np.isnan(delay[index]):
                delay[index] = entry.delay
            if not np.isnan(entry.sent):
                sent[index] = entry.sent
        duplicates = int((copies > 1).sum())
    else:
        by_time = sorted(entries, key=lambda entry: entry.sent)
        delay, sent = (np.array([getattr(entry, name) for entry in by_time]) for name in ("delay", "sent"))
        duplicates = 0
    arrived = int(np.isfinite(delay).sum())
    if len(delay) < LEAST or arrived < 2:
        said = f"{len(delay)} messages, of which {arrived} arrived, are too few; {LEAST} at least are needed"
        raise ConfigError([Problem(said, where)])
    return Log(path.name, delay, sent, duplicates, round_trip)


# --- CSV --------------------------------------------------------------------------------------------------------------
def _read_csv(name: str, lines: Sequence[str], problems: list[Problem]) -> Iterator[_Entry]:
    head = next(((i, line) for i, line in enumerate(lines) if line.partition("#")[0].strip()), None)
    if head is None:
        problems.append(Problem("the file is empty", Location(name, 1, 1)))
        return
    at, header = head
    separator = max(",;\t", key=header.count)
    columns: dict[str, tuple[int, str | None]] = {}
    for index, (cell, column) in enumerate(_cells(header, separator)):
        kind, unit = _column(cell)
        if kind in columns:
            problems.append(Problem(f"a second column {kind!r}", Location(name, at + 1, column)))
        columns.setdefault(kind, (index, unit))
    missing = []
    if "delay" not in columns:
        missing.append(f"there is no column 'delay'{suggest('delay', columns)}")
    if "seq" not in columns and "time" not in columns:
        missing.append("there is no column 'seq' or 'time', so that nobody knows the order of sending")
    problems += [
        Problem(f"{said}; the first line names the columns, such as seq,delay_ms", Location(name, at + 1, 1))
        for said in missing
    ]
    if problems:
        return
    latest = -math.inf
    for number, line in enumerate(lines[at + 1 :], at + 2):
        text = line.partition("#")[0]
        if not text.strip():
            continue
        cells = list(_cells(text, separator))
        found = {}
        for kind in ("seq", "time", "delay"):
            if kind not in columns:
                continue
            index, unit = columns[kind]
            if index >= len(cells):
                where = Location(name, number, len(text.rstrip()) + 1)
                problems.append(Problem(f"{len(cells)} cells: there is none for {kind!r}", where))
                break
            cell, column = cells[index]
            try:
                found[kind] = _value(kind, cell, unit)
            except ValueError as error:
                problems.append(Problem(f"{kind}: {error}", Location(name, number, column)))
        else:
            time = found.get("time", math.nan)
            if "seq" not in columns and time < latest:
                said = "time: messages must be in the order of sending, or have a 'seq'"
                problems.append(Problem(said, Location(name, number, cells[columns["time"][0]][1])))
            latest = max(latest, time) if "time" in found else latest
            if "delay" in found and found.keys() >= columns.keys() & {"seq", "time"}:
                seq = int(found["seq"]) if "seq" in found else None
                yield _Entry(seq, time, found["delay"])


def _cells(line: str, separator: str) -> Iterator[tuple[str, int]]:
    """Each cell's text, and the column at which it begins."""
    at = 0
    for cell in line.split(separator):
        text = cell.strip()
        yield text.strip('"'), at + (len(cell) - len(cell.lstrip()) if text else 0) + 1
        at += len(cell) + len(separator)


def _column(cell: str) -> tuple[str, str | None]:
    """`delay_ms`, `delay (ms)` or `Delay [ms]`: what it is, and its unit."""
    words = re.findall(r"[^\W_]+", cell.lower())
    return (words[0], words[1]) if len(words) == 2 and words[1] in _SECONDS else (" ".join(words), None)


def _value(kind: str, cell: str, unit: str | None) -> float:
    if kind == "delay" and cell.lower() in _LOST:
        return math.nan
    if kind == "seq":
        if not re.fullmatch(r"\d{1,15}", cell):
            raise ValueError(f"{cell!r} is no sequence number")
        return int(cell)
    if unit is not None or re.fullmatch(r"[+-]?[\d.]+([eE][+-]?\d+)?", cell):
        try:
            number = float(cell) * _SECONDS[unit or "s"]
        except ValueError:
            raise ValueError(f"{cell!r} is no number{f' of {unit}' if unit else ''}") from None
    else:
        number = parse_duration(cell) / 1e9
    if kind == "delay" and not 0 <= number < 1e6:
        raise ValueError(f"{cell!r}: a delay is 0 or more, and less than 1,000,000 s")
    if not np.isfinite(number):
        raise ValueError(f"{cell!r} is no time")
    return number


# --- ping -------------------------------------------------------------------------------------------------------------
_PING = re.compile(r"\bicmp_seq[= ]\d+|^PING ")
_SEQUENCE = re.compile(r"\bicmp_seq[= ](\d+)")
_TIME = re.compile(r"\btime[=<]\s*(\S+)\s+(ms|s|us|usec|sec)\b")
_STAMP = re.compile(r"^\[(\d+(?:\.\d+)?)\]")
_SENT = re.compile(r"^(\d+) packets transmitted")


def _read_ping(name: str, lines: Sequence[str], problems: list[Problem]) -> Iterator[_Entry]:
    """Every line with a sequence number; those that say of no time are losses. The summary says how many were sent."""
    first = last = None
    for number, line in enumerate(lines, 1):
        if (total := _SENT.match(line)) is not None and first is not None and last is not None:
            end = first + int(total[1]) - 1
            if last < end <= last + _LARGEST_GAP:
                yield _Entry(end, math.nan, math.nan)  # those between are missing, too
        sequence = _SEQUENCE.search(line)
        if sequence is None:
            continue
        seq = int(sequence[1])
        if last is not None:
            seq += round((last - seq) / _SEQUENCE_NUMBERS) * _SEQUENCE_NUMBERS
        first, last = (seq if first is None else first), seq if last is None else max(last, seq)
        time = _TIME.search(line)
        if time is None:
            if "bytes from" in line:
                where = Location(name, number, sequence.end() + 1)
                problems.append(Problem("an answer without its time, such as time=12.3 ms", where))
            else:
                yield _Entry(seq, math.nan, math.nan)
            continue
        try:
            delay = float(time[1]) * {"ms": 1e-3, "s": 1.0, "sec": 1.0}.get(time[2], 1e-6)
        except ValueError:
            problems.append(Problem(f"{time[1]!r} is no number", Location(name, number, time.start(1) + 1)))
            continue
        stamp = _STAMP.match(line)
        yield _Entry(seq, float(stamp[1]) - delay if stamp else math.nan, delay)
