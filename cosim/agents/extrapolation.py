"""How far `midpoint` extrapolates an output, to the middle of a step, from its last two values.

Exactly, where the step is at most twice as long as the one before. Beyond that the weight of the last change falls as
the lengths drift apart. For at an arrival an output may jump by J, and whoever steps before its owner sees that a step
of length g late: an error of J g. The step after that, of length h, takes J for a slope and adds w J, so that what is
left is J (g - w h). With w = h / 2g up to h = 2g, and 2g / h from there on, that is never more than J g: a jump costs
what it costs where outputs are held, however short the step before was, and half of it where both are alike.
"""

from __future__ import annotations

LONGER = 2.0
"""How many times as long as the one before a step may be, to be extrapolated into exactly."""


def middle_weight(step: float, previous_step: float) -> float:
    """The weight of an output's last change, from one step's start to the next one's.

    Args:
        step: its length, in seconds.
        previous_step: that of the one before, over which the output changed; 0 where there was none.
    """
    if previous_step <= 0.0:
        return 0.0
    ratio = step / previous_step
    return 0.5 * ratio if ratio <= LONGER else LONGER / ratio
