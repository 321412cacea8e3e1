"""Channel models as users write them: one that keeps the rules, and one for each way to break them."""

from __future__ import annotations

import random
import time
from typing import Any, ClassVar, Literal

import numpy as np

from network.channel import Batch, Channel, ChannelModel, Setting, Transmission
from network.messages import NEVER, Ints
from network.units import Duration, Probability


class Tired(ChannelModel):
    """A radio that sleeps for some messages after each that it loses."""

    model: Literal["tired"] = "tired"
    loss: Probability = 0.1
    sleep: int = 3
    delay: Duration = 20_000_000

    def open(self, setting: Setting) -> Channel:
        return Radio(self, setting)

    def min_delay_ns(self) -> int:
        return self.delay


class Radio(Channel):
    def __init__(self, model: Any, setting: Setting) -> None:
        self.model, self.setting, self.n = model, setting, len(setting.links)
        self.asleep = np.zeros(self.n, np.int64)

    def transmit(self, tick: int) -> Transmission:
        lost = (self.uniform(tick) < self.model.loss) | (self.asleep > 0)
        self.asleep = np.where(self.asleep > 0, self.asleep - 1, np.where(lost, self.model.sleep, 0))
        return self.sent(tick, np.where(lost, NEVER, self.model.delay))

    def uniform(self, tick: int) -> Any:
        return self.setting.draws.uniform("loss", tick)

    def sent(self, tick: int, delay: Any, stamp: int | None = None) -> Transmission:
        zeros: Ints = np.zeros(self.n, np.int64)
        return Transmission(np.arange(self.n), zeros + (tick if stamp is None else stamp), delay, zeros)


# --- what breaks a rule ----------------------------------------------------------------------------------------------
class GlobalDraws(Tired):
    def open(self, setting: Setting) -> Channel:
        return GlobalDrawsRadio(self, setting)


class GlobalDrawsRadio(Radio):
    def uniform(self, tick: int) -> Any:
        return np.array([random.random() for _ in range(self.n)])


class Clock(Tired):
    def open(self, setting: Setting) -> Channel:
        return ClockRadio(self, setting)


class ClockRadio(Radio):
    def uniform(self, tick: int) -> Any:
        return np.full(self.n, time.perf_counter_ns() % 1000 / 1000)


class ClassState(Tired):
    def open(self, setting: Setting) -> Channel:
        return ClassStateRadio(self, setting)


class ClassStateRadio(Radio):
    calls: ClassVar[list[int]] = []

    def transmit(self, tick: int) -> Transmission:
        self.calls.append(tick)
        return self.sent(tick, np.full(self.n, self.model.delay + len(self.calls)))


class FirstEdgesDraw(Tired):
    def open(self, setting: Setting) -> Channel:
        return FirstEdgesDrawRadio(self, setting)


class FirstEdgesDrawRadio(Radio):
    def uniform(self, tick: int) -> Any:
        return np.full(self.n, super().uniform(tick)[0])


class SharedMedium(Tired):
    def open(self, setting: Setting) -> Channel:
        return SharedMediumRadio(self, setting)


class SharedMediumRadio(Radio):
    def transmit(self, tick: int) -> Transmission:
        return self.sent(tick, self.model.delay * np.arange(1, self.n + 1))


class Hurried(Tired):
    def open(self, setting: Setting) -> Channel:
        return HurriedRadio(self, setting)


class HurriedRadio(Radio):
    def transmit(self, tick: int) -> Transmission:
        return self.sent(tick, np.full(self.n, self.model.delay - 50_000_000))


class Prophet(Tired):
    def open(self, setting: Setting) -> Channel:
        return ProphetRadio(self, setting)


class ProphetRadio(Radio):
    def transmit(self, tick: int) -> Transmission:
        return self.sent(tick, np.zeros(self.n, np.int64), stamp=tick + 1)


class Floating(Tired):
    def open(self, setting: Setting) -> Channel:
        return FloatingRadio(self, setting)


class FloatingRadio(Radio):
    def transmit(self, tick: int) -> Transmission:
        return self.sent(tick, np.full(self.n, 0.02))


class Failing(Tired):
    def open(self, setting: Setting) -> Channel:
        return FailingRadio(self, setting)


class FailingRadio(Radio):
    def transmit(self, tick: int) -> Transmission:
        if tick == 7:
            raise ZeroDivisionError("my mistake")
        return super().transmit(tick)


class FailingLate(Tired):
    def open(self, setting: Setting) -> Channel:
        return FailingLateRadio(self, setting)


class FailingLateRadio(Radio):
    def transmit(self, tick: int) -> Transmission:
        if tick == 150:
            raise KeyError("a route")
        return super().transmit(tick)


class Promising(Tired):
    def min_delay_ns(self) -> int:
        return 2 * self.delay


class AgePromising(Tired):
    def age_bound_ns(self, period_ns: int) -> int | None:
        return 2 * period_ns


class Unpicklable(Tired):
    def open(self, setting: Setting) -> Channel:
        return UnpicklableRadio(self, setting)


class UnpicklableRadio(Radio):
    def __init__(self, model: Any, setting: Setting) -> None:
        super().__init__(model, setting)
        self.uniform = lambda tick: setting.draws.uniform("loss", tick)  # type: ignore[method-assign]


class Recycling(Tired):
    def open(self, setting: Setting) -> Channel:
        return RecyclingRadio(self, setting)


class RecyclingRadio(Radio):
    def __init__(self, model: Any, setting: Setting) -> None:
        super().__init__(model, setting)
        self.delay = np.zeros(self.n, np.int64)

    def transmit(self, tick: int) -> Transmission:
        self.delay[:] = super().transmit(tick).delay_ns
        return self.sent(tick, self.delay)


class Hasty(Tired):
    def open(self, setting: Setting) -> Channel:
        return HastyRadio(self, setting)


class HastyRadio(Radio):
    def transmit_many(self, ticks: range) -> Batch:
        last = self.transmit(ticks[-1])
        return Batch.of(ticks, [self.sent(tick, last.delay_ns) for tick in ticks])


class Forgetful(Tired):
    def as_written(self) -> dict[str, Any]:
        return {"model": "tired", "sleep": self.sleep + 1}
