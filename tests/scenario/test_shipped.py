"""The shipped scenarios: complete, in agreement with the schema for editors, and with what the paper says."""

import json
from pathlib import Path

import jsonschema
import pytest

from cosim.errors import ConfigError
from cosim.planning import load
from cosim.scenario import configs
from cosim.scenario.source import read
from cosim.scenario.spec import json_schema
from cosim.topology import kappa, roots
from tests.scenario.scenarios import BASE, FILE

PAPER = ["paper_leaders", "paper_leaderless", "paper_known_velocity"]
VALIDATOR = jsonschema.Draft202012Validator(json_schema())


def test_they_are_all_there() -> None:
    assert set(configs.names()) >= {*PAPER, "channel_sine", "mixed_network", "mixed_plants", "consensus"}


@pytest.mark.parametrize("name", configs.names())
def test_the_schema_for_editors_accepts_them(name: str) -> None:
    VALIDATOR.check_schema(VALIDATOR.schema)
    VALIDATOR.validate(read(configs.shipped(name)).plain())


@pytest.mark.parametrize("name", configs.names())
def test_they_plan_without_a_needless_warning_under_their_own_name(name: str) -> None:
    planned = load(name)
    if name == "mixed_network":  # its blackout is what it is for
        (warning,) = planned.warnings
        assert "'blackout' is down for 5 s, longer than the age of 1.303 s" in warning.message
    else:
        assert planned.warnings == ()
    assert planned.plan.name == name
    assert planned.plan.title


@pytest.mark.parametrize("name", configs.names())
def test_what_is_resolved_keeps_to_the_schema(name: str, tmp_path: Path) -> None:
    path = tmp_path / "resolved.yaml"
    path.write_text(load(name).plan.scenario, encoding="utf-8")
    VALIDATOR.validate(read(path).plain())


@pytest.mark.parametrize(
    "wrong",
    [
        {"duratoin": 1},
        {"agents": {}},
        {"graph": {"edges": ["1 2"]}},
        {"coupling": {"method": "jiont"}},
        {"channels": {"x": {"model": "window", "depth": 3}}},
        {"period": "1 fortnight"},
    ],
)
def test_the_schema_refuses_mistakes(wrong: dict[str, object]) -> None:
    right = {"period": "100 ms", "duration": 1, "agents": {"1": {}}}
    VALIDATOR.validate(right)
    with pytest.raises(jsonschema.ValidationError):
        VALIDATOR.validate(right | wrong)


def test_the_schema_explains_every_key_of_a_scenario() -> None:
    text = json.dumps(VALIDATOR.schema)
    assert "later entries are merged over earlier ones" in text
    assert "\\u003c" not in text


@pytest.mark.parametrize("name", PAPER)
def test_the_paper_s_numbers(name: str) -> None:
    plan = load(name).plan
    assert plan.period_ns == 100_000_000
    assert len(plan.agents) == 10
    assert 3 in roots(plan.links)  # agent 4
    assert kappa(plan.links, plan.weights).tolist() == [1.0] * 10
    (channel,) = plan.channels.values()
    assert channel.age_bound_ns(plan.period_ns) == 1_300_000_000
    for agent in plan.agents:
        controller = agent.components[1]
        for key, value in {"k_p": 2, "k_d": 2, "k_e": 10, "lambda": 13, "k_eta": 2 * 13**0.5, "T": 0.1}.items():
            assert controller.start[key] == (value,)
        assert controller.start["Pi"] == (0.3,) * 5


def test_the_roles() -> None:
    roles = {name: [agent.components[1].start["role"] for agent in load(name).plan.agents] for name in PAPER}
    assert [i + 1 for i, role in enumerate(roles["paper_leaders"]) if role == ("leader",)] == [1, 4]
    assert roles["paper_leaderless"] == [("follower",)] * 10
    assert roles["paper_known_velocity"] == [("known_velocity",)] * 10


def test_without_a_leader_the_first_estimates_differ() -> None:
    estimates = [agent.components[1].start["v_hat_start"] for agent in load("paper_leaderless").plan.agents]
    assert len(set(estimates)) == 10


# --- finding a scenario -----------------------------------------------------------------------------------------------


def test_a_file_comes_before_a_shipped_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert configs.find("paper_leaders").parent == configs.folder()
    (tmp_path / "paper_leaders.yaml").write_text(BASE)
    (tmp_path / FILE).write_text(BASE)
    assert configs.find("paper_leaders") == Path("paper_leaders.yaml")
    assert configs.find("net") == configs.find(FILE) == Path(FILE)


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        ("paper_leader", "error: no shipped scenario 'paper_leader' (did you mean 'paper_leaders'?)"),
        ("ne.yaml", "ne.yaml: error: no such file (did you mean 'net.yaml'?)"),
        ("gone/net.yaml", "gone/net.yaml: error: no such file"),
        ("configs/paper_leaders.yaml", "no such file; the shipped scenario goes by its bare name, 'paper_leaders'"),
        ("folder", "no shipped scenario 'folder'"),
        ("./folder", "this is a folder; name a YAML file"),
    ],
)
def test_what_is_not_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: str, sentence: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / FILE).write_text(BASE)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError) as caught:
        configs.find(config)
    assert sentence in str(caught.value)
