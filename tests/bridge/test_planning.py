"""What can be wrong with a bridge is found before the first step, with its place; the resolved scenario is the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.errors import ConfigError, Severity
from cosim.plan import Plan
from cosim.running.check import describe
from tests.bridge.labs import planned

HEAD = """\
name: lab
period: 100 ms
duration: 1 s
templates:
  arm:
    components:
      plant: {fmu: TwoLinkArm, start: {u: [5, 6]}}
    record: [plant.p]
  mixed:
    components:
      probe: {python: "tests.bridge.parts:Inputs"}
      filter: {python: "tests.bridge.parts:Inputs"}
    connections: [probe.out -> filter.wide]
agents:
  1..3: {template: arm}
  hub: {template: mixed}
bridge:
"""
LINE = HEAD.count("\n") + 1


def mistakes(folder: Path, bridge: str) -> list[str]:
    """`line:column: message` of every error, lines counted from the bridge's first."""
    with pytest.raises(ConfigError) as caught:
        planned(folder, HEAD + bridge)
    errors = [(p.where, p.message) for p in caught.value.problems if p.severity is Severity.ERROR]
    return [f"{where.line - LINE}:{where.column}: {message}" for where, message in errors if where]


def plan(folder: Path, bridge: str) -> Plan:
    return planned(folder, HEAD + bridge)


@pytest.mark.parametrize(
    ("entry", "at", "said"),
    [
        ('{key: "lab/*/p", variable: plant.p}', '"', "has a '*'; it must be a single key"),
        ('{key: "lab/$*/p", variable: plant.p}', '"', "has a '*'; it must be a single key"),
        ('{key: "lab/p?", variable: plant.p}', '"', "has a '?'; it must be a single key"),
        ('{key: "lab#p", variable: plant.p}', '"', "has a '#'; it must be a single key"),
        ('{key: "lab//p", variable: plant.p}', '"', "write words between single slashes, such as 'lab/{agent}/p'"),
        ('{key: "/lab/p", variable: plant.p}', '"', "write words between single slashes"),
        ('{key: "lab/{agnt}/p", variable: plant.p}', '"', "'{agent}' stands for the agent's name"),
        ('{key: "netcosim/x", variable: plant.p}', '"', "kept for Zenoh and for runs"),
        ('{key: "lab/@x", variable: plant.p}', '"', "kept for Zenoh and for runs"),
        ("{key: lab/x, variable: plant.p, agents: 4}", "4}", "unknown agent '4' (known: 1, 2, 3, hub)"),
        ("{key: lab/x, variable: plant.v, agents: 1}", "plant.v", "'plant.v' is not recorded"),
        ("{key: lab/x, variable: plant.w, agents: 1}", "plant.w", "'plant' has no variable 'w'"),
        ("{key: lab/x, variable: plnt.p, agents: 1}", "plnt", "unknown component 'plnt' (did you mean 'plant'?)"),
        ("{key: lab/x, variable: plant.p, agents: 1..2}", "lab/x", "several agents would publish at 'lab/x'"),
        ("{key: lab/x, variable: plant.p, agents: 1, encoding: jsn}", "jsn", "did you mean 'json'?"),
    ],
)
def test_what_is_published(tmp_path: Path, entry: str, at: str, said: str) -> None:
    (mistake,) = mistakes(tmp_path, f"  publish:\n    - {entry}\n")
    assert mistake.startswith(f"1:{7 + entry.index(at)}: ")
    assert said in mistake


@pytest.mark.parametrize(
    ("entry", "at", "said"),
    [
        (
            "{key: lab/x, variable: plant.p, agents: 1}",
            "plant.p",
            "'plant.p' is an output, not an input",
        ),
        ("{key: lab/x, variable: plant.uu, agents: 1}", "plant.uu", "'plant' has no variable 'uu'"),
        ("{key: lab/x, variable: plant.u, agents: 1, start: [1, 2, 3]}", "[1", "'u' takes 2 values, not 3"),
        ("{key: lab/x, variable: filter.wide, agents: hub}", "filter", "is connected to 'probe.out', at line 13"),
        ("{key: lab/x, variable: probe.choice, agents: hub}", "probe", "is an Enumeration"),
        ("{key: lab/x, variable: probe.count, agents: hub, start: 1.5}", "1.5", "1.5 is not"),
        ("{key: lab/x, variable: plant.u, agents: 1, strt: 1}", "strt", "unknown key 'strt' (did you mean 'start'?)"),
    ],
)
def test_what_is_taken(tmp_path: Path, entry: str, at: str, said: str) -> None:
    (mistake,) = mistakes(tmp_path, f"  subscribe:\n    - {entry}\n")
    assert mistake.startswith(f"1:{7 + entry.index(at)}: ")
    assert said in mistake


