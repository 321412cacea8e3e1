"""What an input has that takes values from messages, until the first of them comes: its start value."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.components.python import Input, Output, PythonComponent, Structural
from cosim.running import inline
from tests.distributed.networks import Record, planned

NETWORK = """
period: 100 ms
duration: 500 ms
agents:
  one, two:
    components: {{plant: {component}}}
    publish: {{y: plant.{published}}}
    receive: {{y: plant.{received}}}
    record: [plant.{recorded}]
coupling: {{method: {method}, loop: {loop}}}
graph: {{channel: slow, edges: [one -> two, two -> one]}}
channels: {{slow: {{model: netem, delay: {delay}}}}}
"""


class Kelvin(PythonComponent):
    """Hears temperatures in K, and says in degC how warm it is."""

    heard = Input(290.0, unit="K")
    kept = Output(unit="K")
    own = Output(unit="degC")

    def outputs(self, time: float) -> None:
        self.kept = self.heard
        self.own = 20.0


class Rows(PythonComponent):
    """Hears two numbers of each neighbour."""

    count = Structural(1)
    heard = Input(shape=("count", 2))
    kept = Output(shape=("count", 2))
    own = Output(shape=(2,), depends_on=())

    def outputs(self, time: float) -> None:
        self.kept = self.heard
        self.own = [7.0, 8.0]


def rows(text: str) -> list[list[float]]:
    record = Record()
    inline.run(planned(text), [record])
    return [np.frombuffer(row).tolist() for _, row in record.ticks]


@pytest.mark.parametrize("loop", ["native", "python"])
@pytest.mark.parametrize("method", ["joint", "midpoint"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_input_of_an_fmu(method: str, loop: str, fmi: int) -> None:
    """A constant acceleration moves the axis by t^2 / 2 for each unit of it."""
    component = f"{{fmu: DoubleIntegrator.fmi{fmi}, start: {{u: 3}}}}"
    names = {"published": "v", "received": "u", "recorded": "p"}
    found = np.array(rows(NETWORK.format(component=component, method=method, loop=loop, delay="1 s", **names)))
    found = found[:, :: found.shape[1] // 2]  # the FMU of FMI 2.0 has four axes, and uses one
    expected = [[1.5 * (0.1 * tick) ** 2] * 2 for tick in range(6)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("start", "first"), [("", 290.0), (", start: {heard: 300}", 300.0)])
def test_in_the_unit_of_the_input(start: str, first: float) -> None:
    """The message is in another one, 20 degC."""
    names = {"published": "own", "received": "heard", "recorded": "kept"}
    component = f'{{python: "tests.agents.test_unheard:Kelvin"{start}}}'
    found = rows(NETWORK.format(component=component, method="jacobi", loop="python", delay="250 ms", **names))
    np.testing.assert_allclose(found, [[first] * 2] * 3 + [[293.15] * 2] * 3, rtol=0, atol=1e-12)


def test_a_row_for_every_neighbour() -> None:
    text = NETWORK.replace("agents:\n  one, two:", "agents:\n  one, two, three:")
    text = text.replace("receive: {{y:", "receive: {{count: plant.count, y:")
    edges = "one -> two, one -> three, two -> one, two -> three, three -> one, three -> two"
    text = text.replace("one -> two, two -> one", edges)
    component = '{python: "tests.agents.test_unheard:Rows", start: {heard: [[1, 2], [3, 4]]}}'
    names = {"published": "own", "received": "heard", "recorded": "kept"}
    found = rows(text.format(component=component, method="jacobi", loop="python", delay="250 ms", **names))
    assert found[2] == [1.0, 2.0, 3.0, 4.0] * 3
    assert found[3] == [7.0, 8.0, 7.0, 8.0] * 3
