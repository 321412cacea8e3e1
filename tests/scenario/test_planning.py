"""From names to indices, from distributions to numbers: what a scenario is planned as."""

from dataclasses import fields, is_dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.errors import ConfigError, Severity
from cosim.plan import AgentPlan, Integrator, Loop, Method, Plan
from cosim.planning import load
from tests.scenario.scenarios import BASE, changed, planned


def plan_of(folder: Path, text: str = BASE, *settings: str) -> Plan:
    return planned(folder, text, *settings).plan


def start(plan: Plan, agent: str, component: str, variable: str) -> tuple[Any, ...]:
    (found,) = (
        part for each in plan.agents if each.name == agent for part in each.components if part.name == component
    )
    return found.start[variable]


def agent(plan: Plan, name: str) -> AgentPlan:
    return next(each for each in plan.agents if each.name == name)


def assert_equal(one: Any, other: Any, where: str = "plan") -> None:
    """Two plans, to the last bit."""
    assert type(one) is type(other), where
    if isinstance(one, np.ndarray):
        assert np.array_equal(one, other), where
    elif is_dataclass(one) and not isinstance(one, type):
        for field in fields(one):
            assert_equal(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    elif isinstance(one, (tuple, list)):
        assert len(one) == len(other), where
        for i, pair in enumerate(zip(one, other, strict=True)):
            assert_equal(*pair, f"{where}[{i}]")
    else:
        assert one == other, where


def test_the_whole(tmp_path: Path) -> None:
    plan = plan_of(tmp_path)
    assert (plan.name, plan.seed, plan.period_ns, plan.ticks) == ("net", 3, 100_000_000, 10)
    assert (plan.layout.names, plan.layout.sizes) == (("p", "v_hat"), (2, 2))
    assert [each.name for each in plan.agents] == ["1", "2", "3"]
    assert [each.index for each in plan.agents] == [0, 1, 2]
    assert plan.links.agents == ("1", "2", "3")
    edges = list(zip(plan.links.sender.tolist(), plan.links.receiver.tolist(), plan.links.slot.tolist(), strict=True))
    assert edges == [
        (1, 0, 0),
        (2, 0, 1),
        (0, 1, 0),
        (1, 2, 0),
    ]  # by receiver, then by sender, whatever the file's order
    assert plan.weights == (0.5, 0.5, 1.0, 1.0)
    assert plan.link_channel == ("fast",) * 4
    assert plan.analysis.leaders == ("2",)
    assert plan.analysis.k_eta == dict.fromkeys("123", 7.211102550927978)
    assert plan.analysis.lambda_ == dict.fromkeys("123", 13.0)


def test_an_agent(tmp_path: Path) -> None:
    first = agent(plan_of(tmp_path), "1")
    ports = {name: port.variable for name, port in first.mailbox.values.items()}
    assert first.neighbours == (1, 2)
    assert [port.variable.name for port in first.publish] == ["p", "v_hat"]
    assert {name: variable.shape for name, variable in ports.items()} == {"p": (2, 2), "v_hat": (2, 2)}
    assert first.mailbox.stamp is not None
    assert first.mailbox.stamp.variable.shape == (2,)
    assert [name for name, _ in first.record] == ["plant.p", "plant.v"]
    assert first.coupling.method is Method.JOINT
    assert (first.coupling.step_ns, first.coupling.integrator) == (5_000_000, Integrator.RK4)
    assert first.coupling.loop is Loop.NATIVE
    controller = first.components[1]
    assert controller.start == {"n_neighbours": (2,), "T": (0.1,), "role": ("follower",)}
    assert controller.path is not None
    assert controller.path.name == "ArmSyncController.fmi3.fmu"


def test_the_period_reaches_the_controller(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, BASE, "period=0.05 s")
    assert start(plan, "1", "controller", "T") == (0.05,)


def test_fmi_2_uses_the_first_rows(tmp_path: Path) -> None:
    first = agent(plan_of(tmp_path, BASE, "templates.arm.components.controller.fmu=ArmSyncController.fmi2"), "1")
    p = first.mailbox.values["p"].variable
    declared = first.components[1].description.variables["neighbour_p"]
    assert (p.shape, declared.shape) == ((2, 2), (16, 2))
    assert p.references == declared.references[:4]
    assert first.components[1].start["n_neighbours"] == (2,)


def test_an_agent_that_hears_nobody_has_no_mailbox(tmp_path: Path) -> None:
    first = agent(plan_of(tmp_path, changed(("- 3 -> 1\n    - 2 -> 1", "- 3 -> 2"))), "1")
    assert first.neighbours == ()
    assert not first.mailbox.values
    assert first.mailbox.stamp is None
    assert first.components[1].start["n_neighbours"] == (0,)


def test_an_agent_that_nobody_hears_publishes_nothing(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, changed(("    - 3 -> 1\n", "")))
    assert agent(plan, "3").publish == ()
    assert len(agent(plan, "2").publish) == 2


def test_by_default_every_output_is_recorded(tmp_path: Path) -> None:
    first = agent(plan_of(tmp_path, changed(("    record: [plant.p, plant.v]\n", ""))), "1")
    assert [name for name, _ in first.record] == ["plant.p", "plant.v", "controller.u", "controller.v_hat"]


def test_weights_that_are_given(tmp_path: Path) -> None:
    text = BASE
    for edge, weight in (("1 -> 2", 1), ("2 -> 3", 2), ("3 -> 1", 0.25), ("2 -> 1", 0.5)):
        sender, _, receiver = edge.partition(" -> ")
        text = changed((f"- {edge}\n", f"- {{from: {sender}, to: {receiver}, weight: {weight}}}\n"), text=text)
    plan = plan_of(tmp_path, changed(("channel: fast", "channel: fast\n  weights: given"), text=text))
    assert plan.weights == (0.5, 0.25, 1.0, 2.0)


def test_channels_per_edge(tmp_path: Path) -> None:
    text = changed(
        ("- 2 -> 1", "- {from: 2, to: 1, channel: slow}"), ("  fast:", "  slow: {model: netem, delay: 1 s}\n  fast:")
    )
    plan = plan_of(tmp_path, text)
    assert plan.link_channel == ("slow", "fast", "fast", "fast")
    assert set(plan.channels) == {"slow", "fast"}


def test_ranges_in_edges_leave_out_the_agent_itself(tmp_path: Path) -> None:
    text = changed(("    - 1 -> 2\n    - 2 -> 3\n    - 3 -> 1\n    - 2 -> 1\n", "    - 1..3 -> 1..3\n"))
    assert [each.neighbours for each in plan_of(tmp_path, text).agents] == [(1, 2), (0, 2), (0, 1)]


def test_later_entries_and_overrides_win(tmp_path: Path) -> None:
    text = changed(("  2: {components", "  1..2, 3: {coupling: {step: 1 ms}}\n  2: {components"))
    plan = plan_of(tmp_path, text, "agents.2.coupling.step=2 ms", "agents.3.components.controller.start.role=leader")
    assert [each.coupling.step_ns for each in plan.agents] == [1_000_000, 2_000_000, 1_000_000]
    assert plan.analysis.leaders == ("2", "3")


def test_paths_are_relative_to_the_file_and_on_the_command_line_to_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fmus

    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
        (folder / "arm.fmu").write_bytes(fmus.path("TwoLinkArm").read_bytes())
    monkeypatch.chdir(here)
    plan = plan_of(there, changed(("fmu: TwoLinkArm\n", "fmu: arm.fmu\n")))
    assert plan.agents[0].components[0].path == there / "arm.fmu"
    plan = plan_of(there, BASE, "templates.arm.components.plant.fmu=./arm.fmu")
    assert plan.agents[0].components[0].path == here / "arm.fmu"


# --- draws ------------------------------------------------------------------------------------------------------------


def test_draws_depend_on_the_seed_and_the_agent_alone(tmp_path: Path) -> None:
    plan = plan_of(tmp_path)
    more = plan_of(tmp_path, changed(("  1..3: {template: arm}", "  hub: {template: arm}\n  1..30: {template: arm}")))
    other = plan_of(tmp_path, BASE, "seed=4")
    for name in "123":
        assert start(plan, name, "plant", "p") == start(more, name, "plant", "p")
        assert start(plan, name, "plant", "p") != start(other, name, "plant", "p")
    assert len({start(more, each.name, "plant", "p") for each in more.agents}) == 31


def test_distributions_per_element(tmp_path: Path) -> None:
    text = changed(("{uniform: [-1, 1]}", "[{uniform: [2, 3]}, 7]"), ("v: 0}", "v: {normal: [5, 0.001]}}"))
    plan = plan_of(tmp_path, text)
    one, two = start(plan, "1", "plant", "p")
    assert 2 <= one < 3
    assert two == 7.0
    assert all(abs(value - 5) < 0.01 and value != 5 for value in start(plan, "1", "plant", "v"))
    whole = plan_of(tmp_path, changed(("{uniform: [-1, 1]}", "{uniform: [2, 3]}")))
    assert start(whole, "1", "plant", "p")[0] == one  # an element's draw does not depend on its neighbours


# --- the resolved scenario --------------------------------------------------------------------------------------------

VARIANTS = {
    "as it is": (BASE, ()),
    "FMI 2.0": (BASE, ("templates.arm.components.controller.fmu=ArmSyncController.fmi2",)),
    "midpoint": (BASE, ("coupling={method: midpoint, step: 2.5 ms}",)),
    "two couplings": (
        BASE,
        ("agents.2.coupling={integrator: dormand-prince, absolute_tolerance: 1.0e-7, step: 30 ms}",),
    ),
    "drawn velocities": (BASE, ("templates.arm.components.plant.start.v={normal: [0, 0.1]}", "seed=11")),
    "a name with quotes": (BASE, ("title=\"it's: 'x' #1\"", "name=a.b-c")),
    "channels": (
        changed(
            ("- 2 -> 1", "- {from: 2, to: 1, channel: slow}"),
            ("  fast:", "  slow: {model: netem, delay: [1 ms, 2 s], loss: 3 %}\n  fast:"),
        ),
        (),
    ),
    "workers": (BASE, ("workers=2",)),
    "workers by name": (BASE, ("workers={lab-a: '3, 1', lab-b: 2}",)),
    "workers of agents that a range cannot name": (
        changed(
            ("1..3: {template: arm}", "'1-1, 1-2, 1-3, 2': {template: arm}"),
            ("- 1 -> 2\n    - 2 -> 3\n    - 3 -> 1\n    - 2 -> 1", "- 2 -> 1-1, 1-2, 1-3\n    - 1-1, 1-2, 1-3 -> 2"),
        ),
        ("workers={lab-a: '1-1, 1-2, 1-3', lab-b: 2}",),
    ),
    "nothing recorded": (changed(("[plant.p, plant.v]", "[]"), ("  position: plant.p\n  velocity: plant.v\n", "")), ()),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_resolved_scenario_is_the_same_plan(tmp_path: Path, variant: str) -> None:
    text, settings = VARIANTS[variant]
    plan = plan_of(tmp_path, text, *settings)
    again = tmp_path / "again"
    again.mkdir()
    result = planned(again, plan.scenario)
    assert_equal(plan, result.plan)
    assert [str(warning) for warning in result.warnings] == []


@pytest.mark.parametrize("name", ["paper_leaders", "paper_leaderless", "paper_known_velocity", "channel_sine"])
def test_the_resolved_shipped_scenarios_are_the_same_plan(tmp_path: Path, name: str) -> None:
    plan = load(name, seed=5, until="2 s").plan
    (tmp_path / "resolved.yaml").write_text(plan.scenario, encoding="utf-8")
    assert_equal(plan, load(str(tmp_path / "resolved.yaml")).plan)


def test_the_resolved_scenario_names_files_absolutely(tmp_path: Path) -> None:
    import fmus

    (tmp_path / "arm.fmu").write_bytes(fmus.path("TwoLinkArm").read_bytes())
    plan = plan_of(tmp_path, changed(("fmu: TwoLinkArm\n", "fmu: ./arm.fmu\n")))
    assert f"fmu: {tmp_path / 'arm.fmu'}\n" in plan.scenario
    assert "fmu: ArmSyncController" in plan.scenario


def test_the_resolved_scenario_keeps_pins(tmp_path: Path) -> None:
    import fmus

    pin = f"sha256: {sha256(fmus.path('TwoLinkArm').read_bytes()).hexdigest()}\n"
    plan = plan_of(tmp_path, changed(("fmu: TwoLinkArm\n", f"fmu: TwoLinkArm\n        {pin}")))
    assert pin in plan.scenario


# --- warnings ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "sentences"),
    [
        ([], []),
        (
            [("    - 1 -> 2\n    - 2 -> 3\n    - 3 -> 1\n    - 2 -> 1\n", "    - 1 -> 3\n    - 2 -> 3\n")],
            [
                "the graph has no root: agents 1, 2 cannot reach each other, so that a common position",
                "nobody hears agent 3",
            ],
        ),
        ([("    - 1 -> 2\n", "")], ["nobody hears agent 1"]),  # the leader is the root
        (
            [("    - 2 -> 3\n", ""), ("    - 2 -> 1\n", "")],
            ["no leader reaches every agent: from '2' nothing reaches agents 1, 3", "nobody hears agent 2"],
        ),
        ([("agents:\n", "  spare: {}\nagents:\n")], ["no agent uses the template 'spare'"]),
        ([("  fast:", "  slow: {model: ideal}\n  fast:")], ["no edge uses the channel 'slow'"]),
        (
            [("      weight: controller.weight\n", "")],
            ["'controller.weight' is not connected and keeps its start value"],
        ),
        ([("      weight: controller.weight\n", ""), ("role: follower", "role: follower, weight: 1")], []),
        (
            [("- plant.p -> controller.p\n      - plant.v -> controller.v\n      ", "")],
            ["'controller.p', 'controller.v' are not connected and keep their start values"],
        ),
    ],
)
def test_warnings(tmp_path: Path, changes: list[tuple[str, str]], sentences: list[str]) -> None:
    warnings = planned(tmp_path, changed(*changes)).warnings
    assert all(warning.severity is Severity.WARNING and warning.where for warning in warnings)
    assert len(warnings) == len(sentences), [str(warning) for warning in warnings]
    for warning, sentence in zip(sorted(w.message for w in warnings), sorted(sentences), strict=True):
        assert sentence in warning


@pytest.mark.parametrize(
    ("channel", "sentence"),
    [
        (
            "{model: netem, loss: 100 %}",
            "delivers nothing in this run: every message is lost; without its edges",
        ),
        ("{model: netem, schedule: {up: [[1 s, 2 s]]}}", "its schedule is never up at a tick; without its edges"),
        ("{model: netem, schedule: {up: [[10 ms, 90 ms]]}}", "its schedule is never up at a tick"),
        ("{model: netem, delay: 1 s}", "its least delay, 1 s, is not shorter than the run"),
        ("{model: netem, mahimahi: late.trace}", "its trace has no opportunity to send within the run"),
        ("{model: netem, rate: 100 bit/s}", "at its rate a message of 32 bytes takes 2.56 s, longer than the run"),
        ("{model: netem, rate: 300 bit/s, delay: 200 ms}", "let through of 32 bytes arrives after the run"),
        ("{model: netem, recorded: dead.csv}", "let through of 32 bytes arrives after the run"),
    ],
)
def test_channels_that_deliver_nothing(tmp_path: Path, channel: str, sentence: str) -> None:
    (tmp_path / "late.trace").write_text("1500\n")
    (tmp_path / "dead.csv").write_text("time,delay,loss\n0,0,1\n9,0,0\n10,0,0\n")
    text = changed(("fast: {model: ideal}", f"fast: {channel}"))
    (warning,) = planned(tmp_path, text).warnings
    assert sentence in warning.message
    assert warning.where is not None


@pytest.mark.parametrize(
    "channel",
    [
        "{model: netem, loss: 99 %}",
        "{model: netem, schedule: {up: [[0.9 s, 2 s]]}}",
        "{model: netem, delay: 999 ms}",
        "{model: netem, mahimahi: soon.trace}",
        "{model: netem, rate: 300 bit/s, delay: [100 ms, 9 s]}",
        "{model: window, depth: 10000, delay: [100 ms, 9 s]}",
    ],
)
def test_channels_that_may_deliver(tmp_path: Path, channel: str) -> None:
    (tmp_path / "soon.trace").write_text("500\n")
    assert planned(tmp_path, changed(("fast: {model: ideal}", f"fast: {channel}"))).warnings == ()


@pytest.mark.parametrize(
    ("name", "severity", "said"),
    [
        ("Tired", None, ""),
        ("Failing", Severity.ERROR, "channels.fast: transmit(7) raised ZeroDivisionError: my mistake (own_channels.py"),
        ("Hurried", Severity.ERROR, "channels.fast: at tick 0 `delay_ns` has -30000000; it must be 0 or more"),
        ("ClassState", Severity.WARNING, "channels.fast: played again, beside another channel of the same model"),
    ],
)
def test_a_channel_class_is_tried_before_the_run(
    tmp_path: Path, name: str, severity: Severity | None, said: str
) -> None:
    own = f"{{model: python, class: 'tests.network.own_channels:{name}'}}"
    text = changed(("fast: {model: ideal}", f"fast: {own}"))
    try:
        problems = planned(tmp_path, text).warnings
    except ConfigError as error:
        problems = error.problems
    if severity is None:
        assert not problems
        return
    assert any(problem.severity is severity and said in problem.message and problem.where for problem in problems)


def test_a_replay_must_know_the_edges(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"sender": ["7"], "receiver": ["8"], "stamp": [0], "sent": [0], "arrival_ns": [1], "fate": ["delivered"]}
    pq.write_table(pa.table(columns), tmp_path / "deliveries.parquet")
    text = changed(("fast: {model: ideal}", "fast: {model: replay, file: deliveries.parquet}"))
    with pytest.raises(ConfigError, match=r"channels\.fast: the recorded run has no message from "):
        planned(tmp_path, text)


def test_a_replay_that_delivers_nothing_on_an_edge(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pairs = [("1", "2"), ("2", "3"), ("3", "1"), ("2", "1")]
    n = len(pairs)
    columns = {
        "sender": [pair[0] for pair in pairs],
        "receiver": [pair[1] for pair in pairs],
        "stamp": [0] * n,
        "sent": [0] * n,
        "arrival_ns": [-1, *[1] * (n - 1)],
        "fate": ["lost", *["delivered"] * (n - 1)],
    }
    pq.write_table(pa.table(columns), tmp_path / "deliveries.parquet")
    (warning,) = planned(
        tmp_path, changed(("fast: {model: ideal}", "fast: {model: replay, file: deliveries.parquet}"))
    ).warnings
    assert "the channel 'fast' delivers nothing in this run on 1 -> 2" in warning.message
    (tmp_path / "manifest.json").write_text('{"period_ns": 50000000}')
    with pytest.raises(ConfigError, match=r"the recorded run has a period of 50 ms, this one of 100 ms"):
        planned(tmp_path, changed(("fast: {model: ideal}", "fast: {model: replay, file: deliveries.parquet}")))


def test_midpoint_wants_the_plant_before_its_controller(tmp_path: Path) -> None:
    components = BASE[BASE.index("      plant:") : BASE.index("    connections:")]
    plant, controller = components.split("      controller:")
    midpoint = ("{method: joint, step: 5 ms}", "{method: midpoint, step: 1 ms}")
    assert planned(tmp_path, changed(midpoint)).warnings == ()
    swapped = changed(midpoint, (components, f"      controller:{controller}{plant}"))
    for warning, variable in zip(planned(tmp_path, swapped).warnings, ("plant.p", "plant.v"), strict=True):
        assert f"'controller.u' depends directly on '{variable}'" in warning.message
        assert "list 'plant' before 'controller'" in warning.message


def test_an_agent_without_receive_is_deaf(tmp_path: Path) -> None:
    text = changed(
        ("coupling:", "  4: {components: {plant: {fmu: TwoLinkArm, start: {u: 0}}}}\ncoupling:"),
        ("- 2 -> 1", "- 2 -> 1\n    - 2 -> 4"),
    )
    (warning,) = planned(tmp_path, text).warnings
    assert warning.message == "agent '4' has no 'receive', so what it hears has no effect"


def test_rules_choose_profiles_by_who_sends_and_hears(tmp_path: Path) -> None:
    text = """
period: 100 ms
duration: 1 s
agents:
  1..4: {components: {node: {python: "cosim.components.library:Sine"}}, publish: {phi: node.phi}}
channels: {slow: {model: netem, delay: 1 s}, ideal: {model: ideal}, lossy: {model: netem, loss: 1 %}}
graph:
  channel: ideal
  rules:
    - {from: 1, channel: slow}
    - {to: 3..4, channel: lossy}
  edges: [1 -> 2, 1 -> 3, 2 -> 3, {from: 2, to: 4, channel: slow}, 3 -> 1]
"""
    (tmp_path / "net.yaml").write_text(text)
    plan = load(str(tmp_path / "net.yaml")).plan
    names = plan.links.agents
    ends = zip(plan.links.sender.tolist(), plan.links.receiver.tolist(), strict=True)
    assert {f"{names[s]}{names[r]}": channel for (s, r), channel in zip(ends, plan.link_channel, strict=True)} == {
        "12": "slow",
        "13": "lossy",
        "23": "lossy",
        "24": "slow",
        "31": "ideal",
    }