def test_keys_and_inputs_that_clash(tmp_path: Path) -> None:
    assert mistakes(
        tmp_path,
        """\
  publish:
    - {key: lab/a, variable: plant.p, agents: 1}
    - {key: lab/a, variable: plant.p, agents: 2}
  subscribe:
    - {key: lab/a, variable: plant.u, agents: 1}
    - {key: lab/b, variable: plant.u, agents: 2}
    - {key: lab/c, variable: plant.u, agents: 2..3}
    - {key: lab/b, variable: probe.count, agents: hub}
""",
    ) == [
        "2:13: 'lab/a' is published twice, first at line 19",
        "4:13: the run itself publishes at 'lab/a', at line 19; connect its agents by 'graph'",
        "6:30: 'plant.u' of agent '2' is fed from outside twice, first at line 23",
        "7:13: 'lab/b' brings 1 number as json here, but 2 numbers as json at line 23",
    ]


def test_endpoints(tmp_path: Path) -> None:
    found = mistakes(tmp_path, "  listen: [tpc/127.0.0.1:7447, tcp/0.0.0.0:7447]\n  connect: [tcp]\n")
    assert [text.split(": ")[0] for text in found] == ["0:12", "0:32", "1:13"]
    assert "did you mean 'tcp'?" in found[0]
    assert "'insecure: true' where nobody else is on the network" in found[1]
    bridge = plan(
        tmp_path,
        "  listen: [tcp/0.0.0.0:7447]\n  insecure: true\n  publish: [{key: x, agents: 1, variable: plant.p}]\n",
    )
    assert bridge.bridge.listen == ("tcp/0.0.0.0:7447",)


def test_a_recording_that_is_not_there(tmp_path: Path) -> None:
    text = "  replay: nothing.parquet\n  subscribe: [{key: x, agents: 1, variable: plant.u}]\n"
    assert mistakes(tmp_path, text) == [f"0:11: there is no file {tmp_path / 'nothing.parquet'}"]


def test_an_input_that_the_outside_feeds_is_not_said_to_be_loose(tmp_path: Path) -> None:
    bridge = plan(tmp_path, "  subscribe: [{key: x, agents: 1..3, variable: plant.u}]\n")
    assert [agent.external[0].start for agent in bridge.agents[:3]] == [(5.0, 6.0)] * 3  # the component's own
    assert bridge.bridge.listen == ("tcp/127.0.0.1:7447",)


def test_the_resolved_scenario_is_the_same(tmp_path: Path) -> None:
    text = """\
  publish:
    - {key: "lab/{agent}/p", agents: 1..3, variable: plant.p}
  subscribe:
    - {key: "z/{agent}", agents: "3, 1", variable: plant.u, start: [{uniform: [0, 1]}, 7]}
    - {key: a, agents: hub, variable: probe.count, start: 3}
    - {key: b, agents: hub, variable: probe.flag, start: true, encoding: float64}
"""
    one = plan(tmp_path, text)
    (tmp_path / "external.parquet").touch()
    two = planned(tmp_path, one.scenario)
    assert two.bridge.replay == tmp_path / "external.parquet"
    assert two.bridge.subscribe == one.bridge.subscribe
    assert two.bridge.publish == one.bridge.publish
    for here, there in zip(one.agents, two.agents, strict=True):
        assert [(x.subscription, x.start) for x in here.external] == [(x.subscription, x.start) for x in there.external]
    assert [s.key for s in one.bridge.subscribe] == ["a", "b", "z/1", "z/3"]


def test_check_says_what_is_published_and_expected(tmp_path: Path) -> None:
    text = """\
  publish:
    - {key: "lab/{agent}/p", agents: 1..3, variable: plant.p}
  subscribe:
    - {key: "lab/{agent}/u", agents: 1..3, variable: plant.u, start: [0.5, 1]}
    - {key: lab/n, agents: hub, variable: probe.count}
"""
    said = describe(plan(tmp_path, text)).splitlines()
    assert said[said.index("Bridge: listens at tcp/127.0.0.1:7447") + 1 :][:3] == [
        "  publishes         lab/{agent}/p: plant.p[2] as json; agents 1..3",
        "  takes             lab/{agent}/u: plant.u[2] as json, at first 0.5, 1; agents 1..3",
        "  takes             lab/n: probe.count[1] as json, at first 0; agents hub",
    ]
