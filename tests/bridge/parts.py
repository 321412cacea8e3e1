"""A component with inputs of every type that matters."""

from __future__ import annotations

from cosim.components.python import Input, Output, PythonComponent


class Inputs(PythonComponent):
    wide = Input(shape=(2,))
    count = Input(0, dtype="Int64")
    flag = Input(False, dtype="Boolean")
    choice = Input(1, items={"one": 1, "four": 4})
    out = Output(shape=(2,), depends_on=("count", "flag"))

    def outputs(self, time: float) -> None:
        self.out = [self.count, float(self.flag)]
