"""A run across two hosts, as far as one machine can show it: two network namespaces, each with files of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.distributed.started import started
from tests.distributed.test_hosts import digest, plain_digest

ADDRESSES = {"a": "10.213.77.1", "b": "10.213.77.2"}


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True, timeout=20)


@pytest.fixture
def hosts() -> Iterator[dict[str, list[str]]]:
    """What to put before a command to run it on host a or b; they are joined by a cable, and by nothing else."""
    if shutil.which("ip") is None:
        pytest.skip("needs the command ip (package iproute2)")
    names = {host: f"cosim-{host}-{os.getpid()}" for host in ADDRESSES}
    with ExitStack() as stack:
        for name in names.values():
            try:
                ip("netns", "add", name)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"network namespaces are not allowed here: {error.stderr.strip()}")
            stack.callback(ip, "netns", "del", name)
        cable = {host: f"cs{host}{os.getpid()}" for host in names}
        try:
            ip("link", "add", cable["a"], "type", "veth", "peer", "name", cable["b"])
        except subprocess.CalledProcessError as error:
            pytest.skip(f"virtual cables are not allowed here: {error.stderr.strip()}")
        for host, name in names.items():
            ip("link", "set", cable[host], "netns", name)
            ip("-n", name, "addr", "add", f"{ADDRESSES[host]}/24", "dev", cable[host])
            ip("-n", name, "link", "set", cable[host], "up")
            ip("-n", name, "link", "set", "lo", "up")
        yield {host: ["ip", "netns", "exec", name] for host, name in names.items()}


def test_two_hosts_with_keys(hosts: dict[str, list[str]], tmp_path: Path) -> None:
    for command in (
        ["keys", "init"],
        ["keys", "issue", "orchestrator", "--host", ADDRESSES["a"]],
        *(["keys", "issue", name] for name in ("emulator", "lab-a", "lab-b")),
    ):
        with started(tmp_path / "team", *command) as making:
            making.succeed()
    keys = tmp_path / "team" / "keys"
    where = f"tls/{ADDRESSES['a']}:7447"
    a, b = hosts["a"], hosts["b"]
    scenario = ("paper_leaders", "--until", "1 s", "--set", "workers={lab-a: 1..5, lab-b: 6..10}")
    with ExitStack() as stack:
        options = ("--no-report", "--out", "out")
        serve = started(
            tmp_path / "s",
            "serve",
            *scenario,
            "--listen",
            where,
            *options,
            "--keys",
            str(keys / "orchestrator"),
            prefix=a,
        )
        orchestrator = stack.enter_context(serve)
        others = [
            stack.enter_context(
                started(tmp_path / name, role, "--connect", where, *named, "--keys", str(keys / name), prefix=host)
            )
            for name, role, named, host in (
                ("lab-b", "worker", (), b),
                ("emulator", "emulator", (), a),
                ("lab-a", "worker", ("--name", "lab-a"), a),
            )
        ]
        orchestrator.hear("lab-b (agents 6..10) is ready")
        output = orchestrator.succeed()
        for other in others:
            other.succeed()
    assert f"  cosim worker --connect {where} --keys {keys / 'lab-b'}\n" in output
    assert digest(tmp_path / "s" / "out") == plain_digest(tmp_path, *scenario[:3])
