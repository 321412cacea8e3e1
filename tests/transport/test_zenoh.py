"""Real sessions, and real processes where something dies."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from network import envelope
from network.transport import (
    HUB,
    Kind,
    PeerLost,
    Refused,
    TransportError,
    TransportTimeout,
    WireError,
)
from network.zenoh import ZenohEndpoint, ZenohHub, connect, open_hub
from tests.distributed.started import free_port
from tests.transport.peer import PATIENCE, flood, peer


@pytest.fixture
def run() -> str:
    return uuid.uuid4().hex[:8]


@pytest.fixture
def place(tmp_path: Path) -> list[str]:
    return [f"unixsock-stream/{tmp_path}/hub"]


@pytest.fixture(params=["unix", "tcp"])
def hub(request: pytest.FixtureRequest, run: str, place: list[str]) -> Iterator[ZenohHub]:
    listen = place if request.param == "unix" else [f"tcp/127.0.0.1:{free_port()}"]
    with open_hub(run, listen=listen) as opened:
        yield opened


@pytest.fixture
def unix_hub(run: str, place: list[str]) -> Iterator[ZenohHub]:
    with open_hub(run, listen=place) as opened:
        yield opened


# --- messages ----------------------------------------------------------------------------------------------------
def test_messages_go_both_ways_and_between_processes(hub: ZenohHub, run: str) -> None:
    with connect(run, "emulator", hub.endpoints) as emulator, connect(run, "worker-1", hub.endpoints) as worker:
        hub.await_peers(["emulator", "worker-1"], PATIENCE)
        for tick in range(3):
            hub.send("worker-1", Kind.GRANT, tick)
            assert worker.receive(PATIENCE).expect(Kind.GRANT, tick).sender == HUB
            worker.send("emulator", Kind.SAMPLES, tick, b"some ", b"samples")
            came = emulator.receive(PATIENCE)
            assert (came.sender, came.sequence, bytes(came.body)) == ("worker-1", tick, b"some samples")
            emulator.send(HUB, Kind.FATES, tick)
            assert hub.receive(PATIENCE).expect(Kind.FATES, tick).sender == "emulator"


def test_two_thousand_messages_arrive_in_order_and_whole(hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", hub.endpoints[0], "pour") as worker:
        for number in range(2000):
            message = hub.receive(PATIENCE).expect(Kind.ROWS, number)
            assert message.sequence == number
            assert message.body == flood(number)
        assert hub.receive(PATIENCE).kind is Kind.BYE
        assert worker.end() == 0


def test_large_messages_cross_in_the_hub(hub: ZenohHub, run: str) -> None:
    names = ["worker-1", "worker-2"]
    with ExitStack() as stack:
        workers = [stack.enter_context(peer(run, name, hub.endpoints[0], "swap")) for name in names]
        hub.await_peers(names, PATIENCE)
        for name in names:
            hub.send(name, Kind.GRANT, 0)
        for worker in workers:
            assert [worker.line(), worker.line(), worker.end()] == ["joined", "whole", 0]


def test_first_messages_arrive(unix_hub: ZenohHub, run: str) -> None:
    for number in range(30):
        name = f"worker-{number}"
        with connect(run, name, unix_hub.endpoints) as worker:
            worker.send(HUB, Kind.READY, number)
            unix_hub.await_peers([name], PATIENCE)
            unix_hub.send(name, Kind.GRANT, number)
            assert unix_hub.receive(PATIENCE).expect(Kind.READY, number).sender == name
            worker.receive(PATIENCE).expect(Kind.GRANT, number)
        assert unix_hub.receive(PATIENCE).expect(Kind.BYE).sender == name


@pytest.mark.parametrize(
    ("arrive", "what"),
    [
        ([0, 2], "message 1 was lost or overtaken: 2 came in its place"),
        ([0, 0], "message 0 came again or too late, 1 was next"),
        ([1, 0], "message 0 was lost or overtaken: 1 came in its place"),
        ([0, -1], "damaged or cut off"),
    ],
)
def test_faults_on_the_wire_are_noticed(unix_hub: ZenohHub, run: str, arrive: Sequence[int], what: str) -> None:
    frames: list[bytes] = []

    def tamper(_sender: str, _receiver: str, frame: bytes) -> Sequence[bytes]:
        frames.append(frame)
        if len(frames) < 3:
            return []
        return [frames[number] if number >= 0 else frames[1][:-1] for number in arrive] if len(frames) == 3 else [frame]

    with connect(run, "worker-1", unix_hub.endpoints, tamper=tamper) as worker:
        for tick in range(3):
            worker.send(HUB, Kind.ROWS, tick, b"rows")
        with pytest.raises(WireError, match=f"^message from worker-1: {what}"):
            [unix_hub.receive(PATIENCE) for _ in arrive]


# --- waiting -----------------------------------------------------------------------------------------------------
def test_every_wait_ends_and_not_too_early(unix_hub: ZenohHub) -> None:
    for timeout in (0.05, 0.0, 0.002, 0.05, 0.01):
        begin = time.monotonic()
        with pytest.raises(TransportTimeout, match="orchestrator: nothing arrived within"):
            unix_hub.receive(timeout)
        assert time.monotonic() - begin >= timeout


def test_a_message_ends_a_wait(unix_hub: ZenohHub, run: str) -> None:
    with connect(run, "worker-1", unix_hub.endpoints) as worker:
        with pytest.raises(TransportTimeout):
            worker.receive(0.01)
        came: list[int] = []
        thread = threading.Thread(target=lambda: came.append(worker.receive(PATIENCE).tick))
        thread.start()
        unix_hub.await_peers(["worker-1"], PATIENCE)
        unix_hub.send("worker-1", Kind.GRANT, 7)
        thread.join()
        assert came == [7]


def test_the_missing_are_named_while_waiting(unix_hub: ZenohHub, run: str) -> None:
    told: list[list[str]] = []
    with ExitStack() as stack:

        def waiting(missing: list[str]) -> None:
            told.append(missing)
            stack.enter_context(connect(run, missing[0], unix_hub.endpoints))

        with pytest.raises(TransportTimeout, match=r"^not there after 0 s: worker-1, worker-2$"):
            unix_hub.await_peers(["worker-1", "worker-2"], 0)
        unix_hub.await_peers(["worker-1", "worker-2"], PATIENCE, waiting)
        assert told == [["worker-1", "worker-2"], ["worker-2"]]


def test_processes_may_start_before_the_hub(run: str) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    names = ["worker-1", "worker-2"]
    with ExitStack() as stack:
        early = [stack.enter_context(peer(run, name, where, "echo")) for name in names]
        hub = stack.enter_context(open_hub(run, listen=[where]))
        hub.await_peers(names, PATIENCE)
        for name, process in zip(names, early, strict=True):
            hub.send(name, Kind.DONE, 0)
            assert process.end() == 0


def test_nobody_there_is_said_in_time(run: str, tmp_path: Path) -> None:
    for where in (f"tcp/127.0.0.1:{free_port()}", f"unixsock-stream/{tmp_path}/none"):
        with pytest.raises(TransportTimeout, match=f"^worker-1: nobody answers at {where}"):
            connect(run, "worker-1", [where], timeout=0.2)


def test_what_is_waited_for_is_told(run: str) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    told: list[str] = []
    opened: list[ZenohHub] = []

    def waiting(what: str) -> None:
        told.append(what)
        if not opened:
            opened.append(open_hub(run, listen=[where]))

    connect(run, "worker-1", [where], timeout=PATIENCE, waiting=waiting).close()
    opened[0].close()
    assert told[0] == f"nobody answers at {where}"


def test_the_orchestrator_of_another_run_is_named(unix_hub: ZenohHub, run: str) -> None:
    with pytest.raises(Refused, match=f"^worker-1 may not join run else: the orchestrator there plays run {run}$"):
        connect("else", "worker-1", unix_hub.endpoints, timeout=PATIENCE)
    with pytest.raises(Refused, match=rf"plays run {run}$"):
        connect(run, "worker-1", unix_hub.endpoints, namespace="lab", timeout=PATIENCE)


def test_a_name_that_is_forgotten_serves_again(unix_hub: ZenohHub, run: str) -> None:
    for _ in range(2):
        with connect(run, "worker-1", unix_hub.endpoints) as worker:
            unix_hub.await_peers(["worker-1"], PATIENCE)
            unix_hub.send("worker-1", Kind.GRANT, 0)
            worker.receive(PATIENCE).expect(Kind.GRANT, 0)
            worker.send(HUB, Kind.DONE, 0)
        unix_hub.receive(PATIENCE).expect(Kind.DONE, 0)
        unix_hub.receive(PATIENCE).expect(Kind.BYE, 0)
        unix_hub.forget("worker-1")


# --- joining -----------------------------------------------------------------------------------------------------
def test_a_name_serves_once(unix_hub: ZenohHub, run: str) -> None:
    with connect(run, "worker-1", unix_hub.endpoints) as first:
        with peer(run, "worker-1", unix_hub.endpoints[0], "echo") as second:
            assert second.line() == (
                f"worker-1 may not join run {run}: the name worker-1 is taken: "
                f"process {os.getpid()} on {socket.gethostname()} has, or had, it"
            )
            assert second.end() == 0
        unix_hub.await_peers(["worker-1"], PATIENCE)
        unix_hub.send("worker-1", Kind.GRANT, 0)
        first.receive(PATIENCE).expect(Kind.GRANT, 0)
        first.send(HUB, Kind.DONE, 0)
        unix_hub.receive(PATIENCE).expect(Kind.DONE, 0)
    with pytest.raises(Refused, match="is taken"):
        connect(run, "worker-1", unix_hub.endpoints)
    with pytest.raises(Refused, match="is taken"):
        connect(run, HUB, unix_hub.endpoints)


def test_of_many_who_claim_one_name_at_once_one_gets_it(unix_hub: ZenohHub, run: str) -> None:
    with ExitStack() as stack:
        claimants = [stack.enter_context(peer(run, "worker-1", unix_hub.endpoints[0], "echo")) for _ in range(4)]
        unix_hub.await_peers(["worker-1"], PATIENCE)
        lines = sorted(claimant.line() for claimant in claimants)
        assert lines[0] == "joined"
        assert all("is taken" in line for line in lines[1:])
        unix_hub.send("worker-1", Kind.DONE, 0)


def test_another_version_is_refused_with_both_named(
    unix_hub: ZenohHub, run: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with peer(run, "worker-1", unix_hub.endpoints[0], "echo"):
        unix_hub.await_peers(["worker-1"], PATIENCE)
        monkeypatch.setattr(envelope, "VERSION", 2)  # the hub's, from now on
        with peer(run, "worker-2", unix_hub.endpoints[0], "echo") as newcomer:
            assert newcomer.line().endswith(
                "message from orchestrator: it speaks version 2 of the protocol, this process version 1"
            )


def test_two_runs_share_a_router_of_the_users(run: str, place: list[str]) -> None:
    with open_hub("router", listen=place) as router, ExitStack() as stack:
        runs: list[tuple[str, str | None]] = [(run, None), (run, "team"), (f"{run}-2", None)]
        for at, (name, namespace) in enumerate(runs):
            hub = stack.enter_context(open_hub(name, connect=router.endpoints, namespace=namespace))
            worker = stack.enter_context(connect(name, "worker-1", hub.endpoints, namespace=namespace))
            other = stack.enter_context(connect(name, "worker-2", hub.endpoints, namespace=namespace))
            hub.await_peers(["worker-1", "worker-2"], PATIENCE)
            worker.send("worker-2", Kind.SAMPLES, at)
            other.receive(PATIENCE).expect(Kind.SAMPLES, at)
            other.send(HUB, Kind.ROWS, at)
            hub.receive(PATIENCE).expect(Kind.ROWS, at)
        with pytest.raises(Refused, match="has an orchestrator already"):
            open_hub(run, connect=router.endpoints)


# --- loss --------------------------------------------------------------------------------------------------------
def lost(hub: ZenohHub, name: str) -> PeerLost:
    """Wait for the loss of a process."""
    with pytest.raises(PeerLost) as error:
        hub.receive(PATIENCE)
    assert error.value.name == name
    return error.value


def test_a_killed_process_is_lost_after_its_last_words(hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", hub.endpoints[0], "talk") as one, peer(run, "worker-2", hub.endpoints[0], "echo"):
        hub.await_peers(["worker-1", "worker-2"], PATIENCE)
        assert bytes(hub.receive(PATIENCE).body) == b"last words"
        one.signal(signal.SIGKILL)
        reason = lost(hub, "worker-1").reason
        assert f"process {one.process.pid} on {socket.gethostname()}" in reason
        assert hub.peers == {"worker-2"}
        with pytest.raises(TransportTimeout):
            hub.receive(0.01)


def test_a_killed_process_is_named_before_anybody_waits(unix_hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", unix_hub.endpoints[0], "echo") as worker:
        unix_hub.await_peers(["worker-1"], PATIENCE)
        worker.signal(signal.SIGKILL)
        worker.end()
        lost(unix_hub, "worker-1")


def test_a_stopped_process_is_lost_when_its_lease_ends(unix_hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", unix_hub.endpoints[0], "echo") as worker:
        unix_hub.await_peers(["worker-1"], PATIENCE)
        worker.signal(signal.SIGSTOP)
        lost(unix_hub, "worker-1")


def test_a_stopped_receiver_does_not_stop_the_others(unix_hub: ZenohHub, run: str) -> None:
    names = ["worker-1", "worker-2", "worker-3"]
    with ExitStack() as stack:
        roles = zip(names, ["swap", "echo", "echo"], strict=True)
        _, stopped, _ = [stack.enter_context(peer(run, name, unix_hub.endpoints[0], role)) for name, role in roles]
        unix_hub.await_peers(names, PATIENCE)
        stopped.signal(signal.SIGSTOP)
        unix_hub.send("worker-1", Kind.GRANT, 0)  # it sends more than the hub can keep for worker-2
        lost(unix_hub, "worker-2")
        unix_hub.send("worker-3", Kind.PING, 0)
        unix_hub.receive(PATIENCE).expect(Kind.PING)


def test_a_process_that_leaves_without_a_word_neither_hangs_nor_goes_unnoticed(unix_hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", unix_hub.endpoints[0], "forget") as worker:
        unix_hub.receive(PATIENCE).expect(Kind.READY)
        unix_hub.await_peers(["worker-1"], PATIENCE)
        unix_hub.send("worker-1", Kind.DONE, 0)
        assert worker.end() == 7
        lost(unix_hub, "worker-1")


def test_the_loss_of_the_hub_is_told_to_all_every_time(run: str, place: list[str]) -> None:
    hub = open_hub(run, listen=place)
    with connect(run, "worker-1", hub.endpoints) as worker:
        hub.await_peers(["worker-1"], PATIENCE)
        hub.send("worker-1", Kind.GRANT, 1)
        hub.close()
        worker.receive(PATIENCE).expect(Kind.GRANT, 1)
        for _ in range(2):
            with pytest.raises(PeerLost, match=r"^orchestrator: it ended"):
                worker.receive(PATIENCE)
            with pytest.raises(PeerLost, match=r"^orchestrator: it ended"):
                worker.send(HUB, Kind.DONE, 0)


def test_other_processes_see_the_hub_go(run: str, place: list[str]) -> None:
    hub = open_hub(run, listen=place)
    with peer(run, "worker-1", hub.endpoints[0], "outlive") as worker:
        hub.receive(PATIENCE).expect(Kind.READY)
        hub.close()
        assert worker.line() == "joined"
        assert worker.line() == f"lost {HUB}"
        assert worker.end() == 0


def test_who_says_bye_is_not_lost(unix_hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", unix_hub.endpoints[0], "echo") as worker:
        unix_hub.await_peers(["worker-1"], PATIENCE)
        unix_hub.send("worker-1", Kind.DONE, 0)
        unix_hub.receive(PATIENCE).expect(Kind.BYE)
        assert worker.end() == 0
        with pytest.raises(TransportTimeout):
            unix_hub.receive(0.05)


def test_a_hub_that_says_bye_is_not_lost(run: str, place: list[str]) -> None:
    hub = open_hub(run, listen=place)
    with connect(run, "worker-1", hub.endpoints) as worker:
        hub.await_peers(["worker-1"], PATIENCE)
        hub.send("worker-1", Kind.BYE, 0)
        hub.close()
        worker.receive(PATIENCE).expect(Kind.BYE)
        with pytest.raises(TransportTimeout):
            worker.receive(0.05)


def test_nonsense_does_not_keep_others_from_joining(unix_hub: ZenohHub, run: str) -> None:
    with connect(run, "worker-1", unix_hub.endpoints) as worker:
        for key in (f"netcosim/{run}/@join/worker-2", f"netcosim/{run}/@join/no name"):
            for payload in (b"nonsense", None):
                list(worker._session.get(key, payload=payload, timeout=PATIENCE))
        with connect(run, "worker-2", unix_hub.endpoints):
            unix_hub.await_peers(["worker-1", "worker-2"], PATIENCE)


# --- the host ----------------------------------------------------------------------------------------------------
def test_the_socket_goes_with_the_hub(run: str, place: list[str], tmp_path: Path) -> None:
    with open_hub(run, listen=place) as hub:
        assert (tmp_path / "hub").is_socket()
    assert not (tmp_path / "hub").exists()
    hub.close()
    with pytest.raises(TransportError, match="the endpoint is closed"):
        hub.receive(0)


def test_a_port_in_use_is_said(run: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        where = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"^orchestrator: cannot listen at {where}"):
            open_hub(run, listen=[where])
    with pytest.raises(TransportError, match=f"^orchestrator: cannot reach {where}"):
        open_hub(run, connect=[where], timeout=0.2)


@pytest.mark.parametrize("name", ["a/b", "*", "", "@alive"])
def test_names_that_are_no_part_of_a_key_are_refused(unix_hub: ZenohHub, run: str, name: str) -> None:
    with pytest.raises(ValueError, match="write letters"):
        connect(run, name, unix_hub.endpoints)
    with pytest.raises(ValueError, match="write letters"):
        open_hub(name, listen=["unixsock-stream/nowhere"])
    with pytest.raises(ValueError, match="write letters"):
        open_hub(run, listen=["unixsock-stream/nowhere"], namespace=name)


def test_nothing_stays_behind(run: str, place: list[str]) -> None:
    before = set(threading.enumerate())
    for _ in range(3):
        with open_hub(run, listen=place) as hub, connect(run, "worker-1", hub.endpoints):
            pass
    assert set(threading.enumerate()) == before


def test_a_process_ends_when_the_hub_goes(unix_hub: ZenohHub, run: str) -> None:
    with peer(run, "worker-1", unix_hub.endpoints[0], "echo") as started:
        assert started.line() == "joined"
        unix_hub.close()
        assert started.end() == 1


# --- sessions that break -----------------------------------------------------------------------------------------
def test_a_session_that_is_gone_is_an_error_of_the_transport(run: str, place: list[str]) -> None:
    """As Zenoh closes it where it cannot go on."""
    with open_hub(run, listen=place) as hub, connect(run, "worker-1", hub.endpoints) as worker:
        hub.await_peers(["worker-1"], PATIENCE)
        worker._session.close()  # type: ignore[no-untyped-call]
        for act in (lambda: worker.send(HUB, Kind.DONE, 0), lambda: worker.receive(PATIENCE)):
            with pytest.raises(PeerLost, match=r"^orchestrator: worker-1 cannot (send|receive)"):
                act()
        hub._session.close()  # type: ignore[no-untyped-call]
        with pytest.raises(TransportError, match=r"^orchestrator cannot send to worker-1: session closed"):
            hub.send("worker-1", Kind.GRANT, 0)
        with pytest.raises(TransportError, match=r"^orchestrator cannot receive: "):
            hub.receive(PATIENCE)


def n_open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("opens", ["hub", "hub at a router", "process"])
def test_a_session_that_nobody_gets_is_closed(
    opens: str, run: str, place: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever fails after it was opened: at its end its connections, and the socket at which it listens, are gone."""

    def fails(*_: object) -> None:
        raise zenoh.ZError("session closed")

    opening: dict[str, Callable[[], object]] = {
        "hub": lambda: open_hub(run, listen=place),
        "hub at a router": lambda: open_hub(run, connect=place),
        "process": lambda: connect(run, "emulator", place, listen=True),
    }
    with ExitStack() as stack:
        if opens == "hub at a router":
            stack.enter_context(open_hub("router", listen=place))
        threads, n_files = set(threading.enumerate()), n_open_files()
        with monkeypatch.context() as breaking:
            breaking.setattr(ZenohEndpoint, "_serve", fails)
            with pytest.raises(TransportError, match="cannot begin: session closed"):
                opening[opens]()
        deadline = time.monotonic() + PATIENCE
        while not threads.issuperset(threading.enumerate()) or n_open_files() > n_files:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert not (tmp_path / "hub").exists()
