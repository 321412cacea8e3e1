"""Real sessions over TLS with mutual authentication and access control."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from network.access import Members, connecting, listening
from network.transport import HUB, Kind
from network.zenoh import ZenohClient, ZenohHub, connect, open_hub
from tests.transport.peer import PATIENCE
from tests.transport.test_zenoh import free_port

NAMES = ("emulator", "worker-1", "worker-2")


@pytest.fixture
def run() -> str:
    return uuid.uuid4().hex[:8]


@pytest.fixture
def hub(team: Path, run: str) -> Iterator[ZenohHub]:
    where = [f"tls/127.0.0.1:{free_port()}"]
    settings = listening(team / HUB, where, Members(NAMES, ["emulator"], run))
    with open_hub(run, listen=where, settings=settings) as opened:
        yield opened


def join(team: Path, run: str, hub: ZenohHub, name: str, keys: str | None = None) -> ZenohClient:
    return connect(run, name, hub.endpoints, settings=connecting(team / (keys or name)), timeout=PATIENCE)


def test_everybody_says_what_it_may(team: Path, run: str, hub: ZenohHub) -> None:
    with (
        join(team, run, hub, "emulator") as emulator,
        join(team, run, hub, "worker-1") as worker,
        join(team, run, hub, "worker-2.2", "worker-2") as replacement,
    ):
        hub.await_peers(["emulator", "worker-1", "worker-2.2"], PATIENCE)
        for tick in range(3):
            for one in (worker, replacement):
                hub.send(one.name, Kind.GRANT, tick)
                one.receive(PATIENCE).expect(Kind.GRANT, tick)
                one.send("emulator", Kind.SAMPLES, tick, b"samples" * 2**16)
                assert emulator.receive(PATIENCE).expect(Kind.SAMPLES, tick).body == b"samples" * 2**16
                emulator.send(one.name, Kind.MAIL, tick)
                assert one.receive(PATIENCE).expect(Kind.MAIL, tick).sender == "emulator"
                one.send(HUB, Kind.ROWS, tick)
                assert hub.receive(PATIENCE).expect(Kind.ROWS, tick).sender == one.name
        worker.close()
        assert hub.receive(PATIENCE).expect(Kind.BYE).sender == "worker-1"
