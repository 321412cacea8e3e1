"""A plant with other names, sizes and units behind the same ones gives the same trajectories."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cosim.planning import plan
from cosim.scenario.reading import read_scenario
from tests.distributed.loopback import Loopback
from tests.distributed.networks import Record, in_process
from tests.mapping.foreign import CONNECTIONS, MAPPED, PLANT, network, played, renamed

FMI2 = (("fmu: TwoLinkArm\n", "fmu: TwoLinkArm.fmi2\n"),)
BOTH = pytest.mark.parametrize("loop", ["native", "python"])
METHODS = pytest.mark.parametrize("method", ["joint", "midpoint", "gauss-seidel"])


def values(record: Record) -> np.ndarray:
    """(ticks, numbers) of a record."""
    return np.array([np.frombuffer(row) for _, row in record.ticks])


@BOTH
@METHODS
def test_scalars_of_another_tool_are_the_arrays_of_the_agent(tmp_path: Path, loop: str, method: str) -> None:
    renamed(tmp_path / "other.fmu")
    expected = played(tmp_path, *FMI2, method=method)
    assert played(tmp_path, (PLANT, MAPPED), loop=loop, method=method) == expected


@BOTH
@METHODS
def test_elements_of_arrays_are_read_and_set_by_themselves(tmp_path: Path, loop: str, method: str) -> None:
    elements = """\
        fmu: TwoLinkArm
        inputs: {elbow: "u[2]", shoulder: "u[1]"}
        outputs: {p: [["p[1]"], ["p[2]"]], v: v, q2: "p[2]", both: [v, "p[1]"]}
        start: {p: {uniform: [-1, 1]}, v: 0}
"""
    connections = """\
    connections:
      - plant.p -> controller.p
      - plant.v -> controller.v
      - controller.u1 -> plant.shoulder
      - controller.u2 -> plant.elbow
"""
    controller = (
        "start: {role: follower}",
        'outputs: {u1: "u[1]", u2: "u[2]"}\n        start: {role: follower}',
    )
    expected = played(tmp_path, method=method)
    found = played(tmp_path, (PLANT, elements), (CONNECTIONS, connections), controller, loop=loop, method=method)
    assert found == expected


@BOTH
def test_gains_that_cancel_change_nothing(tmp_path: Path, loop: str) -> None:
    """Powers of two are exact, so even the bits stay."""
    scaled = """\
        fmu: TwoLinkArm
        inputs: {u: {to: u, gain: 0.25}}
        outputs: {p: {from: p, gain: 2}, v: {from: ["v[1]", "v[2]"], gain: 0.5}}
        start: {p: [0.5, 1], v: [0.125, 0]}
"""
    back = """\
      controller:
        fmu: ArmSyncController
        inputs: {p: {to: p, gain: 0.5}, v: [{to: "v[1]", gain: 2}, {to: "v[2]", gain: 2}]}
        outputs: {u: {from: u, gain: 4}}
"""
    plain = PLANT.replace("{p: {uniform: [-1, 1]}, v: 0}", "{p: [0.25, 0.5], v: [0.25, 0]}")
    # What is recorded and published is the plant's, so the gains are taken back for those, too.
    seen = [("p: plant.p\n", "p: plant.q\n"), ("record: [plant.p, plant.v]", "record: [plant.q, plant.w]")]
    more = scaled.replace("outputs: {", "outputs: {q: p, w: v, ")
    expected = played(tmp_path, (PLANT, plain))
    found = played(
        tmp_path,
        (PLANT, more),
        ("      controller:\n        fmu: ArmSyncController\n", back),
        *seen,
        ("position: plant.p", "position: plant.q"),
        ("velocity: plant.v", "velocity: plant.w"),
        loop=loop,
    )
    assert found == expected


@BOTH
@METHODS
def test_units_convert_wherever_values_go(tmp_path: Path, loop: str, method: str) -> None:
    """The arm in degrees and N.mm: to its controller, into the message, and out of the start values."""
    degrees = """\
        fmu: TwoLinkArm
        inputs: {u: {to: u, unit: N.mm}}
        outputs: {p: {from: p, unit: deg}, v: {from: v, unit: deg/s}}
        start: {p: [20, -30], v: 0}
"""
    radians = PLANT.replace("{p: {uniform: [-1, 1]}, v: 0}", f"{{p: {np.radians([20, -30]).tolist()}, v: 0}}")
    analysis = ("  reference_velocity: [0.3, 0.6]\n", "")
    expected = values(played(tmp_path, (PLANT, radians), method=method))
    found = values(played(tmp_path, (PLANT, degrees), analysis, loop=loop, method=method))
    assert np.abs(np.radians(found) - expected).max() < 1e-13


@BOTH
def test_agents_with_different_units_share_a_message(tmp_path: Path, loop: str) -> None:
    """The first agent's units are those of the network, and of the recorded columns."""
    third = (
        "1..3: {template: arm}\n  3: {components: {plant: {outputs: {p: {from: p, unit: deg}}, start: {p: [10, 20]}}}}"
    )
    plain = (
        f"1..3: {{template: arm}}\n  3: {{components: {{plant: {{start: {{p: {np.radians([10, 20]).tolist()}}}}}}}}}"
    )
    expected = values(played(tmp_path, ("1..3: {template: arm}", plain)))
    found = values(played(tmp_path, ("1..3: {template: arm}", third), loop=loop))
    assert np.abs(found - expected).max() < 1e-13


