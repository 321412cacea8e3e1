"""Real sessions over TLS with mutual authentication and access control."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
import zenoh

from network.access import Members, connecting, listening
from network.codec import encode_object
from network.envelope import Streams
from network.transport import HUB, Kind, TransportTimeout
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


def refusal(run: str, where: str, name: str, settings: Mapping[str, object]) -> str:
    """Why a process does not even reach the hub."""
    with pytest.raises(TransportTimeout) as error:
        connect(run, name, [where], settings=settings, timeout=1.0)
    return str(error.value)


def test_strangers_do_not_get_in(team: Path, strangers: Path, run: str, hub: ZenohHub) -> None:
    (where,) = hub.endpoints
    authority = {"transport/link/tls/root_ca_certificate": str(team / "ca.pem")}
    for at, settings in (
        (where, connecting(strangers / "worker-1")),
        (where, {**connecting(strangers / "worker-1"), **authority}),  # it trusts us
        (where, {"transport/link/protocols": ["tls"], **authority}),  # no certificate
        (where, connecting(team / "expired")),
        (where.replace("tls/", "tcp/"), {}),
    ):
        assert f"nobody answers at {at}" in refusal(run, at, "worker-1", settings)
    with join(team, run, hub, "worker-1"):
        hub.await_peers(["worker-1"], PATIENCE)


def test_nobody_says_anything_in_anothers_name(team: Path, run: str, hub: ZenohHub) -> None:
    """What is not let through is what would come first."""
    with join(team, run, hub, "emulator") as emulator, join(team, run, hub, "worker-1") as worker:
        hub.await_peers(["emulator", "worker-1"], PATIENCE)
        for receiver, there in ((HUB, hub), ("emulator", emulator)):
            forged = Streams(run, "worker-2").encode(receiver, Kind.SAMPLES, 0, [b"forged"])
            worker._session.put(f"netcosim/{run}/{receiver}/worker-2", forged)
            worker.send(receiver, Kind.SAMPLES, 1)
            assert there.receive(PATIENCE).expect(Kind.SAMPLES, 1).sender == "worker-1"
        worker._session.put(f"netcosim/{run}/worker-2/worker-1", b"")  # nor to another worker
        worker._session.liveliness().declare_token(f"netcosim/{run}/@alive/worker-2/token")
        hello = Streams(run, "worker-2").encode(HUB, Kind.HELLO, 0, encode_object({"token": "token"}))
        replies = worker._session.get(f"netcosim/{run}/@join/worker-2", payload=hello, timeout=1.0)
        assert [reply.ok for reply in replies if reply.ok is not None] == []
        with join(team, run, hub, "worker-2") as owner:  # its name is still free
            hub.await_peers(["worker-2"], PATIENCE)
            hub.send("worker-2", Kind.GRANT, 0)
            owner.receive(PATIENCE).expect(Kind.GRANT, 0)
    settings = connecting(team / "worker-1")
    with pytest.raises(TransportTimeout, match=r"it is there, but does not hear worker-2 .are name and keys"):
        connect(run, "worker-2", hub.endpoints, settings=settings, timeout=6.0)

    def waiting(what: str) -> None:
        if "is there, but does not hear worker-3" in what:
            raise InterruptedError

    with pytest.raises(InterruptedError):  # it is said meanwhile, and not only at the end
        connect(run, "worker-3", hub.endpoints, settings=settings, timeout=PATIENCE, waiting=waiting)


def test_nobody_reads_what_is_anothers(team: Path, run: str, hub: ZenohHub) -> None:
    with (
        join(team, run, hub, "emulator") as emulator,
        join(team, run, hub, "worker-1") as worker,
        join(team, run, hub, "worker-2") as other,
    ):
        hub.await_peers(["emulator", "worker-1", "worker-2"], PATIENCE)
        keys = ("**", f"netcosim/{run}/*/*", f"netcosim/{run}/worker-2/*", f"netcosim/{run}/{HUB}/*")
        spies = [worker._session.declare_subscriber(key, zenoh.handlers.FifoChannel(99)) for key in keys]
        other.send(HUB, Kind.ROWS, 0, b"secret")
        hub.receive(PATIENCE).expect(Kind.ROWS, 0)
        for sender in (emulator, hub):
            for receiver in (other, worker):  # a message of its own comes after those that are none of its business
                sender.send(receiver.name, Kind.MAIL, 0, b"secret")
                receiver.receive(PATIENCE).expect(Kind.MAIL, 0)
        seen = [str(sample.key_expr) for spy in spies for sample in iter(spy.handler.try_recv, None)]
        assert {key.split("/")[2] for key in seen} <= {"worker-1"}


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
