"""A controller in Python, once as it is and once as one that nothing can take back."""

from __future__ import annotations

from cosim.components.python import Input, Output, PythonComponent


class Hand(PythonComponent):
    """u = 20 (0.4 - p) - 3 v."""

    p = Input(shape=(1,), unit="m")
    v = Input(shape=(1,), unit="m/s")
    u = Output(shape=(1,), unit="N", depends_on=("p", "v"))

    def outputs(self, time: float) -> None:
        self.u = 20.0 * (0.4 - self.p) - 3.0 * self.v


class Judge(PythonComponent):
    """Says nothing but whether the mass is on the right."""

    p = Input(shape=(1,), unit="m")
    right = Output(dtype="Boolean", depends_on=("p",))

    def outputs(self, time: float) -> None:
        self.right = self.p[0] > 0.0


class Device(Hand):
    """The same, said to be a device."""

    save = None
