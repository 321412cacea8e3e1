"""Components for networks of little ones: a node that averages what it hears, and nodes with a fault of some kind."""

from __future__ import annotations

import gc
import math
import os
import resource
import signal
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import sleep
from typing import Any

from cosim.components.python import EndSimulation, Input, Output, Parameter, PythonComponent, State, Structural
from network.zenoh import ZenohEndpoint


class Node(PythonComponent):
    """x' = mean of what is heard - x; publishes x."""

    count = Structural(0)
    heard = Input(shape=("count", 2))
    stamp = Input(-1, shape=("count",), dtype="Int64")
    at = Parameter(math.inf, unit="s", description="when the fault of a derived class happens")
    x = State(shape=(2,))
    y = Output(shape=(2,), depends_on=())

    def outputs(self, time: float) -> None:
        self.y = self.x

    def derivatives(self, time: float) -> Mapping[str, Any]:
        if time >= self.at:
            self.fault(time)
        known = self.stamp >= 0
        pull = self.heard[known].mean(axis=0) if known.any() else 0.0
        return {"x": pull - self.x + math.sin(time)}

    def fault(self, time: float) -> None:
        """None."""


class Failing(Node):
    """Raises."""

    def fault(self, time: float) -> None:
        raise ValueError("the gearbox is broken")


class Ending(Node):
    """Has enough, for no bad reason."""

    def fault(self, time: float) -> None:
        raise EndSimulation("the goal is reached")


class Slow(Node):
    """Takes half a second of wall time, once."""

    slept = False

    def fault(self, time: float) -> None:
        if not self.slept:
            self.slept = True
            sleep(0.5)


class Hanging(Node):
    """Never comes back."""

    def fault(self, time: float) -> None:
        while True:
            signal.pause()


class Killed(Node):
    """The whole process is killed."""

    def fault(self, time: float) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class Stopped(Node):
    """The whole process is stopped."""

    def fault(self, time: float) -> None:
        os.kill(os.getpid(), signal.SIGSTOP)


class Exiting(Node):
    """The process ends without a word."""

    def fault(self, time: float) -> None:
        os._exit(7)


class OrphanMaker(Node):
    """Kills the process that started this one."""

    def fault(self, time: float) -> None:
        os.kill(os.getppid(), signal.SIGKILL)
        signal.pause()


class Once(Node):
    """A fault that happens to the first process that comes to it, not to the one that replaces it."""

    def fault(self, time: float) -> None:
        try:
            (Path(os.environ["COSIM_TEST_FOLDER"]) / "done").touch(exist_ok=False)
        except FileExistsError:
            return
        super().fault(time)


class OnceHanging(Once, Hanging):
    """Hangs once."""


class OnceStopped(Once, Stopped):
    """Is stopped once."""


class OnceExiting(Once, Exiting):
    """Exits once."""


HARMS = ("lost", "twice", "overtaken", "damaged", "cut off")


class Harm:
    """What happens on the wire to the second message to each receiver."""

    def __init__(self, harm: str) -> None:
        self._harm = harm
        self._seen: Counter[str] = Counter()
        self._held: dict[str, bytes] = {}

    def __call__(self, _sender: str, receiver: str, frame: bytes) -> Sequence[bytes]:
        self._seen[receiver] += 1
        if receiver in self._held:
            return [frame, self._held.pop(receiver)]
        if self._seen[receiver] != 2:
            return [frame]
        if self._harm == "overtaken":
            self._held[receiver] = frame
        damaged = bytes([*frame[:-1], frame[-1] ^ 1])
        return {"twice": [frame, frame], "damaged": [damaged], "cut off": [frame[:-1]]}.get(self._harm, [])


class Tampering(Node):
    """Lets what this process sends to others come to harm from then on."""

    harm = Parameter(0, dtype="Int64", description="index in HARMS")
    harmed = False

    def fault(self, time: float) -> None:
        if not self.harmed:
            self.harmed = True
            (endpoint,) = [thing for thing in gc.get_objects() if isinstance(thing, ZenohEndpoint)]
            endpoint._tamper = Harm(HARMS[int(self.harm)])


class Greedy(Node):
    """Wants more memory than its process may have."""

    def fault(self, time: float) -> None:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), resource.RLIM_INFINITY))
        self.hoard = bytearray(1 << 30)
