"""Every mistake that a user can make in a scenario: the sentence, and the line and column it points to.

In a replacement, `§` marks the place that must be reported.
"""

from hashlib import sha256
from pathlib import Path

import pytest

import fmus
from tests.scenario.scenarios import BASE, FILE, changed, errors, marked, planned, problems

Change = tuple[str, str]
ARM_SHA256 = sha256(fmus.path("TwoLinkArm").read_bytes()).hexdigest()

HOW_IT_IS_WRITTEN: dict[str, tuple[Change, str]] = {
    "unknown key": (("duration:", "§duratoin: 1 s\nduration:"), "unknown key 'duratoin' (did you mean 'duration'?)"),
    "unknown key below": (("method: joint", "§metod: joint"), "coupling: unknown key 'metod' (did you mean 'method'?)"),
    "unknown key in a channel": (
        ("{model: ideal}", "{model: window, §dept: 3, depth: 3, delay: 1 s}"),
        "channels.fast: unknown key 'dept' (did you mean 'depth'?)",
    ),
    "key of another channel": (
        ("{model: ideal}", "{model: netem, delay: 1 s, §depth: 3}"),
        "channels.fast: unknown key 'depth' (known: schedule, loss, duplicate, slot, rate, mahimahi, ",
    ),
    "value in a channel whose model is called as its key": (
        ("{model: ideal}", "{model: netem, delay: 1 s, loss: §150 %}"),
        "channels.fast.loss: ",
    ),
    "unknown channel model": (
        ("{model: ideal}", "§{model: idel}"),
        "'idel' is no channel model (did you mean 'ideal'?)",
    ),
    "missing in a channel": (("{model: ideal}", "§{model: window, depth: 3}"), "channels.fast: 'delay' is missing"),
    "missing key": (("period: 100 ms\n", "§title: x\n"), "'period' is missing"),
    "not a time": (("duration: 1 s", "duration: §soon"), "duration: 'soon' is not a time; write a number with a unit"),
    "unit of time": (("duration: 1 s", "duration: §1 sec"), "unknown unit of time 'sec'"),
    "finer than the clock": (("period: 100 ms", "period: §0.1 ns"), "finer than a nanosecond"),
    "duration beyond the clock": (("duration: 1 s", "duration: §1e10 s"), "more than the clock can count"),
    "no time at all": (("period: 100 ms", "period: §0 s"), "period: "),
    "negative seed": (("seed: 3", "seed: §-3"), "seed: must be at least 0, not -3"),
    "seed is no number": (("seed: 3", "seed: §three"), "seed: must be a whole number, not 'three'"),
    "seed is a float": (("seed: 3", "seed: §3.0"), "seed: must be a whole number, not 3.0"),
    "empty": (
        ("coupling: {method: joint, step: 5 ms}", "coupling:§"),
        "coupling: must be a mapping of keys to values, not empty",
    ),
    "no agents": (
        ("  1..3: {template: arm}\n  2: {components: {controller: {start: {role: leader}}}}", "  §{}"),
        "agents: must not be empty",
    ),
    "name of an agent": (("  1..3: {", "  §1..three: {"), "'1..three' names no agent; a name is letters"),
    "range that runs backwards": (("  1..3: {", "  §3..1: {"), "the range '3..1' must run upwards"),
    "option": (
        ("method: joint", "method: §jiont"),
        "'jiont' is none of auto, joint, midpoint, gauss-seidel, jacobi (did you mean 'joint'?)",
    ),
    "weights": (
        ("channel: fast", "weights: §equall\n  channel: fast"),
        "'equall' is none of equal, given (did you mean 'equal'?)",
    ),
    "edge": (("- 1 -> 2", "- §1 - 2"), "graph.edges.0: '1 - 2' is no edge; write '4 -> 1' for: 1 can hear 4"),
    "edge of three": (("- 1 -> 2", "- §1 -> 2 -> 3"), "'1 -> 2 -> 3' is no edge"),
    "edge without an end": (("- 1 -> 2", "- §{from: 1}"), "graph.edges.0: 'to' is missing"),
    "edge as a number": (("- 1 -> 2", "- §12"), "graph.edges.0: must be a mapping of keys to values, not 12"),
    "weight": (("- 1 -> 2", "- {from: 1, to: 2, weight: §0}"), "graph.edges.0.weight: must be more than 0, not 0"),
    "connection": (
        ("- plant.p -> controller.p", "- §plant.p controller.p"),
        "is no connection; write 'component.output -> component.input'",
    ),
    "port": (("p: plant.p\n", "p: §plant\n"), "'plant' is no variable of a component; write 'component.variable'"),
    "component's name": (("      plant:\n", "      §plant 1:\n"), "'plant 1' cannot name a component"),
    "scenario's name": (("duration:", "name: §a/b\nduration:"), "'a/b' cannot name a scenario"),
    "both kinds": (
        ("fmu: TwoLinkArm\n", "§fmu: TwoLinkArm\n        python: m:C\n"),
        "give either 'fmu' or 'python', not both",
    ),
    "pin": (("fmu: TwoLinkArm\n", "fmu: TwoLinkArm\n        sha256: §12ab\n"), "'12ab' is no SHA-256; it has 64"),
    "start value": (
        ("v: 0}", "v: §{unifrom: [0, 1]}}"),
        "a start value is a number, true or false, text, a list of these",
    ),
    "start value left empty": (("v: 0}", "v: §~}"), "a start value is a number"),
    "bounds": (("{uniform: [-1, 1]}", "§{uniform: [1, -1]}"), "the lower bound 1.0 is above the upper bound -1.0"),
    "bounds too far apart": (("{uniform: [-1, 1]}", "§{uniform: [-1e308, 1e308]}"), "are too far apart"),
    "one bound": (("uniform: [-1, 1]", "uniform: §[1]"), "must have 2 elements, not 1"),
    "bound is no number": (("uniform: [-1, 1]", "uniform: [-1, §one]"), "must be a number, not 'one'"),
    "bound of an element": (("p: {uniform: [-1, 1]}", "p: [1, {normal: [0, §x]}]"), "must be a number, not 'x'"),
    "deviation": (("{uniform: [-1, 1]}", "§{normal: [0, -1]}"), "the standard deviation -1.0 is negative"),
    "not a number": (("v: 0}", "v: §.nan}"), "'.nan' is no value to start from"),
    "record": (("[plant.p, plant.v]", "§plant.p"), "record: must be a list, such as [a, b], not 'plant.p'"),
    "tolerance": (("step: 5 ms", "relative_tolerance: §1"), "must be less than 1, not 1"),
    "no workers": (("duration:", "workers: §0\nduration:"), "workers: must be at least 1, not 0"),
    "workers in words": (("duration:", "workers: §many\nduration:"), "workers: 'many' is none of per-agent"),
    "workers as a list": (("duration:", "workers: §[1]\nduration:"), "workers are a number, 'per-agent', or agents by"),
    "worker's name": (("duration:", "workers: {§lab a: 1..3}\nduration:"), "worker 'lab a': write letters, digits"),
    "worker called emulator": (("duration:", "workers: {§emulator: 1..3}\nduration:"), "no worker can be called"),
    "worker's agents": (("duration:", "workers: {a: §3..1}\nduration:"), "the range '3..1' must run upwards"),
    "leader": (("{controller.role: leader}", "{controller.role: §[1]}"), "must be a number, true or false, or text"),
}

