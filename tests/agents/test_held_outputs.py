"""`midpoint` extrapolates real numbers that change continuously, and nothing else."""

from __future__ import annotations

import sys

import pytest

from cosim.components.python import Input, Output, PythonComponent
from tests.agents.test_multirate import rows

NUMBERS = (1, 3, 2, 4)


class Source(PythonComponent):
    """Another number and the other Boolean after every 10 ms."""

    number = Output(dtype="Int64", depends_on=())
    on = Output(dtype="Boolean", depends_on=())
    level = Output(dtype="Enumeration", items={"low": 1, "high": 7}, depends_on=())

    def initialise(self, time: float) -> None:
        self.step(time, 0.0)

    def step(self, time: float, step: float) -> None:
        k = round(100.0 * (time + step) - 1e-6)
        self.number = NUMBERS[k % 4]
        self.on = k % 2 == 0
        self.level = 7 if k % 2 else 1


class Reader(PythonComponent):
    """What it was given: the largest and the smallest number, and how often it was not what the source gave."""

    number = Input(1, dtype="Int64")
    on = Input(True, dtype="Boolean")
    level = Input(1, dtype="Enumeration", items={"low": 1, "high": 7})
    most = Output(start=1.0, depends_on=())
    least = Output(start=1.0, depends_on=())
    wrong = Output(dtype="Int64", depends_on=())

    def step(self, time: float, step: float) -> None:
        k = round(100.0 * time - 1e-6)
        self.most, self.least = max(self.most, self.number), min(self.least, self.number)
        given = self.number, self.on, self.level
        self.wrong = self.wrong + (given != (NUMBERS[k % 4], k % 2 == 0, 7 if k % 2 else 1))


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """pytest imports this file under a name of its own."""
    monkeypatch.setitem(sys.modules, "held", sys.modules[Source.__module__])


@pytest.mark.parametrize("method", ["midpoint", "gauss-seidel", "jacobi"])
def test_a_reader_sees_only_what_the_source_gives(method: str) -> None:
    found = rows(
        f"""\
period: 100 ms
duration: 1 s
agents:
  1:
    components: {{reader: {{python: "held:Reader"}}, source: {{python: "held:Source"}}}}
    connections: [source.number -> reader.number, source.on -> reader.on, source.level -> reader.level]
    record: [reader.most, reader.least, reader.wrong]
coupling: {{method: {method}, step: 2 ms}}
"""
    )
    assert found[-1].tolist() == [4, 1, 0]
