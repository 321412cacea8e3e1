"""Small components that come with the framework, for scenarios about the network rather than about a plant."""

from __future__ import annotations

import math

from cosim.components.python import Input, Output, Parameter, PythonComponent, Structural


class Sine(PythonComponent):
    """A signal to send: phi = amplitude sin(frequency t + phase)."""

    amplitude = Parameter(2.0)
    frequency = Parameter(1.0, unit="rad/s")
    phase = Parameter(0.0, unit="rad")
    phi = Output(depends_on=())

    def outputs(self, time: float) -> None:
        self.phi = self.amplitude * math.sin(self.frequency * time + self.phase)


class Hold(PythonComponent):
    """What a receiver without extrapolation sees: the value with the freshest stamp, 0 until one has arrived.

    Of several in-neighbours with the same freshest stamp, the first counts.
    """

    count = Structural(1, description="number of in-neighbours")
    width = Structural(1, description="numbers in the received variable")
    values = Input(shape=("count", "width"), description="from the mailbox")
    stamp = Input(-1, shape=("count",), dtype="Int64", description="from the mailbox; -1 for not heard yet")
    value = Output(shape=("width",), depends_on=("values", "stamp"))

    def outputs(self, time: float) -> None:  # noqa: ARG002 - a function of the inputs alone
        freshest = int(self.stamp.argmax()) if self.count else 0
        self.value = self.values[freshest] if self.count and self.stamp[freshest] >= 0 else 0.0
