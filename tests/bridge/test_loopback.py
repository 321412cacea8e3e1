"""Values from outside, in runs whose processes take their steps in any order, and are lost at any moment."""

from __future__ import annotations

import random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.bridge import Taken
from cosim.running import inline
from tests.distributed.loopback import Loopback
from tests.distributed.networks import Record, planned

N_AGENTS, TICKS = 4, 10
SCENARIO = f"""\
name: pushed
seed: 5
period: 100 ms
duration: {TICKS * 100} ms
coupling: {{method: joint, step: 20 ms}}
templates:
  node:
    components: {{node: {{python: "tests.bridge.parts:Pushed", start: {{x: {{uniform: [-1, 1]}}}}}}}}
    publish: {{y: node.y}}
    receive: {{y: node.heard, stamp: node.stamp, count: node.count}}
    record: [node.x]
agents:
  1..{N_AGENTS}: {{template: node}}
graph:
  channel: slow
  edges: [1 -> 2, 2 -> 3, 3 -> 4, 4 -> 1]
channels:
  slow: {{model: netem, delay: [100 ms, 250 ms], loss: 10 %}}
bridge:
  subscribe:
    - {{key: all, agents: 1..2, variable: node.u, start: 0.5}}
    - {{key: "one/{{agent}}", agents: 3..4, variable: node.u}}
"""

values = st.lists(st.floats(-3, 3), min_size=2, max_size=2).map(np.array)
scripts = st.dictionaries(
    st.integers(0, TICKS - 1), st.dictionaries(st.integers(0, 2), values, max_size=3), max_size=TICKS
)


class Script:
    """Gives what it is told to, and remembers which ticks it was asked for."""

    def __init__(self, script: dict[int, Taken]) -> None:
        self._script = script
        self.asked: list[int] = []

    def __call__(self, tick: int) -> Taken:
        self.asked.append(tick)
        return self._script.get(tick, {})


@given(
    script=scripts,
    n_workers=st.integers(1, N_AGENTS),
    seed=st.integers(0, 2**32),
    paced=st.booleans(),
    losses=st.integers(0, 2),
)
@settings(max_examples=25, deadline=None)
def test_the_same_values_give_the_same_run(
    script: dict[int, Taken], n_workers: int, seed: int, paced: bool, losses: int
) -> None:
    text = SCENARIO + ("on_worker_loss: restart\n" if losses else "")
    plan = planned(text)
    expected, found, asked, asked_again = Record(), Record(), Script(script), Script(script)
    inline.run(plan, [expected], take=asked)
    network = Loopback(plan, n_workers, [found], random.Random(seed), paced=paced, losses=losses, take=asked_again)
    network.run()
    assert found == expected
    assert asked.asked == asked_again.asked == list(range(TICKS))


def test_the_values_matter() -> None:
    plan = planned(SCENARIO)
    with_, without = Record(), Record()
    inline.run(plan, [with_], take=Script({3: {0: np.ones(2)}}))
    inline.run(plan, [without], take=Script({}))
    assert with_.ticks[:4] == without.ticks[:4]
    assert with_.ticks[4] != without.ticks[4]
