"""The exchange that every contestant of `benchmarks.distributed` does, and what its programs share.

Agents sit in workers, in contiguous blocks. Every step each agent sends 64 bytes (its number, the step, six zeros), and
a delaying component in a process of its own passes them on to the agent's two followers in a circle. A sample of step k
is in the hands of both in step k + 3, and every worker checks in every step that it is. All samples of a worker travel
as one message to the delaying component, and all deliveries as one message back: nobody sends a message per agent.

Needs NumPy only, so that it runs in an environment that holds a peer and not netcosim.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

WIDTH = 8
SENDERS = (1, 2)
"""Agent i hears agents i - 1 and i - 2, in a circle."""
AGE = 3
"""In how many steps a sample is in the hands of who it is for."""
NOTHING = -1.0
"""The step of a sample that has not been taken."""


@dataclass(frozen=True)
class Shape:
    """How many agents in how many workers, for how many steps after how many to warm up."""

    agents: int
    workers: int
    steps: int
    warm_up: int

    @property
    def total(self) -> int:
        """All steps."""
        return self.warm_up + self.steps

    def block(self, worker: int) -> tuple[int, int]:
        """First agent of a worker, and the one after its last."""
        return worker * self.agents // self.workers, (worker + 1) * self.agents // self.workers


class WrongExchangeError(Exception):
    """A delivery that is not what was sent."""


class Agents:
    """A worker's agents: what they send, and whether what they hear is right."""

    def __init__(self, shape: Shape, worker: int) -> None:
        first, end = shape.block(worker)
        self._values = np.zeros((end - first, WIDTH))
        self._values[:, 0] = np.arange(first, end)
        self._heard = (np.arange(first, end)[:, None] - SENDERS) % shape.agents

    def samples(self, step: int) -> bytes:
        """64 bytes of every agent."""
        self._values[:, 1] = step
        return self._values.tobytes()

    def hear(self, step: int, mail: bytes) -> None:
        """Take what is due at `step`.

        Raises:
            WrongExchangeError: it comes from another agent, another step, or is not complete.
        """
        rows = np.frombuffer(mail).reshape(len(self._values), len(SENDERS), WIDTH)
        stamp = step - AGE if step >= AGE else NOTHING
        if not (np.array_equal(rows[:, :, 0], self._heard) and (rows[:, :, 1] == stamp).all()):
            raise WrongExchangeError(f"step {step}: expected samples of step {stamp:g}, got {rows[:, :, :2].tolist()}")


class Delayer:
    """The delaying component.

    Args:
        shape: who is there.
        hold: for how many steps it keeps a sample: `AGE` less the steps that its way takes anyhow.
    """

    def __init__(self, shape: Shape, hold: int) -> None:
        self._heard = [
            (np.arange(*shape.block(worker))[:, None] - SENDERS) % shape.agents for worker in range(shape.workers)
        ]
        nothing = np.zeros((shape.agents, WIDTH))
        nothing[:, 0] = np.arange(shape.agents)
        nothing[:, 1] = NOTHING
        self._nothing = nothing
        self._held = deque([nothing] * hold)

    def exchange(self, samples: Sequence[bytes]) -> list[bytes]:
        """Every worker's samples of a step in, every worker's mail out; no samples at all means none were taken."""
        self._held.append(np.frombuffer(b"".join(samples)).reshape(-1, WIDTH) if samples else self._nothing)
        due = self._held.popleft()
        return [due[heard].tobytes() for heard in self._heard]

    def nothing(self) -> list[bytes]:
        """Mail of a step before the first sample."""
        return [self._nothing[heard].tobytes() for heard in self._heard]


class Stopwatch:
    """Steps per second, without those to warm up and without the start."""

    def __init__(self, shape: Shape) -> None:
        self._shape = shape
        self._done = 0
        self._from = 0.0

    def step(self) -> None:
        """One step is over; after the last one, the result is printed as a line of JSON."""
        self._done += 1
        if self._done == self._shape.warm_up:
            self._from = time.perf_counter()
        elif self._done == self._shape.total:
            result = {"steps_per_s": self._shape.steps / (time.perf_counter() - self._from)}
            print(json.dumps(result), flush=True)


class Spawned(AbstractContextManager[None]):
    """While inside, a program runs in a process of its own; it is awaited, or ended after an error."""

    def __init__(self, program: Callable[..., None], *arguments: object) -> None:
        self._process = multiprocessing.get_context("spawn").Process(target=program, args=arguments)

    def __enter__(self) -> None:
        self._process.start()

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        if kind is not None:
            self._process.terminate()
            return
        try:
            self._process.join()
        except BaseException:
            self._process.terminate()
            raise
        if self._process.exitcode:
            sys.exit(f"a process ended with exit code {self._process.exitcode}")


def arguments(description: str | None, settings: Sequence[str]) -> tuple[Shape, str]:
    """The shape and the setting that a contestant's command line asks for."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=2)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--warm-up", type=int, default=100)
    parser.add_argument("--setting", choices=settings, default=settings[0])
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("asked to stop"))  # so that what is open is closed
    return Shape(given.agents, given.workers, given.steps, given.warm_up), given.setting