WHAT_IT_MEANS: dict[str, tuple[Change, str]] = {
    "worker of an unknown agent": (("duration:", "workers: {a: §1..4}\nduration:"), "unknown agent '4'"),
    "agent with two workers": (
        ("duration:", "workers: {a: 1..3, b: §2}\nduration:"),
        "agent '2' is carried by 'a' already",
    ),
    "agent twice": (
        ("duration:", "workers: {a: §'1..3, 2'}\nduration:"),
        "agent '2' is carried by this worker already",
    ),
    "agents without a worker": (("duration:", "§workers: {a: 1}\nduration:"), "no worker carries agents 2, 3"),
    "unknown template": (
        ("1..3: {template: arm}", "1..3: {template: §amr}"),
        "unknown template 'amr' (did you mean 'arm'?)",
    ),
    "no components": (("  1..3: {template: arm}", "  1..3: {template: arm}\n  §4: {}"), "an agent without components"),
    "neither kind": (("        fmu: TwoLinkArm\n", ""), "component 'plant' has neither 'fmu' nor 'python'"),
    "shipped FMU": (
        ("fmu: TwoLinkArm\n", "fmu: §TwoLinkAm\n"),
        "no shipped FMU is called 'TwoLinkAm' (did you mean 'TwoLinkArm'?)",
    ),
    "a folder": (("fmu: TwoLinkArm\n", "fmu: §./\n"), "is a folder, not an FMU file"),
    "another file than is pinned": (
        ("fmu: TwoLinkArm\n", f"fmu: TwoLinkArm\n        sha256: §{'0' * 63}A\n"),
        f"TwoLinkArm is not the file that is asked for: its SHA-256 is {ARM_SHA256}, not {'0' * 63}a",
    ),
    "FMU file": (("fmu: TwoLinkArm\n", "fmu: §models/arm.fmu\n"), "no FMU file 'models/arm.fmu'; looked for /"),
    "Python module": (
        ("fmu: TwoLinkArm\n", "python: §cosim.libary:Sine\n"),
        "there is no Python module 'cosim.libary'",
    ),
    "Python class": (
        ("fmu: TwoLinkArm\n", "python: §cosim.components.library:Sin\n"),
        "has no class 'Sin' (did you mean 'Sine'?)",
    ),
    "start of nothing": (("role: follower", "§rol: follower"), "no variable 'rol' (did you mean 'role'?)"),
    "start of an output": (("role: follower", "u: §1"), "'u' is computed; it takes no start value"),
    "size of a start value": (("v: 0}", "v: §[1, 2, 3]}"), "'v' takes 2 values, not 3"),
    "nested start value": (("v: 0}", "v: §[[1, 2]]}"), "'v' takes 2 values; this list is nested as 1 x 2"),
    "ragged start value": (("v: 0}", "v: §[[1], 2]}"), "this list is unevenly nested"),
    "type of a start value": (("v: 0}", "v: §fast}"), "'v' is a Float64; 'fast' is not"),
    "switch for a number": (("v: 0}", "v: §true}"), "'v' is a Float64; true is not"),
    "number for a switch": (
        ("role: follower", "psi_from_position: §1"),
        "'psi_from_position' is a Boolean; 1 is not; write true or false",
    ),
    "enumeration item": (
        ("role: follower", "role: §folower"),
        "'role' has no item 'folower' (did you mean 'follower'?)",
    ),
    "enumeration number": (
        ("role: follower", "role: §7"),
        "'role' has no item 7 (known: follower, leader, known_velocity)",
    ),
    "drawn enumeration": (
        ("role: follower", "role: §{uniform: [1, 2]}"),
        "only a Float64 or Float32 can be drawn from the seed",
    ),
    "what the framework sets": (("role: follower", "§T: 0.1"), "'receive' sets 'T'; leave it out here"),
    "unknown component": (
        ("- plant.p -> controller.p", "- §plnt.p -> controller.p"),
        "unknown component 'plnt' (did you mean 'plant'?)",
    ),
    "unknown variable": (("- plant.p -> controller.p", "- §plant.pp -> controller.p"), "'plant' has no variable 'pp'"),
    "starts at an input": (
        ("- plant.p -> controller.p", "- §plant.u -> controller.p"),
        "'plant.u' is an input, not an output; the outputs of 'plant': p, v",
    ),
    "starts at a local variable": (
        ("- plant.p -> controller.p", "- §plant.der(v) -> controller.p"),
        "'plant.der(v)' is a local variable, not an output; `outputs: {der(v): der(v)}` beside 'fmu' makes it one",
    ),
    "ends at an output": (
        ("- plant.p -> controller.p", "- §plant.p -> controller.u"),
        "'controller.u' is an output, not an input",
    ),
    "ends at a parameter": (
        ("- plant.p -> controller.p", "- §plant.p -> controller.v_d"),
        "'controller.v_d' is a parameter, not an input",
    ),
    "unit of a connection": (
        ("- plant.p -> controller.p", "- §plant.v -> controller.p"),
        "'plant.v' is in rad/s, but 'controller.p' is in rad",
    ),
    "connected twice": (
        ("- controller.u -> plant.u", "- controller.u -> plant.u\n      - §plant.p -> controller.p"),
        "'controller.p' is connected twice, first at line 14",
    ),
    "connected and received": (
        ("p: controller.neighbour_p\n", "p: §controller.p\n"),
        "'controller.p' is connected twice, first at line 14",
    ),
    "published input": (("p: plant.p\n", "p: §plant.u\n"), "'plant.u' is an input, not an output"),
    "published under a name of the mailbox": (
        ("p: plant.p\n", "p: plant.p\n      §stamp: plant.v\n"),
        "a message cannot have a variable 'stamp'",
    ),
    "received but not published": (
        ("      v_hat: controller.neighbour_v_hat", "      §v_hatt: controller.neighbour_v_hat"),
        "no agent publishes 'v_hatt' (did you mean 'v_hat'?)",
    ),
    "unit of a message": (
        ("p: controller.neighbour_p\n      v_hat: ", "p: §"),
        "'p' is published in rad, but 'controller.neighbour_v_hat' is in rad/s",
    ),
    "count": (
        ("count: controller.n_neighbours", "count: §controller.k_p"),
        "'count' sets a whole-number parameter; 'controller.k_p' is a parameter of type Float64",
    ),
    "period": (
        ("period: controller.T", "period: §controller.k_p"),
        "the period is in s, but 'controller.k_p' is in 1/s2",
    ),
    "rows without a count": (
        ("receive:\n      count: controller.n_neighbours\n", "§receive:\n"),
        "'controller' is not told how many others an agent hears; add 'count: controller.n_neighbours'",
    ),
    "recorded": (("[plant.p, plant.v]", "[plant.p, §plant.q, plant.v]"), "'plant' has no variable 'q'"),
    "recorded twice": (("[plant.p, plant.v]", "[plant.p, plant.v, §plant.p]"), "'plant.p' is recorded twice"),
    "unknown agent": (("- 3 -> 1", "- §33 -> 1"), "unknown agent '33' (did you mean '3'?)"),
    "unknown agent in a mapping": (("- 3 -> 1", "- {from: 3, to: §4}"), "unknown agent '4'"),
    "duplicate edge": (("- 2 -> 1", "- 2 -> 1\n    - §1 -> 2"), "duplicate edge '1 -> 2', first at line 36"),
    "self edge": (("- 2 -> 1", "- §2 -> 2"), "the edge '2 -> 2' joins an agent to itself"),
    "weight of its own": (("- 2 -> 1", "- {from: 2, to: 1, §weight: 1}"), "a weight of its own needs 'weights: given'"),
    "unknown channel": (("channel: fast", "channel: §fats"), "unknown channel 'fats' (did you mean 'fast'?)"),
    "unknown channel of an edge": (("- 2 -> 1", "- {from: 2, to: 1, channel: §fats}"), "unknown channel 'fats'"),
    "step": (("step: 5 ms", "step: §30 ms"), "the step 30 ms does not divide the period 100 ms; 25 ms does"),
    "step that is nearly right": (
        ("step: 5 ms", "step: §6 ms"),
        "the step 6 ms does not divide the period 100 ms; 5 ms does",
    ),
    "step longer than the period": (
        ("step: 5 ms", "step: §200 ms"),
        "the step 200 ms is longer than the period 100 ms",
    ),
    "duration": (
        ("duration: 1 s", "duration: §1.05 s"),
        "the duration 1.05 s is no multiple of the period 100 ms; 1.1 s is",
    ),
    "analysis of nothing": (("velocity: plant.v", "velocity: §plant.w"), "no agent has a variable 'plant.w'"),
    "analysis of what is not recorded": (
        ("velocity: plant.v", "velocity: §controller.v_r"),
        "'controller.v_r' is not recorded; add it to 'record'",
    ),
    "reference velocity": (("[0.3, 0.6]", "§[0.3]"), "'plant.v' has 2 numbers, the reference velocity 1"),
    "leaders of nothing": (
        ("{controller.role: leader}", "{§controller.rol: leader}"),
        "no agent has a variable 'controller.rol'",
    ),
    "no such leader": (
        ("{controller.role: leader}", "{controller.role: §leder}"),
        "has no item 'leder' (did you mean 'leader'?)",
    ),
    "gain": (("k_eta: controller.k_eta", "k_eta: §controller.v_d"), "'controller.v_d' is no single number"),
}


