"""Components that keep to the rules, and some that break one each."""

import itertools
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import ClassVar

from cosim.components.python import Input, Output, Parameter, PythonComponent, State, Structural


class Lag(PythonComponent):
    """x' = (u - x) / T; y = x."""

    n = Structural(2)
    time_constant = Parameter(0.1, unit="s")
    u = Input(shape=("n",))
    x = State(shape=("n",))
    y = Output(shape=("n",), depends_on=())

    def derivatives(self, time: float) -> Mapping[str, object]:
        return {"x": (self.u - self.x) / self.time_constant}

    def outputs(self, time: float) -> None:
        self.y = self.x


class Ramp(PythonComponent):
    """Steps itself: y = the integral of u."""

    u = Input(1.0)
    y = Output(depends_on=())

    def step(self, time: float, step: float) -> None:
        self.y = self.y + self.u * step


class Forgetful(Ramp):
    """Takes every step for one of the same length."""

    def step(self, time: float, step: float) -> None:
        self.y = self.y + self.u


class Shared(Ramp):
    """Counts the steps of all its instances."""

    steps = itertools.count()

    def step(self, time: float, step: float) -> None:
        self.y = next(self.steps)


class Direct(PythonComponent):
    """Follows its input at once, and denies it."""

    u = Input()
    y = Output(depends_on=())

    def outputs(self, time: float) -> None:
        self.y = 2.0 * self.u


class Remembering(Lag):
    """Its derivative depends on what was asked before."""

    asked = 0

    def derivatives(self, time: float) -> Mapping[str, object]:
        self.asked += 1
        return {"x": self.u - self.x + 1e-3 * self.asked}


class Switched(PythonComponent):
    """Cannot be switched on."""

    on = Input(dtype="Boolean")
    x = State(1.0)
    y = Output(depends_on=("on",))

    def derivatives(self, time: float) -> Mapping[str, object]:
        return {"x": -self.x}

    def outputs(self, time: float) -> None:
        if self.on:
            raise ValueError("there is no light")
        self.y = self.x


class Fixed(Lag):
    """Its arrays have one size only."""

    def outputs(self, time: float) -> None:
        self.y[1] = self.x[1]


class Fragile(Ramp):
    """NaN ends the process."""

    def step(self, time: float, step: float) -> None:
        if self.u != self.u:
            print("what is this?", flush=True)
            os.abort()
        super().step(time, step)


class Endless(Ramp):
    """NaN never ends."""

    def step(self, time: float, step: float) -> None:
        while self.u != self.u:
            pass
        super().step(time, step)


class Counting(Ramp):
    """Holds more than its variables."""

    def initialise(self, time: float) -> None:
        self.past: list[float] = []

    def step(self, time: float, step: float) -> None:
        self.past.append(self.u)
        self.y = sum(self.past) * step


class Blurting(Counting):
    """Saves what goes on changing."""

    def save(self) -> list[float]:
        return self.past

    def restore(self, saved: list[float]) -> None:
        self.past = saved


class Closing(Ramp):
    """Takes its process' descriptors for its own, and never ends."""

    def initialise(self, time: float) -> None:
        os.closerange(0, 1024)
        while True:
            pass


class Staying(Ramp):
    """Never ends, and holds the FIFO at `$STAYING` open for as long as its process and the one that it starts live."""

    def initialise(self, time: float) -> None:
        descriptor = os.open(os.environ["STAYING"], os.O_WRONLY)
        os.set_inheritable(descriptor, True)
        other = subprocess.Popen([sys.executable, "-c", "while True: pass"], close_fds=False)
        os.write(descriptor, f"{os.getpid()} {other.pid}\n".encode())
        while True:
            pass


class Picky(Ramp):
    """Refuses what it declares."""

    def initialise(self, time: float) -> None:
        if self.u == 1.0:
            raise ValueError("1 is no good start")


class Once(Ramp):
    """One in a process, ever: as of an FMU that frees at its end what the next one needs."""

    _begun: ClassVar[list[object]] = []

    def initialise(self, time: float) -> None:
        if not any(other is self for other in self._begun):
            self._begun.append(self)
        if len(self._begun) > 1:
            os.abort()
