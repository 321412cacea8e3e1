"""Paces a run against the wall: when a tick is released, how late it is complete, what happens on an overrun.

Tick k is released at t0 + k T/FACTOR, t0 being when everything is initialised; what leads to its sample, the advance
from tick k - 1, begins no earlier. Its lateness is the time from its release until all observers have seen its rows,
its deadline the release of tick k + 1. A tick that is complete later than that is missed: an overrun.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from decimal import Decimal
from enum import StrEnum
from fractions import Fraction
from typing import Any

from cosim.components.component import Floats
from cosim.errors import CosimError, OverrunError
from cosim.plan import Plan
from cosim.running.lateness import Course, Durations
from network.messages import Fates
from network.units import NANOSECONDS_PER_SECOND, to_seconds

SLICE_SECONDS = 0.02
"""A wait is cut into pieces of at most this, so that a request to stop is heard."""

_SAY_NS = NANOSECONDS_PER_SECOND
_LEAST_PERIOD_NS = 1000
_PR_SET_TIMERSLACK = 29


class Overrun(StrEnum):
    """What happens when a tick is missed."""

    WARN = "warn"
    """The schedule stays; the run catches up."""
    ABORT = "abort"
    """The run ends."""
    STRETCH = "stretch"
    """The schedule moves: the next tick is released when the late one is complete."""


def parse_factor(text: str) -> Fraction:
    """Simulated seconds per second of wall time, exactly as written.

    Raises:
        ValueError: no number above 0.
    """
    hint = "FACTOR is simulated seconds per second of wall time, such as 1, 0.5 or 10"
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{text!r} is no number: {hint} (CONFIG goes before --realtime)") from None
    if not math.isfinite(value) or value <= 0:
        raise ValueError(f"{text!r} must be finite and above 0: {hint}")
    return Fraction(Decimal(text))


class Pacer:
    """The schedule of a run, and an observer, the last of all, that measures how it is kept.

    The call order is `start`, then per tick `wait` (or `released` and `begun` where somebody else waits) and `tick`.

    Args:
        plan: what runs.
        factor: simulated seconds per second of wall time.
        overrun: what happens when a tick is missed.
        say: where warnings go.
        clock: monotonic, in ns.
        sleep: for so many seconds, or longer.

    Raises:
        CosimError: nobody can keep such a schedule.
    """

    def __init__(
        self,
        plan: Plan,
        factor: Fraction = Fraction(1),
        overrun: Overrun = Overrun.WARN,
        *,
        say: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._simulated_ns = plan.period_ns
        self._period_ns = plan.period_ns / factor
        if self._period_ns < _LEAST_PERIOD_NS:
            raise CosimError(
                f"--realtime {float(factor):g}: the period of {to_seconds(plan.period_ns):g} s leaves "
                f"{float(self._period_ns):.3g} ns of wall time per tick; the factor can be at most "
                f"{plan.period_ns // _LEAST_PERIOD_NS}"
            )
        self.factor = float(factor)
        self.overrun = overrun
        self._say = say
        self._clock = clock
        self._sleep = sleep
        self._started_ns: int | None = None
        self._shift_ns = 0
        self._seen = -1
        self._seen_ns = 0
        self._said_ns = -_SAY_NS
        self._lateness = Durations()
        self._jitter = Durations()
        self._course = Course()
        self.missed = 0

    # --- the schedule -----------------------------------------------------------------------------------------------
    def start(self) -> None:
        """Everything is initialised: t0 is now."""
        self._started_ns = self._clock()

    def release_ns(self, tick: int) -> int:
        """When a tick is released, on the clock; with `stretch`, as far as is known."""
        if self._started_ns is None:
            raise RuntimeError("the pacer has not been started")
        return self._started_ns + self._shift_ns + math.ceil(tick * self._period_ns)

    def remaining(self, tick: int) -> float:
        """Seconds until the release of a tick, at least 0; infinite while it is not known."""
        if self.overrun is Overrun.STRETCH and tick > self._seen + 1:
            return math.inf
        return max(0, self.release_ns(tick) - self._clock()) / NANOSECONDS_PER_SECOND

    def released(self) -> int:
        """The last tick that is released by now."""
        tick = math.floor((self._clock() - self.release_ns(0)) / self._period_ns)
        return min(tick, self._seen + 1) if self.overrun is Overrun.STRETCH else tick

    def wait(self, tick: int, stop_requested: Callable[[], bool] = lambda: False) -> bool:
        """Wait for the release of a tick; False if somebody asked to stop before it."""
        if (left := self.remaining(tick)) > 0:
            while left > 0:
                if stop_requested():
                    return False
                self._sleep(min(left, SLICE_SECONDS))
                left = self.remaining(tick)
            self.begun(tick)
        return not stop_requested()

    def begun(self, tick: int) -> None:
        """Work that was waiting for the release of a tick has begun."""
        self._jitter.add(self._clock() - self.release_ns(tick))

    # --- what became of it ------------------------------------------------------------------------------------------
    def tick(self, tick: int, row: Floats) -> None:  # noqa: ARG002
        """A tick is complete, and all others have seen it.

        Raises:
            OverrunError: it is missed, and that is to end the run.
        """
        now = self._clock()
        late = now - self.release_ns(tick)
        self._seen, self._seen_ns = tick, now
        self._lateness.add(late)
        self._course.add(late)
        behind = now - self.release_ns(tick + 1)
        if behind <= 0:
            return
        self.missed += 1
        if self.overrun is Overrun.STRETCH:
            self._shift_ns += behind
            return
        text = (
            f"overrun: tick {tick} (t = {to_seconds(tick * self._simulated_ns):.9g} s) was complete "
            f"{_duration(late)} after its release, {_duration(behind)} after its deadline"
        )
        if self.overrun is Overrun.ABORT:
            raise OverrunError(text)
        if now - self._said_ns >= _SAY_NS:
            self._said_ns = now
            self._say(f"{text}; {self.missed} of {tick + 1} ticks missed so far")

    def fates(self, fates: Fates) -> None:
        """Not timed: a tick's rows are complete before its messages have fates."""

    @property
    def reached(self) -> float:
        """Simulated seconds per second of wall time, from t0 to the last complete tick; 0 before the second one."""
        if self._started_ns is None or self._seen < 1:
            return 0.0
        return self._seen * self._simulated_ns / max(1, self._seen_ns - self._started_ns)

    def report(self) -> dict[str, Any]:
        """The entry `realtime` of the manifest; durations in seconds of wall time, see docs/design.md."""
        return {
            "factor": self.factor,
            "overrun": self.overrun.value,
            "reached": round(self.reached, 6),
            "period_s": float(self._period_ns) / NANOSECONDS_PER_SECOND,
            "ticks": self._lateness.count,
            "missed": self.missed,
            "stretched_s": self._shift_ns / NANOSECONDS_PER_SECOND,
            "lateness_s": self._lateness.summary(),
            "jitter_s": self._jitter.summary(),
            "course_s": self._course.summary(),
        }

    def __str__(self) -> str:
        """For the end of a run, in a few lines of equal indentation."""
        lines = [f"  real-time factor         {self.reached:.6g} reached, {self.factor:g} wanted"]
        if self._lateness.count:
            figures = ", ".join(f"{name} {_seconds(value)}" for name, value in self._lateness.summary().items())
            lines.append(f"  lateness of ticks        {figures}")
            stretched = f"; the schedule was stretched by {_duration(self._shift_ns)}" if self._shift_ns else ""
            lines.append(f"  missed ticks             {self.missed} of {self._lateness.count}{stretched}")
        return "\n".join(lines)

    def say_total(self) -> None:
        """Say how many ticks were missed, where the policy is to warn of it."""
        if self.missed and self.overrun is Overrun.WARN:
            largest = _duration(self._lateness.largest_ns)
            self._say(f"{self.missed} of {self._lateness.count} ticks missed; largest lateness {largest}")


def precise_timers() -> None:
    """Let this thread, and those it starts, sleep as exactly as Linux can: without the usual slack of 50 µs.

    No privilege is needed, and processor time is not spent on it (`PR_SET_TIMERSLACK`, prctl(2)). Nothing elsewhere.
    """
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def _duration(duration_ns: int) -> str:
    return _seconds(duration_ns / NANOSECONDS_PER_SECOND)


def _seconds(seconds: float | None) -> str:
    """As people read it: 0.21 ms, 130 ms, 2.5 s."""
    if seconds is None:
        return "–"
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"