def assert_reported(folder: Path, change: Change, sentence: str) -> None:
    text, place = marked(changed(change))
    found = errors(folder, text)
    assert len(found) == 1, [str(problem) for problem in found]
    assert sentence in found[0].message
    if "§" in change[1]:
        assert str(found[0].where) == place, found[0]


@pytest.mark.parametrize("mistake", HOW_IT_IS_WRITTEN)
def test_mistake_in_how_it_is_written(tmp_path: Path, mistake: str) -> None:
    assert_reported(tmp_path, *HOW_IT_IS_WRITTEN[mistake])


@pytest.mark.parametrize("mistake", WHAT_IT_MEANS)
def test_mistake_in_what_it_means(tmp_path: Path, mistake: str) -> None:
    assert_reported(tmp_path, *WHAT_IT_MEANS[mistake])


def test_the_scenario_without_mistakes(tmp_path: Path) -> None:
    assert problems(tmp_path, BASE) == []


def test_all_mistakes_are_reported_at_once(tmp_path: Path) -> None:
    text = changed(
        ("- 1 -> 2", "- 1 -> 9"),
        ("role: follower", "rol: follower"),
        ("duration: 1 s", "duration: 1.05 s"),
        ("velocity: plant.v", "velocity: plant.w"),
        ("- plant.p -> controller.p", "- plant.v -> controller.p"),
        ("step: 5 ms", "step: 7 ms"),
    )
    found = errors(tmp_path, text)
    assert len(found) == 6
    assert [problem.where for problem in found] == sorted(problem.where for problem in found if problem.where)


