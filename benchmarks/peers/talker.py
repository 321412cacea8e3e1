"""The agent that netcosim runs in `benchmarks.distributed`: it sends 64 bytes a step and computes next to nothing."""

from __future__ import annotations

from cosim.components.python import Input, Output, PythonComponent, Structural

WIDTH = 8


class Talker(PythonComponent):
    """Sends the time and seven zeros, and takes what its in-neighbours send."""

    count = Structural(1, description="number of in-neighbours")
    heard = Input(shape=("count", WIDTH), description="from the mailbox")
    samples = Output(shape=(WIDTH,), depends_on=())

    def step(self, time: float, step: float) -> None:
        """There is nothing to advance."""

    def outputs(self, time: float) -> None:
        self.samples[0] = time
