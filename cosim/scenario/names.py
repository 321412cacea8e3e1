"""Names: of agents, as ranges and lists and back to what people like to read; of scenarios."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

_RANGE = re.compile(r"(?P<prefix>[^\d.](?:.*[^\d.])?)?(?P<first>\d+)\.\.(?P<last>\d+)")
_AGENT = re.compile(r"\w(?:[\w-]*\w)?")
_NUMBERED = re.compile(r"(?P<prefix>.*?)(?P<number>0|[1-9]\d*)")
_MAX_RANGE = 100_000


def agent_names(text: str) -> Iterator[str]:
    """The agents that `1..10`, `arm1..10` or `1, 4, 7..9` stands for, in that order.

    Raises:
        ValueError: a name that is none, or a range that runs backwards.
    """
    for part in (part.strip() for part in text.split(",")):
        if match := _RANGE.fullmatch(part):
            prefix, first, last = match["prefix"] or "", match["first"], match["last"]
            if not 0 <= int(last) - int(first) < _MAX_RANGE:
                raise ValueError(f"the range {part!r} must run upwards, over at most {_MAX_RANGE} agents")
            width = len(first) if first.startswith("0") else 0
            yield from (f"{prefix}{number:0{width}}" for number in range(int(first), int(last) + 1))
        elif _AGENT.fullmatch(part):
            yield part
        else:
            raise ValueError(
                f"{part!r} names no agent; a name is letters, digits, '_' and '-', a range is '1..10', a list is '1, 4'"
            )


def in_short(names: Iterable[str]) -> str:
    """The names in their order, three or more that count upwards as a range: `1, 4..10, hub`."""
    runs: list[list[str]] = []
    for name in names:
        if runs and _follows(runs[-1][-1], name):
            runs[-1].append(name)
        else:
            runs.append([name])
    parts = [part for run in runs for part in ([_range(run)] if len(run) > 2 else run)]
    return ", ".join(parts)


def _follows(name: str, next_name: str) -> bool:
    one, two = _NUMBERED.fullmatch(name), _NUMBERED.fullmatch(next_name)
    return bool(one and two and one["prefix"] == two["prefix"] and int(two["number"]) == int(one["number"]) + 1)


def _range(run: list[str]) -> str:
    match = _NUMBERED.fullmatch(run[-1])
    return f"{run[0]}..{match['number'] if match else run[-1]}"


def scenario_name(text: str) -> str:
    """The name itself, if a scenario can have it.

    Raises:
        ValueError: it cannot.
    """
    if not re.fullmatch(r"\w[\w.-]*", text):
        raise ValueError(
            f"{text!r} cannot name a scenario, whose runs get a folder of that name; use letters, digits, '_' and '-'"
        )
    return text