def test_all_mistakes_of_writing_are_reported_at_once(tmp_path: Path) -> None:
    text = changed(
        ("seed: 3", "seed: x"), ("duration:", "duratoin:"), ("- 1 -> 2", "- 1 2"), ("model: ideal", "model: x")
    )
    assert len(errors(tmp_path, text)) == 5  # the missing duration too


def test_a_mistake_in_a_template_is_reported_once_for_all_its_agents(tmp_path: Path) -> None:
    text = changed(("role: follower", "rol: follower"), ("1..3: {template", "1..40: {template"))
    assert len(errors(tmp_path, text)) == 1


def test_a_mistake_in_an_entry_points_to_the_entry(tmp_path: Path) -> None:
    text, place = marked(changed(("start: {role: leader}", "start: {role: leader, k_p: §[1, 2]}")))
    (found,) = errors(tmp_path, text)
    assert str(found) == f"{place}: error: 'k_p' takes one value, not 2"


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("coupling.stpe=1 ms", "--set coupling.stpe: error: coupling: unknown key 'stpe' (did you mean 'step'?)"),
        ("coupling.step=fast", "--set coupling.step: error: coupling.step: 'fast' is not a time"),
        (
            "agents.2.components.plant.start.v=[1]",
            "--set agents.2.components.plant.start.v: error: 'v' takes 2 values, not 1",
        ),
        ("templates.arm.components.plant.fmu=Arm", "--set templates.arm.components.plant.fmu: error: no shipped FMU"),
        ("graph.edges.0=1 -> 9", "--set graph.edges.0: error: unknown agent '9'"),
        ("duration=1 ms", "--set duration: error: the duration 1 ms is no multiple of the period 100 ms; 100 ms is"),
        ("agents.9.template=arm", None),
    ],
)
def test_mistakes_on_the_command_line(tmp_path: Path, setting: str, sentence: str | None) -> None:
    found = [str(problem) for problem in errors(tmp_path, BASE, setting)]
    assert found == [] if sentence is None else (len(found) == 1 and found[0].startswith(sentence))


