"""State events: where an event indicator changes its sign (FMI 3.0, section 3.2.2), found to the nanosecond.

An indicator z has crossed where z > 0 holds on one side only. The search keeps a bracket of whole nanoseconds: no
indicator has crossed at its lower end, at least one has at its upper end. It proposes the earliest zero of the secants
through both ends (Illinois: an end that stays twice counts half), every third time the middle. `kernel/crossings.c`
does the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Floats
from network.units import NANOSECONDS_PER_SECOND, format_duration

STATE_EVENTS_PER_STEP = 100
"""How many state events may follow each other within the length of one micro step."""

FIRST_PART, GROWTH = 4096, 4
"""After a state event an indicator may soon cross twice, which no step that spans both would notice: the next step is
this part of a usual one, and each that follows as many times as long.
"""


def crossed(before: Floats, after: Floats) -> NDArray[np.bool_]:
    """Which indicators have changed their sign, zero counting as negative."""
    changed: NDArray[np.bool_] = (before > 0.0) != (after > 0.0)
    return changed


def bracket(start: float, reached: float, start_ns: int, end_ns: int, *, final: bool) -> tuple[int, int]:
    """The whole nanoseconds around a step.

    Args:
        start: of the step, in seconds.
        reached: its end, in seconds.
        start_ns: of the interval that the step is a part of.
        end_ns: of that interval.
        final: whether the step reaches its end.
    """
    low = min(max(start_ns, math.floor(start * NANOSECONDS_PER_SECOND)), end_ns - 1)
    high = end_ns if final else min(end_ns, math.floor(reached * NANOSECONDS_PER_SECOND) + 1)
    return low, max(high, low + 1)


def first_crossing(low: int, high: int, before: Floats, after: Floats, indicators: Callable[[int], Floats]) -> int:
    """The first nanosecond in (low, high] at which an indicator has crossed.

    Args:
        low: where none has crossed yet.
        high: where at least one has.
        before: the indicators at `low`.
        after: those at `high`.
        indicators: those at a time in between.
    """
    weight_low = weight_high = 1.0
    raised = lowered = False
    rounds = 0
    while high - low > 1:
        rounds += 1
        guess = (
            low + (high - low) // 2 if rounds % 3 == 0 else _secant(low, high, weight_low * before, weight_high * after)
        )
        found = indicators(guess)
        if crossed(before, found).any():
            high, after, weight_high = guess, found, 1.0
            weight_low = 0.5 * weight_low if lowered else 1.0
            raised, lowered = False, True
        else:
            low, before, weight_low = guess, found, 1.0
            weight_high = 0.5 * weight_high if raised else 1.0
            raised, lowered = True, False
    return high


def cautious_step(step_ns: int) -> int:
    """The step after a state event, in nanoseconds."""
    return max(step_ns // FIRST_PART, 1)


def less_cautious(cautious_ns: int, step_ns: int) -> int:
    """The step after a cautious one at which nothing crossed; 0 for a usual one."""
    longer = cautious_ns * GROWTH
    return longer if longer < step_ns else 0


def chattering(step_ns: int) -> str:
    """The message for a component whose state events never end."""
    return (
        f"had more than {STATE_EVENTS_PER_STEP} state events within one step of {format_duration(step_ns)}: an event "
        "indicator chatters. Give the model a hysteresis, or couple it as Co-Simulation: `coupling: {method: midpoint}`"
    )


def _secant(low: int, high: int, before: Floats, after: Floats) -> int:
    """The first whole nanosecond after the earliest zero of the secants, strictly between both ends."""
    share = 1.0
    for i in np.flatnonzero(crossed(before, after)).tolist():
        left, right = abs(before[i].item()), abs(after[i].item())
        share = min(share, left / (left + right) if left + right > 0.0 else 0.0)  # what is no number is no minimum
    length = high - low
    return low + min(max(math.ceil(share * float(length)), 1), length - 1)
