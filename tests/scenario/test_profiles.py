"""Channels by the name of a profile: shipped or a file, with single values changed, every mistake where it was made."""

from pathlib import Path

import jsonschema
import pytest

from cosim.errors import ConfigError
from cosim.planning import load as plan
from cosim.scenario import profiles
from cosim.scenario.source import parse
from cosim.scenario.spec import json_schema
from network.netem import Netem
from tests.scenario.scenarios import BASE

MINE = """\
title: Mine
source: measured last week
channel:
  model: netem
  delay: 40 ms
  recorded: cell.csv
"""


def _scenario(folder: Path, channel: str) -> str:
    (folder / "net.yaml").write_text(BASE.replace("{model: ideal}", channel))
    return str(folder / "net.yaml")


def _problems(config: str, *settings: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        plan(config, settings)
    return [str(problem) for problem in caught.value.problems]


@pytest.mark.parametrize("name", profiles.names())
def test_every_shipped_profile_is_valid_and_says_where_it_is_from(name: str) -> None:
    profile = profiles.load(profiles.find(name, Path()))
    assert profile.title
    assert any(word in profile.source for word in ("IEEE", "3GPP", "RFC", "Starlink", "LoRaWAN", "Real-Time"))
    assert "choice" in profile.source
    assert isinstance(profiles.model_of(profile), Netem)


def test_there_are_more_than_ten() -> None:
    assert len(profiles.names()) > 10


def test_a_shipped_profile_by_its_name(tmp_path: Path) -> None:
    model = plan(_scenario(tmp_path, "wifi_busy")).plan.channels["fast"]
    assert model == profiles.model_of(profiles.load(profiles.find("wifi_busy", Path())))
    assert "distribution: lognormal" in plan(_scenario(tmp_path, "wifi_busy")).plan.scenario


@pytest.mark.parametrize("rest", ["delay: 80 ms", "delay: 80 ms, loss: 2 %", "rate: 1 Mbit/s"])
def test_values_beside_the_name_replace_the_profile_s(tmp_path: Path, rest: str) -> None:
    model = plan(_scenario(tmp_path, f"{{profile: lte, {rest}}}")).plan.channels["fast"].as_written()
    shipped = profiles.load(profiles.find("lte", Path())).channel.plain()
    wanted = Netem.model_validate({**shipped, **parse(f"{{{rest}}}", "x").plain()}).as_written()
    assert model == wanted


def test_the_command_line_names_a_profile_or_changes_a_value_of_one(tmp_path: Path) -> None:
    config = _scenario(tmp_path, "lte")
    changed = plan(config, ["channels.fast.loss=7 %"]).plan.channels["fast"].as_written()
    assert (changed["loss"], changed["delay"]["time"]) == (0.07, "40 ms")
    assert plan(config, ["channels.fast=tsn"]).plan.channels["fast"].as_written()["delay"]["time"] == "100 us"


def test_a_file_s_own_files_lie_beside_it(tmp_path: Path) -> None:
    (tmp_path / "library").mkdir()
    (tmp_path / "library" / "mine.yaml").write_text(MINE)
    (tmp_path / "library" / "cell.csv").write_text("time,delay\n0,1 ms\n1,2 ms\n2,1 ms\n")
    model = plan(_scenario(tmp_path, "library/mine.yaml")).plan.channels["fast"]
    assert model.as_written()["recorded"] == str(tmp_path / "library" / "cell.csv")


def test_the_nearest_name_is_suggested(tmp_path: Path) -> None:
    config = _scenario(tmp_path, "wifi_bussy")
    (problem,) = _problems(config)
    line = 1 + BASE[: BASE.index("{model: ideal}")].count("\n")
    assert problem.startswith(f"{config}:{line}:9: error: no shipped profile 'wifi_bussy' (did you mean 'wifi_busy'?)")
    (problem,) = _problems(_scenario(tmp_path, "{delay: 1 ms, profile: wifi_bussy}"))
    assert problem.startswith(f"{config}:{line}:32: error: no shipped profile 'wifi_bussy'")
    (tmp_path / "mine.yaml").write_text(MINE)
    (problem,) = _problems(_scenario(tmp_path, "mein.yaml"))
    assert f"no such file: {tmp_path / 'mein.yaml'} (did you mean 'mine.yaml'?)" in problem


def test_mistakes_are_found_in_the_profile_s_file(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text(MINE.replace("40 ms", "40 mss").replace("  recorded: cell.csv\n", ""))
    (problem,) = _problems(_scenario(tmp_path, "mine.yaml"))
    assert problem == (
        f"{mine}:5:10: error: channels.fast.delay: unknown unit of time 'mss'; one of ns, us, µs, ms, s, min, h "
        "(cosim channel --explain delay)"
    )
    mine.write_text("titel: Mine\nchannels: {model: ideal}\n")
    found = _problems(_scenario(tmp_path, "mine.yaml"))
    assert f"{mine}:1:1: error: unknown key 'titel' (did you mean 'title'?)" in found
    assert f"{mine}:2:1: error: unknown key 'channels' (did you mean 'channel'?)" in found
    assert any("the profile 'mine.yaml' has mistakes" in problem for problem in found)
    mine.write_text("just text\n")
    assert f"{mine}:1:1: error: a profile is a mapping with the key 'channel'" in _problems(f"{tmp_path}/net.yaml")


def test_the_schema_for_editors_accepts_names() -> None:
    validator = jsonschema.Draft202012Validator(json_schema())
    tree = parse(BASE.replace("{model: ideal}", "wifi_busy").replace("analysis", "analysis"), "x").plain()
    validator.validate(tree)
    tree["channels"] = {"fast": {"profile": "lte", "delay": "80 ms"}}
    validator.validate(tree)