def test_size_of_a_connection(tmp_path: Path) -> None:
    text, place = marked(
        changed(
            ("- plant.p -> controller.p", "- §plant.p -> controller.neighbour_p"),
            ("      p: controller.neighbour_p\n", ""),
            ("- 2 -> 1", "- 2 -> 1\n    - 1 -> 3\n    - 3 -> 2"),
        )
    )
    found = errors(tmp_path, text)
    sentence = "'plant.p' has 2 numbers, but 'controller.neighbour_p' takes 4 numbers"
    assert [str(problem) for problem in found] == [f"{place}: error: {sentence}"]


def test_edges_without_a_channel(tmp_path: Path) -> None:
    text = changed(("  channel: fast\n", ""), ("- 2 -> 1", "- {from: 2, to: 1, channel: fast}"))
    found = errors(tmp_path, text)
    assert len(found) == 3
    assert "this edge has no channel; give it one, or many of them with `rules`" in found[0].message


def test_given_weights_are_given_for_every_edge(tmp_path: Path) -> None:
    text = changed(("channel: fast", "weights: given\n  channel: fast"), ("- 2 -> 1", "- {from: 2, to: 1, weight: 2}"))
    found = errors(tmp_path, text)
    assert len(found) == 3
    assert "with 'weights: given' every edge needs its weight" in found[0].message


