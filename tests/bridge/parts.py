"""Components with inputs that the outside feeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosim.components.python import Input, Output, PythonComponent
from tests.distributed.nodes import Node


class Inputs(PythonComponent):
    wide = Input(shape=(2,))
    count = Input(0, dtype="Int64")
    flag = Input(False, dtype="Boolean")
    choice = Input(1, items={"one": 1, "four": 4})
    out = Output(shape=(2,), depends_on=("count", "flag"))

    def outputs(self, time: float) -> None:
        self.out = [self.count, float(self.flag)]


class Pushed(Node):
    """x' = mean of what is heard - x + u."""

    u = Input(shape=(2,))

    def derivatives(self, time: float) -> Mapping[str, Any]:
        return {"x": super().derivatives(time)["x"] + self.u}