@BOTH
def test_a_scaled_input_is_recorded_as_it_was_fed(tmp_path: Path, loop: str) -> None:
    """In the numbers and units of its agent, not of the component, and not scaled a second time."""
    inputs = 'inputs: {u: [{to: "u[1]", gain: 4, offset: 1}, {to: "u[2]", unit: N.mm}]}'
    scaled = PLANT.replace("start:", f"{inputs}\n        start:")
    found = values(played(tmp_path, (PLANT, scaled), ("plant.v]", "plant.v, controller.u, plant.u]"), loop=loop))
    fed, seen = found.reshape(-1, 3, 8)[:, :, 4:6], found.reshape(-1, 3, 8)[:, :, 6:8]
    assert np.abs(fed - seen).max() < 1e-12
    assert np.abs(fed).max() > 0.5


@BOTH
def test_elements_that_nothing_feeds_keep_their_start_value(tmp_path: Path, loop: str) -> None:
    one = PLANT.replace("start:", 'inputs: {elbow: "u[2]"}\n        start:').replace("v: 0}", "v: 0, u: [0.75, 9]}")
    controller = ("start: {role: follower}", 'outputs: {u2: "u[2]"}\n        start: {role: follower}')
    connections = CONNECTIONS.replace("controller.u -> plant.u", "controller.u2 -> plant.elbow")
    changes = (PLANT, one), (CONNECTIONS, connections), controller, ("plant.v]", "plant.v, plant.u]")
    found = values(played(tmp_path, *changes, loop=loop)).reshape(-1, 3, 6)
    assert (found[:, :, 4] == 0.75).all()
    assert (found[1:, :, 5] != 9).all()


def test_the_resolved_scenario_maps_in_the_same_way(tmp_path: Path) -> None:
    renamed(tmp_path / "other.fmu")
    first = network(tmp_path, (PLANT, MAPPED))
    again = tmp_path / "again.yaml"
    again.write_text(first.scenario)
    assert in_process(plan(read_scenario(again)).plan) == in_process(first)


def test_distributed(tmp_path: Path) -> None:
    renamed(tmp_path / "other.fmu")
    plan_of_all = network(tmp_path, (PLANT, MAPPED.replace("[q1, q2]", "{from: [q1, q2], unit: deg}")))
    expected, error = in_process(plan_of_all)
    assert error is None
    record = Record()
    Loopback(plan_of_all, 2, [record], random.Random(1)).run()
    assert record == expected


@settings(deadline=None, max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), method=st.sampled_from(["joint", "midpoint", "gauss-seidel", "jacobi"]))
def test_both_loops_give_the_same_bits_however_values_are_scaled(
    tmp_path: Path, data: st.DataObject, method: str
) -> None:
    gain = st.floats(0.5, 2.0) | st.floats(-2.0, -0.5)
    one = st.builds(lambda g, o: f"gain: {g!r}, offset: {o!r}", gain, st.floats(-1, 1))
    p, v, u, own = (data.draw(one) for _ in range(4))
    order = data.draw(st.permutations(["u[1]", "u[2]"]))
    scaled = f"""\
        fmu: {data.draw(st.sampled_from(["TwoLinkArm", "TwoLinkArm.fmi2"]))}
        inputs: {{u: [{{to: "{order[0]}", {u}}}, "{order[1]}"]}}
        outputs:
          p: {{from: p, {p}}}
          v: [{{from: "v[1]", {v}}}, {{from: "v[2]", unit: deg/s, {v}}}]
          w: ["v[2]", "v[2]"]
        start: {{p: [0.1, 0.2]}}
"""
    controller = ("start: {role: follower}", f"inputs: {{v: {{to: v, {own}}}}}\n        start: {{role: follower}}")
    record = ("record: [plant.p, plant.v]", "record: [plant.p, plant.v, plant.w]")
    changes = (PLANT, scaled), controller, record
    native, python = (
        in_process(network(tmp_path, *changes, loop=loop, method=method)) for loop in ("native", "python")
    )
    assert native[0] == python[0]
    assert str(native[1]) == str(python[1])  # some diverge


@BOTH
def test_an_element_under_the_name_of_its_array(tmp_path: Path, loop: str) -> None:
    """As one element by itself, and `[x]` as an array of one."""
    one = PLANT.replace("start:", 'inputs: {u: "u[2]"}\n        outputs: {p: [p], q: ["p[1]"]}\n        start:')
    connections = CONNECTIONS.replace("controller.u -> plant.u", "controller.u2 -> plant.u")
    controller = ("start: {role: follower}", 'outputs: {u2: "u[2]"}\n        start: {role: follower}')
    record = ("record: [plant.p, plant.v]", "record: [plant.p, plant.q]")
    analysis = ("  velocity: plant.v\n", "")
    changed_plan = network(tmp_path, (PLANT, one), (CONNECTIONS, connections), controller, record, analysis, loop=loop)
    assert [port.variable.shape for _, port in changed_plan.agents[0].record] == [(2,), (1,)]
    found, error = in_process(changed_plan)
    assert error is None
    rows = values(found).reshape(-1, 3, 3)
    assert (rows[:, :, 2] == rows[:, :, 0]).all()


def test_a_mapped_plant_in_a_process_of_its_own(tmp_path: Path) -> None:
    """Array elements, starts and scales cross over as everything else does."""
    mapped = """\
        fmu: TwoLinkArm
        inputs: {elbow: "u[2]"}
        outputs: {p: {from: p, unit: deg}, v: v}
        start: {p: [20, -30]}
"""
    connections = CONNECTIONS.replace("controller.u -> plant.u", "controller.u2 -> plant.elbow")
    controller = ("start: {role: follower}", 'outputs: {u2: "u[2]"}\n        start: {role: follower}')
    analysis = ("  reference_velocity: [0.3, 0.6]\n", "")
    here, there = (
        played(tmp_path, (PLANT, mapped + more), (CONNECTIONS, connections), controller, analysis, loop="python")
        for more in ("", "        isolate: true\n")
    )
    assert there == here