def test_who_is_heard_must_publish(tmp_path: Path) -> None:
    silent = "  4: {components: {plant: {fmu: TwoLinkArm, start: {u: 0}}}}\ncoupling:"
    text, place = marked(changed(("coupling:", silent), ("- 2 -> 1", "- 2 -> 1\n    - §4 -> 1")))
    (found,) = errors(tmp_path, text)
    assert str(found) == f"{place}: error: agent '1' hears '4', which publishes nothing; give it 'publish'"


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        ("{p: plant.p}", "every agent must publish the same message: here it is p; agent '1' publishes p, v_hat"),
        ("{p: plant.p, v_hat: plant.p}", "'v_hat' is in rad here, in rad/s from agent '1'"),
        ("{p: plant.p, v_hat: source.phi}", "'v_hat' is 1 number here, 2 numbers from agent '1'"),
    ],
)
def test_all_messages_are_alike(tmp_path: Path, message: str, sentence: str) -> None:
    other = (
        "  4:\n    components: {plant: {fmu: TwoLinkArm, start: {u: 0}}, "
        "source: {python: 'cosim.components.library:Sine'}}\n"
        f"    publish: {message}\n    record: []\n"
    )
    text = changed(("coupling:", f"{other}coupling:"), ("- 2 -> 1", "- 2 -> 1\n    - 4 -> 1"))
    (found,) = errors(tmp_path, text)
    assert found.message.endswith(sentence)
    assert str(found.where).startswith(f"{FILE}:34:")


