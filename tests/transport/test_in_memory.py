"""The endpoint in memory, and what every endpoint promises: nothing lost, repeated, overtaken or damaged unnoticed."""

from __future__ import annotations

import threading

import pytest

from network.transport import HUB, InMemoryNetwork, Kind, PeerLost, Refused, TransportTimeout, WireError

PATIENCE = 30.0


def test_messages_arrive_in_order_and_whole() -> None:
    network = InMemoryNetwork("run")
    with network.hub() as hub, network.connect("worker-1") as one, network.connect("worker-2") as two:
        for tick in range(3):
            one.send("worker-2", Kind.SAMPLES, tick, b"from ", b"one")
            hub.send("worker-2", Kind.GRANT, tick)
        came = [two.receive(0) for _ in range(6)]
        assert [(e.sender, e.kind, e.tick, e.sequence, bytes(e.body)) for e in came[::2]] == [
            ("worker-1", Kind.SAMPLES, tick, tick, b"from one") for tick in range(3)
        ]
        assert [(e.sender, e.tick) for e in came[1::2]] == [(HUB, tick) for tick in range(3)]


def test_a_wait_ends() -> None:
    with InMemoryNetwork("run").hub() as hub:
        with pytest.raises(TransportTimeout, match=r"orchestrator: nothing arrived within 0\.01 s"):
            hub.receive(0.01)
        with pytest.raises(TransportTimeout):
            hub.receive(0)


def test_threads_wait_for_each_other() -> None:
    network = InMemoryNetwork("run")
    with network.hub() as hub:

        def worker() -> None:
            with network.connect("worker-1") as endpoint:
                endpoint.send(HUB, Kind.READY, endpoint.receive(PATIENCE).tick)

        thread = threading.Thread(target=worker)
        thread.start()
        hub.await_peers(["worker-1"], PATIENCE)
        hub.send("worker-1", Kind.GRANT, 9)
        assert hub.receive(PATIENCE).tick == 9
        assert hub.receive(PATIENCE).kind is Kind.BYE
        thread.join()


def test_the_missing_are_named_while_waiting() -> None:
    network = InMemoryNetwork("run")
    told: list[list[str]] = []
    with network.hub() as hub, network.connect("worker-2"):
        with pytest.raises(TransportTimeout, match=r"not there after 0\.01 s: worker-1, worker-3"):
            hub.await_peers(["worker-1", "worker-2", "worker-3"], 0.01, told.append)
        assert told == [["worker-1", "worker-3"]]
        hub.await_peers(["worker-2"], 0, told.append)
        assert hub.peers == {"worker-2"}


def test_a_loss_is_told_once_after_what_arrived_before_it() -> None:
    network = InMemoryNetwork("run")
    with network.hub() as hub:
        worker = network.connect("worker-1")
        worker.send(HUB, Kind.ROWS, 1)
        worker.kill()
        assert hub.receive(0).kind is Kind.ROWS
        with pytest.raises(PeerLost, match=r"^worker-1: it ended") as lost:
            hub.receive(0)
        assert lost.value.name == "worker-1"
        with pytest.raises(TransportTimeout):
            hub.receive(0)


def test_who_says_bye_is_not_lost() -> None:
    network = InMemoryNetwork("run")
    with network.hub() as hub:
        network.connect("worker-1").close()
        assert hub.receive(0).kind is Kind.BYE
        with pytest.raises(TransportTimeout):
            hub.receive(0)


def test_the_loss_of_the_hub_is_told_to_all_every_time() -> None:
    network = InMemoryNetwork("run")
    hub, worker = network.hub(), network.connect("worker-1")
    hub.close()
    for _ in range(2):
        with pytest.raises(PeerLost, match=r"^orchestrator"):
            worker.receive(0)
        with pytest.raises(PeerLost, match=r"^orchestrator"):
            worker.send(HUB, Kind.DONE, 0)
    worker.close()
    worker.close()


def test_a_hub_that_says_bye_is_not_lost() -> None:
    network = InMemoryNetwork("run")
    hub, worker = network.hub(), network.connect("worker-1")
    hub.send("worker-1", Kind.BYE, 0)
    hub.close()
    worker.receive(0).expect(Kind.BYE)
    with pytest.raises(TransportTimeout):
        worker.receive(0.01)
    worker.close()


def test_a_name_serves_once() -> None:
    network = InMemoryNetwork("run")
    with pytest.raises(Refused, match="no orchestrator of run run is there"):
        network.connect("worker-1")
    with network.hub(), network.connect("worker-1") as worker:
        for _ in range(2):
            with pytest.raises(Refused, match="the name worker-1 is taken: a process of this run has, or had, it"):
                network.connect("worker-1")
            worker.close()
        with pytest.raises(Refused):
            network.hub()


@pytest.mark.parametrize(
    ("arrive", "what"),
    [
        ([0, 2], "message 1 was lost or overtaken: 2 came in its place"),
        ([0, 0], "message 0 came again or too late, 1 was next"),
        ([1, 0], "message 0 was lost or overtaken: 1 came in its place"),
        ([0, -1], "damaged or cut off"),
    ],
)
def test_faults_on_the_wire_are_noticed_and_named(arrive: list[int], what: str) -> None:
    frames: list[bytes] = []

    def tamper(_sender: str, _receiver: str, frame: bytes) -> list[bytes]:
        frames.append(frame)
        return [] if len(frames) < 3 else [frames[number] if number >= 0 else frames[1][:-1] for number in arrive]

    network = InMemoryNetwork("run", tamper)
    with network.hub() as hub:
        worker = network.connect("worker-1")
        for tick in range(3):
            worker.send(HUB, Kind.ROWS, tick, b"rows")
        with pytest.raises(WireError, match=f"^message from worker-1: {what}"):
            [hub.receive(0) for _ in arrive]
