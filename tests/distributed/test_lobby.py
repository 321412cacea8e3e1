"""Who is let into a run that is started by hand, and which agents they get: the state machine, over the wire format."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

import fmus
from cosim.distributed.assignment import Share, share_of
from cosim.distributed.files import Offer, Procurement
from cosim.distributed.hosting import _farewell
from cosim.distributed.lobby import Claim, Lobby
from cosim.distributed.serving import send
from cosim.planning import load
from network.codec import decode_object, encode_object
from network.transport import HUB, InMemoryNetwork, Kind, WireError
from tests.distributed.networks import planned, ring, scenario


class Hall:
    """A lobby and those who come, in one process."""

    def __init__(self, lobby: Lobby) -> None:
        self.lobby = lobby
        self.network = InMemoryNetwork("hall")
        self.hub = self.network.hub()

    def turn(self) -> None:
        """The lobby handles one message."""
        envelope = self.hub.receive(0)
        send(self.hub, self.lobby.handle(envelope))
        if envelope.kind is Kind.BYE:
            self.hub.forget(envelope.sender)

    def claim(self, name: str, agents: str | None = None, version: str = "1.0") -> str | None:
        """Come and claim; why not, if it is refused."""
        guest = self.network.connect(name)
        send(guest, [Claim(version, "here", agents).message()])
        self.turn()
        answer = guest.receive(0)
        if answer.kind is Kind.OFFER:
            guest.send(HUB, Kind.PREPARED, 0)
            self.turn()
            return None
        return str(decode_object(answer.expect(Kind.FAILURE))["message"])


def hall(division: dict[str, Share] | None = None, n_agents: int = 5) -> Hall:
    return Hall(Lobby(planned(scenario(n_agents, ring(n_agents))), division, "1.0"))


def test_claims_decide_where_the_scenario_does_not() -> None:
    place = hall()
    assert place.lobby.missing == ["the emulator", "agents 1..5"]
    assert place.claim("b", "2, 4..5") is None
    assert place.claim("c", "2-3") == "agent 2 is carried by b (here) already; without a worker: agents 1, 3"
    assert place.claim("d") == "say which agents d carries, with --agents; without a worker: agents 1, 3"
    assert place.claim("e", "3, 7, 9") == "there is no agent 7, 9; the agents are 1..5"
    assert place.claim("emulator") is None
    assert place.lobby.missing == ["agents 1, 3"]
    assert not place.lobby.complete
    assert place.claim("a", "1,3") is None
    assert place.lobby.complete
    assert list(place.lobby.workers.items()) == [("a", (0, 2)), ("b", (1, 3, 4))]


def test_the_scenario_decides_where_it_names_workers() -> None:
    place = hall({"lab-a": share_of([0, 4]), "lab-b": range(1, 4)})
    assert place.lobby.missing == ["the emulator", "lab-a (agents 1, 5)", "lab-b (agents 2..4)"]
    assert place.claim("lab-c") == (
        "no worker is called 'lab-c' (did you mean 'lab-b'?); say which with --name: lab-a (agents 1, 5), "
        "lab-b (agents 2..4)"
    )
    assert place.claim("lab-a", "1..5") == "the scenario gives lab-a (agents 1, 5); leave out --agents"
    place.hub.forget("lab-a")
    assert place.claim("lab-b", "2..4") is None
    assert place.lobby.missing == ["the emulator", "lab-a (agents 1, 5)"]


def test_another_netcosim_is_refused_with_both_versions() -> None:
    assert hall().claim("a", "1", version="0.9") == (
        "it is netcosim 0.9, the orchestrator netcosim 1.0; install the same on all hosts"
    )


def test_whoever_leaves_makes_room() -> None:
    place = hall()
    assert place.claim("a", "1..5") is None
    place.network.endpoints["a"].close()
    place.turn()
    assert place.lobby.missing == ["the emulator", "agents 1..5"]
    assert place.claim("a", "1..5") is None


@pytest.mark.parametrize("kind", [Kind.PREPARED, Kind.FETCH, Kind.ROWS])
def test_nobody_says_anything_before_the_claim(kind: Kind) -> None:
    place = hall()
    place.network.connect("a").send(HUB, kind, 0)
    with pytest.raises(WireError, match=f"a {kind.name} is nothing for an orchestrator that waits"):
        place.turn()


@pytest.mark.parametrize(("sha256", "chunk"), [("ab" * 32, 0), ("../../etc/passwd", 0), (None, -1)])
def test_only_what_is_offered_can_be_fetched(sha256: str | None, chunk: int) -> None:
    place = Hall(Lobby(load("paper_leaders").plan, None, "1.0"))
    assert place.claim("a", "1..10") is None
    body = encode_object({"sha256": sha256})
    place.network.endpoints["a"].send(HUB, Kind.FETCH, chunk, *body)
    with pytest.raises(WireError, match="asks for a file that was not offered"):
        place.turn()


# --- files ------------------------------------------------------------------------------------------------------------
class Fetching:
    """A worker on a host without the shipped FMUs, and the chunks on their way to it."""

    def __init__(self, store: Path, monkeypatch: pytest.MonkeyPatch, folders: Sequence[Path] = ()) -> None:
        self.place = Hall(Lobby(load("paper_leaders").plan, None, "1.0"))
        self.guest = self.place.network.connect("a")
        send(self.guest, [Claim("1.0", "here", "1..3").message()])
        self.place.turn()
        self.offer = Offer.decode(self.guest.receive(0))
        with monkeypatch.context() as elsewhere:
            elsewhere.setattr("fmus.names", list)
            self.procurement = Procurement(self.offer, folders, store)

    def fetch(self) -> int:
        """All files; how many parts they came in."""
        count = 0
        send(self.guest, self.procurement.ask())
        while not self.procurement.done:
            self.place.turn()
            send(self.guest, self.procurement.take(self.guest.receive(0)))
            count += 1
        return count


def test_files_come_in_parts_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.distributed.files.CHUNK_BYTES", 1000)
    fetching = Fetching(tmp_path, monkeypatch)
    originals = {component.path for agent in load("paper_leaders").plan.agents for component in agent.components}
    assert fetching.fetch() == sum(-(-path.stat().st_size // 1000) for path in originals if path)
    fetched = {path.read_bytes() for path in fetching.procurement.located.values()}
    assert fetched == {path.read_bytes() for path in originals if path}
    assert all(path.parent == tmp_path for path in fetching.procurement.located.values())


@pytest.mark.parametrize("kept", ["files", "current"])
def test_files_are_found_by_what_is_in_them(kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the folder of --files as well as in the current one, whatever they are called."""
    (tmp_path / "files").mkdir()
    (tmp_path / "current").mkdir()
    monkeypatch.chdir(tmp_path / "current")
    fetching = Fetching(tmp_path, monkeypatch, [Path("../files"), Path()])
    needed = sorted({name for item in fetching.offer.items for name in item.names})
    for i, name in enumerate(needed):
        shutil.copy(fmus.path(name), tmp_path / kept / f"{i}.fmu")
    fetching = Fetching(tmp_path, monkeypatch, [Path("../files"), Path()])
    assert fetching.procurement.done
    monkeypatch.chdir("/")  # as an FMU may do
    found = fetching.procurement.located
    assert {path.read_bytes() for path in found.values()} == {fmus.path(name).read_bytes() for name in needed}


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        ("shorter", r"part 0 of \S+ has 999 bytes"),
        ("other bytes", "came with another SHA-256 than was announced"),
        ("another part", "CHUNK of tick 1 came instead of CHUNK of tick 0"),
    ],
)
def test_files_that_do_not_come_as_announced(
    harm: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if harm == "shorter":
        monkeypatch.setattr("cosim.distributed.files.CHUNK_BYTES", 1000)
    fetching = Fetching(tmp_path, monkeypatch)
    send(fetching.guest, fetching.procurement.ask())
    asked = fetching.place.hub.receive(0)
    (part,) = fetching.place.lobby._stock.chunk(asked).parts
    content = {"shorter": part[:-1], "other bytes": bytes(len(part)), "another part": part}[harm]
    fetching.place.hub.send("a", Kind.CHUNK, 1 if harm == "another part" else 0, content)
    with pytest.raises(WireError, match=said):
        fetching.procurement.take(fetching.guest.receive(0))
    assert fetching.procurement.located == {}


# --- farewells --------------------------------------------------------------------------------------------------------
def test_an_error_without_a_message_is_told_by_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.distributed.hosting._FAREWELL_SECONDS", 0.0)
    network = InMemoryNetwork("hall")
    hub = network.hub()
    guest = network.connect("a")
    with pytest.raises(MemoryError), _farewell(hub):
        raise MemoryError
    assert decode_object(guest.receive(0).expect(Kind.BYE)) == {"message": "MemoryError"}
