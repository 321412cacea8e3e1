"""A run through a Zenoh router of the user's, with keys and the configuration that `cosim keys router` writes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from subprocess import PIPE, Popen

import pytest

from cosim.cli import main
from network import authority
from tests.distributed.started import PATIENCE, ROOT, free_port, started
from tests.distributed.test_hosts import digest, plain_digest

ROUTER = """\
import sys, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("open", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("router") / "keys"
    authority.create(folder)
    authority.issue(folder, "router", ["127.0.0.1"])
    for name in ("orchestrator", "emulator", "lab-a", "lab-b", "lab-c"):
        authority.issue(folder, name)
    return folder


@contextmanager
def router(config: Path) -> Iterator[None]:
    with Popen([sys.executable, "-c", ROUTER, str(config)], cwd=ROOT, text=True, stdin=PIPE, stdout=PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "open\n"
            yield
        finally:
            process.communicate("", PATIENCE)


def test_a_run_with_keys_through_a_router(keys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where, config = f"tls/127.0.0.1:{free_port()}", tmp_path / "router.json5"
    written = ["lab-a", "lab-b", "--listen", where, "--keys", str(keys / "router"), "--namespace", "team"]
    assert main(["keys", "router", *written, "-o", str(config)]) == 0
    assert capsys.readouterr().out == f"wrote {config}; next: zenohd --config {config}\n"
    place = ("--connect", where, "--namespace", "team", "--keys")
    scenario = ("paper_leaders", "--until", "1 s", "--set", "workers={lab-a: 1..5, lab-b: 6..10}")
    commands = {
        "orchestrator": ("serve", *scenario, *place, str(keys / "orchestrator"), "--no-report", "--out", "out"),
        "lab-a": ("worker", *place, str(keys / "lab-a")),
        "lab-b": ("worker", *place, str(keys / "lab-b")),
        "lab-c": ("worker", *place, str(keys / "lab-c"), "--wait", "6 s"),
    }
    with router(config), ExitStack() as stack:
        running = {name: stack.enter_context(started(tmp_path / name, *line)) for name, line in commands.items()}
        code, _, said = running.pop("lab-c").end()  # issued by the same authority, but not one of these
        assert code == 3, said
        assert "lab-c: orchestrator of run run is not there, or does not answer" in said
        running["emulator"] = stack.enter_context(
            started(tmp_path / "emulator", "emulator", *place, str(keys / "emulator"))
        )
        for command in running.values():
            command.succeed()
    assert digest(tmp_path / "orchestrator" / "out") == plain_digest(tmp_path, *scenario[:3])


def test_the_configuration_is_printed(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "router", "lab-a", "--listen", "tls/0.0.0.0:7447", "--keys", str(keys / "router")]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["access_control"]["default_permission"] == "deny"
    names = [subject["cert_common_names"] for subject in tree["access_control"]["subjects"]]
    assert names == [["emulator"], ["lab-a"], ["orchestrator"]]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["lab-a", "--listen", "tcp/0.0.0.0:7447"], "would not use the keys in "),
        (["lab-a", "--listen", "tls/192.0.2.7:7447"], "is for 127.0.0.1, not for 192.0.2.7"),
        (["*", "--listen", "tls/0.0.0.0:7447"], "process '*': write letters, digits"),
        (["lab-a", "--listen", "tls/0.0.0.0:7447", "--namespace", "a/b"], "namespace 'a/b': write letters, digits"),
        (["lab-a", "lab-a.x", "--listen", "tls/0.0.0.0:7447"], "rename one of them"),
    ],
)
def test_mistakes(keys: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "router", *arguments, "--keys", str(keys / "router")]) == 2
    assert said in capsys.readouterr().err


def test_a_router_without_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "router", "lab-a", "--listen", "tls/0.0.0.0:7447", "--keys", str(tmp_path / "router")]) == 2
    assert "to get one: cosim keys issue router" in capsys.readouterr().err
