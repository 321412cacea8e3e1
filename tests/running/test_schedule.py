"""When ticks are released and what counts as missed, with a clock that moves only as it is told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import CosimError, OverrunError
from cosim.running.pacing import SLICE_SECONDS, Overrun, Pacer, parse_factor
from tests.distributed.networks import planned, scenario

PLAN = planned(scenario(1, []))  # T = 100 ms
MS = 1_000_000
FACTORS = st.sampled_from([Fraction(1), Fraction(3), Fraction(1, 3), Fraction(7, 10), Fraction(50)])


@dataclass
class Wall:
    """A clock, and a sleep that takes longer than it was asked to."""

    now_ns: int = 123_456_789
    oversleep_ns: int = 0
    longest_sleep: float = 0.0

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.longest_sleep = max(self.longest_sleep, seconds)
        self.now_ns += max(1, math.floor(seconds * 1e9)) + self.oversleep_ns  # now and then a little short


@dataclass
class Played:
    """A run with given durations of its ticks, in ns of wall time."""

    work: list[int]
    factor: Fraction = Fraction(1)
    overrun: Overrun = Overrun.WARN
    oversleep_ns: int = 0
    started: list[int] = field(default_factory=list)
    done: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.wall = Wall(oversleep_ns=self.oversleep_ns)
        self.pacer = Pacer(
            PLAN, self.factor, self.overrun, say=self.said.append, clock=self.wall.clock, sleep=self.wall.sleep
        )
        self.pacer.start()
        self.t0 = self.wall.now_ns
        for tick, work in enumerate(self.work):
            assert self.pacer.wait(tick)
            self.started.append(self.wall.now_ns)
            self.wall.now_ns += work
            self.done.append(self.wall.now_ns)
            self.pacer.tick(tick, np.zeros(0))

    def release(self, tick: int) -> Fraction:
        """As the definition has it, without stretching."""
        return self.t0 + tick * Fraction(PLAN.period_ns) / self.factor


works = st.lists(st.integers(0, 400 * MS), min_size=1, max_size=40)


@given(works, FACTORS, st.sampled_from([Overrun.WARN, Overrun.STRETCH]), st.sampled_from([0, 60_000, 5 * MS]))
def test_no_tick_begins_before_its_release(work: list[int], factor: Fraction, overrun: Overrun, over: int) -> None:
    run = Played(work, factor, overrun, over)
    for tick, started in enumerate(run.started):
        assert started >= run.release(tick)
    assert run.wall.longest_sleep <= SLICE_SECONDS


@given(works, FACTORS)
def test_warn_keeps_the_schedule_and_catches_up(work: list[int], factor: Fraction) -> None:
    run = Played(work, factor)
    before = run.t0
    for tick, started in enumerate(run.started):
        assert started <= max(before, math.ceil(run.release(tick)) + 1)  # at its release, or as soon as it can
        before = run.done[tick]
    missed = [tick for tick, done in enumerate(run.done) if done > math.ceil(run.release(tick + 1))]
    assert run.pacer.missed == len(missed)
    report = run.pacer.report()
    late = [done - math.ceil(run.release(tick)) for tick, done in enumerate(run.done)]
    assert report["lateness_s"]["max"] == max(late) / 1e9
    assert report["ticks"] == len(work)
    assert report["stretched_s"] == 0


@given(works, FACTORS)
def test_stretch_never_catches_up(work: list[int], factor: Fraction) -> None:
    run = Played(work, factor, Overrun.STRETCH)
    period = Fraction(PLAN.period_ns) / factor
    release, missed, shift = run.t0, 0, 0
    for tick, (started, done) in enumerate(zip(run.started, run.done, strict=True)):
        release = run.t0 + shift + math.ceil(tick * period)
        assert release <= started <= release + 1  # never late: it waits for nothing but its release
        behind = done - (run.t0 + shift + math.ceil((tick + 1) * period))
        if behind > 0:
            missed += 1
            shift += behind
    assert run.pacer.missed == missed
    assert run.pacer.report()["stretched_s"] == shift / 1e9
    gaps = [later - earlier for earlier, later in zip(run.started, run.started[1:], strict=False)]
    assert all(gap >= math.floor(period) - 1 for gap in gaps)


@given(works)
def test_abort_ends_with_the_first_tick_that_is_missed(work: list[int]) -> None:
    free = Played(work)
    late = [tick for tick, done in enumerate(free.done) if done > free.release(tick + 1)]
    if not late:
        assert Played(work, overrun=Overrun.ABORT).pacer.missed == 0
        return
    with pytest.raises(OverrunError, match=rf"^overrun: tick {late[0]} \(t = {late[0] / 10:g} s\) was complete "):
        Played(work, overrun=Overrun.ABORT)


def test_a_tick_that_is_complete_at_its_deadline_is_not_missed() -> None:
    assert Played([100 * MS] * 3).pacer.missed == 0
    assert Played([100 * MS + 1, 0, 0]).pacer.missed == 1


def test_one_long_tick_and_the_way_back() -> None:
    run = Played([1 * MS, 350 * MS, *[10 * MS] * 5])
    assert [(start - run.t0) // MS for start in run.started] == [0, 100, 450, 460, 470, 500, 600]
    assert run.pacer.missed == 3  # ticks 1, 2 and 3; the fourth is complete at 480 ms, before its deadline
    stretched = Played([1 * MS, 350 * MS, *[10 * MS] * 5], overrun=Overrun.STRETCH)
    assert [(start - run.t0) // MS for start in stretched.started] == [0, 100, 450, 550, 650, 750, 850]
    assert stretched.pacer.missed == 1
    assert stretched.said == []


def test_warnings_come_once_a_second_and_in_total() -> None:
    run = Played([150 * MS] * 40)  # 6 s, always late
    assert len(run.said) == 6
    assert run.said[0] == (
        "overrun: tick 0 (t = 0 s) was complete 150 ms after its release, 50 ms after its deadline; "
        "1 of 1 ticks missed so far"
    )
    run.pacer.say_total()
    assert run.said[-1] == "40 of 40 ticks missed; largest lateness 2.1 s"


@given(works, st.integers(0, 10**10), st.sampled_from(list(Overrun)[::2]))
def test_released_is_the_last_tick_whose_release_has_come(work: list[int], later: int, overrun: Overrun) -> None:
    run = Played(work, Fraction(7, 10), overrun)
    run.wall.now_ns += later
    tick = run.pacer.released()
    assert run.pacer.remaining(tick) == 0
    assert run.pacer.remaining(tick + 1) > 0
    if overrun is Overrun.STRETCH:
        assert tick <= len(work)


def test_a_request_to_stop_ends_a_long_wait() -> None:
    wall = Wall()
    pacer = Pacer(PLAN, Fraction(1, 1000), clock=wall.clock, sleep=wall.sleep)
    pacer.start()
    began = wall.now_ns
    assert not pacer.wait(1, lambda: wall.now_ns - began > 50 * MS)
    assert wall.now_ns - began <= 50 * MS + 1.01 * SLICE_SECONDS * 1e9


@pytest.mark.parametrize("text", ["0", "-1", "-0.0", "nan", "inf", "1e-400", "1e400"])
def test_factors_that_are_no_pace(text: str) -> None:
    with pytest.raises(ValueError, match=r"must be finite and above 0: FACTOR is simulated seconds per second"):
        parse_factor(text)


@pytest.mark.parametrize("text", ["", "fast", "net.yaml", "1 s", "1/2"])
def test_text_is_no_factor(text: str) -> None:
    with pytest.raises(ValueError, match=r"is no number: .*CONFIG goes before --realtime"):
        parse_factor(text)


def test_factors_are_taken_as_written() -> None:
    assert parse_factor("0.1") == Fraction(1, 10)
    assert parse_factor("1e3") == 1000


def test_a_pace_that_nobody_can_keep_is_refused() -> None:
    Pacer(PLAN, Fraction(100_000))
    with pytest.raises(CosimError, match=r"leaves 999 ns .* the factor can be at most 100000"):
        Pacer(PLAN, Fraction(100_100))