def test_fmi_2_has_a_most_of_in_neighbours(tmp_path: Path) -> None:
    text, place = marked(
        changed(
            ("fmu: ArmSyncController", "fmu: ArmSyncController.fmi2"),
            ("1..3: {template", "1..18: {template"),
            ("p: controller.neighbour_p\n", "p: §controller.neighbour_p\n"),
            ("- 2 -> 1", "- 2, 4..18 -> 1"),
        )
    )
    found = errors(tmp_path, text)
    assert len(found) == 5  # one for every input of the mailbox
    sentence = "'controller.neighbour_p' has 16 rows, which FMI 2.0 fixes: too few for an agent that hears 17 others"
    assert f"{place}: error: {sentence}" in map(str, found)


def test_broken_fmu_is_reported_where_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.fmu").write_bytes(b"PK no archive")
    text, place = marked(changed(("fmu: TwoLinkArm\n", "fmu: §./broken.fmu\n")))
    (found,) = errors(tmp_path, text)
    assert str(found).startswith(f"{place}: error: broken.fmu is not an FMU")


def test_missing_fmu_file_suggests_its_neighbour(tmp_path: Path) -> None:
    (tmp_path / "robot.fmu").write_bytes(b"")
    (found,) = errors(tmp_path, changed(("fmu: TwoLinkArm\n", "fmu: robt.fmu\n")))
    assert "no FMU file 'robt.fmu' (did you mean 'robot.fmu'?)" in found.message


def test_algebraic_loop(tmp_path: Path) -> None:
    text = """\
period: 100 ms
duration: 1 s
agents:
  a:
    components: {one: {python: 'cosim.components.library:Hold'}, two: {python: 'cosim.components.library:Hold'}}
    connections: §
      - one.value -> two.values
      - two.value -> one.values
    coupling: {method: joint}
"""
    text, _ = marked(text)
    (warning,) = (w for w in planned(tmp_path, text).warnings if "an algebraic loop" in w.message)
    assert "one.value -> two.value -> one.value; each of these outputs depends directly on" in warning.message
    assert str(warning.where) == f"{FILE}:7:7"


# --- all at once ------------------------------------------------------------------------------------------------------

FORM_AND_MEANING = [
    [("duration: 1 s", "duration: §1 sec"), ("    - 2 -> 3\n", "    - §2 -> 7\n")],
    [("  channel: fast\n", "  §chanel: fast\n"), ("role: follower", "role: §folower"), ("- 3 -> 1", "- §3 -> 8")],
    [("{model: ideal}", "§{model: idael}"), ("plant.v -> controller.v", "§plant.w -> controller.v")],
    [("1..3: {template: arm}", "1..3: {template: §amr}"), ("seed: 3", "seed: §three")],
    [("1..3: {template: arm}", "§1..x: {template: arm}"), ("period: 100 ms", "period: §100 parsecs")],
    [
        ("v: 0}", "v: §.nan}"),
        ("    - 2 -> 3\n", "    - §2 -> v\n"),
        ("plant.v -> controller.v", "§plant.v -> controller.w"),
    ],
    [("v: 0}", "v: [0, §{normal: [1, -1]}]}"), ("plant.p, plant.v", "plant.p, §plant.w")],
    [("v: 0}", "v: §.nan}"), ("plant.v -> controller.v", "§plant.v -> controller.v_hat")],
    [("fmu: TwoLinkArm", "fmu: §TwoLinkArn"), ("step: 5 ms", "step: §-5 ms"), ("2 -> 3", "§2 -> 9")],
]


@pytest.mark.parametrize("changes", FORM_AND_MEANING)
def test_mistakes_in_form_do_not_hide_those_in_meaning_nor_make_up_others(
    changes: list[tuple[str, str]], tmp_path: Path
) -> None:
    """Each mistake is marked where it must be reported; nothing else may be."""
    plain = changed(*[(old, new.replace("§", "")) for old, new in changes])
    places = set()
    for mistake in changes:
        others = [(old, new.replace("§", "")) for old, new in changes if (old, new) != mistake]
        places.add(marked(changed(*others, mistake))[1])
    found = [str(problem) for problem in errors(tmp_path, plain)]
    assert {message.split(": error: ")[0] for message in found} == places, found
    assert len(found) == len(places)
