"""How processes of a run talk: the endpoint that each of them holds, and one that stays in memory.

Star: one process is the hub (the orchestrator); it sees who joins and who is lost, the others see the loss of the hub
only. Messages from one sender to one receiver arrive in order, once and whole, or `receive` says what is wrong.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Final, Protocol, Self

from network.envelope import VERSION, Envelope, Kind, Part, Streams, Tamper, WireError

__all__ = [
    "HUB",
    "VERSION",
    "Endpoint",
    "Envelope",
    "Hub",
    "InMemoryNetwork",
    "Kind",
    "Part",
    "PeerLost",
    "Refused",
    "Tamper",
    "TransportError",
    "TransportTimeout",
    "WireError",
]

HUB: Final = "orchestrator"
"""Name of the process at the centre."""

SOCKET_PATH_BYTES: Final = 103 if sys.platform == "darwin" else 107
"""For which the path of a Unix socket has room (unix(7))."""


class TransportError(RuntimeError):
    """Base of what can go wrong between processes, besides `WireError`."""


class TransportTimeout(TransportError):  # noqa: N818 - it says what it is
    """A deadline passed; the message says what was waited for."""


class PeerLost(TransportError):  # noqa: N818 - it says what it is
    """A process is gone: ended, killed, or cut off.

    Attributes:
        name: of the process.
        reason: how it was noticed.
    """

    def __init__(self, name: str, reason: str) -> None:
        self.name = name
        self.reason = reason
        super().__init__(f"{name}: {reason}")


class Refused(TransportError):  # noqa: N818 - it says what it is
    """The hub does not let this process join: it speaks another version, or the name is taken (once used, for good)."""


class Endpoint(Protocol):
    """One process's end of all its streams. One thread at a time; `close` is safe twice.

    Attributes:
        name: of this process.
    """

    name: str

    def send(self, receiver: str, kind: Kind, tick: int, *parts: Part) -> None:
        """Send one message; `parts` are joined, and may be changed afterwards.

        Raises:
            PeerLost: the connection to the hub is known to be gone.
            TransportError: this is the hub, and its own end is gone.
        """

    def receive(self, timeout: float) -> Envelope:
        """The next message of anybody, after at most `timeout` seconds; 0 only looks.

        What arrived before a loss is handed out before the loss is reported. The hub is told of everybody's loss, once;
        the others of the hub's only, every time. A process that said BYE is not lost.

        Raises:
            TransportTimeout: nothing arrived.
            PeerLost: a process is gone.
            TransportError: this is the hub, and its own end is gone.
            WireError: what arrived must not be used.
        """

    def close(self) -> None:
        """Leave, after saying BYE to the hub where this is not the hub."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...


class Hub(Endpoint, Protocol):
    """The endpoint at the centre.

    Attributes:
        endpoints: where others connect to.
    """

    endpoints: tuple[str, ...]

    @property
    def peers(self) -> frozenset[str]:
        """Processes that have joined and are not lost; the hub may send to them."""

    def await_peers(
        self, names: Collection[str], timeout: float, waiting: Callable[[list[str]], None] = lambda _: None
    ) -> None:
        """Wait until all of `names` have joined.

        Args:
            names: of processes.
            timeout: seconds for all of them together.
            waiting: told of the names that are still missing, at once and whenever they change.

        Raises:
            TransportTimeout: names who is missing.
        """

    def forget(self, name: str) -> None:
        """Let the name of a process that has left, or is lost, be used again; `receive` has told of it."""


_ENDED: Final = "it ended without saying so, or the connection to it is gone"


def name_is_used(name: str, where: str = "") -> str:
    """Why a second process cannot join under a name; `where` is the first."""
    return f"the name {name} is taken: {where or 'a process of this run'} has, or had, it"


def nothing_arrived(name: str, timeout: float) -> str:
    """What a receiver says when its deadline has passed."""
    return f"{name}: nothing arrived within {timeout:g} s"


class Waiting:
    """Waiting for names, with a deadline for all of them together; the arguments are those of `Hub.await_peers`."""

    def __init__(self, names: Collection[str], timeout: float, waiting: Callable[[list[str]], None]) -> None:
        self._names = names
        self._timeout = timeout
        self._deadline = time.monotonic() + timeout
        self._waiting = waiting
        self._told: list[str] = []

    def left(self) -> float:
        """Seconds until the deadline, at least 0."""
        return max(0.0, self._deadline - time.monotonic())

    def missing(self, present: Collection[str]) -> bool:
        """Whether names are missing; tells `waiting` when they have changed.

        Raises:
            TransportTimeout: some are, and the deadline has passed.
        """
        missing = [name for name in self._names if name not in present]
        if missing and missing != self._told:
            self._waiting(missing)
        self._told = missing
        if missing and self.left() == 0:
            raise TransportTimeout(f"not there after {self._timeout:g} s: {', '.join(missing)}")
        return bool(missing)


class InMemoryNetwork:
    """A hub and its processes inside one process: every message goes through the wire format. Threads may share it.

    Args:
        run: identifies the run.
        tamper: for tests; sees every frame on its way.
    """

    def __init__(self, run: str, tamper: Tamper | None = None) -> None:
        self.run = run
        self.tamper: Tamper = tamper or (lambda _sender, _receiver, frame: [frame])
        self.changed = threading.Condition()
        self.endpoints: dict[str, InMemoryEndpoint] = {}
        self._used: set[str] = set()

    def hub(self) -> InMemoryHub:
        """Open the hub.

        Raises:
            Refused: there was one.
        """
        hub = InMemoryHub(self, HUB)
        self._admit(hub)
        return hub

    def connect(self, name: str) -> InMemoryEndpoint:
        """Join as `name`; the hub must be there.

        Raises:
            Refused: the name has been used, or there is no hub.
        """
        if HUB not in self.endpoints:
            raise Refused(f"no orchestrator of run {self.run} is there")
        endpoint = InMemoryEndpoint(self, name)
        self._admit(endpoint)
        return endpoint

    def free(self, name: str) -> None:
        """Let a name be used again."""
        self._used.discard(name)

    def _admit(self, endpoint: InMemoryEndpoint) -> None:
        with self.changed:
            if endpoint.name in self._used:
                raise Refused(name_is_used(endpoint.name))
            self._used.add(endpoint.name)
            self.endpoints[endpoint.name] = endpoint
            self.changed.notify_all()


class InMemoryEndpoint:
    """An end of an `InMemoryNetwork`; see `Endpoint`."""

    def __init__(self, network: InMemoryNetwork, name: str) -> None:
        self.name = name
        self._network = network
        self._streams = Streams(network.run, name)
        self._inbox: deque[tuple[str, Part | None]] = deque()  # sender and frame; None: the sender is gone
        self._departed: set[str] = set()

    def send(self, receiver: str, kind: Kind, tick: int, *parts: Part) -> None:
        if HUB not in self._network.endpoints:
            raise PeerLost(HUB, _ENDED)
        frame = self._streams.encode(receiver, kind, tick, parts)
        with self._network.changed:
            target = self._network.endpoints.get(receiver)
            if target is not None:
                arrived = self._network.tamper(self.name, receiver, frame)
                target._inbox.extend((self.name, frame) for frame in arrived)
            self._network.changed.notify_all()

    def receive(self, timeout: float) -> Envelope:
        deadline = time.monotonic() + timeout
        while True:
            with self._network.changed:
                if not self._network.changed.wait_for(lambda: self._inbox, deadline - time.monotonic()):
                    raise TransportTimeout(nothing_arrived(self.name, timeout))
                sender, frame = self._inbox.popleft()
                if frame is None and sender == HUB and sender not in self._departed:
                    self._inbox.append((sender, frame))
            if frame is not None:
                envelope = self._streams.decode(sender, frame)
                if envelope.kind is Kind.BYE:
                    self._departed.add(sender)
                return envelope
            if sender not in self._departed:
                raise PeerLost(sender, _ENDED)

    def close(self) -> None:
        if self.name != HUB and self._network.endpoints.get(self.name) is self:
            with suppress(PeerLost):
                self.send(HUB, Kind.BYE, 0)
        self.kill()

    def kill(self) -> None:
        """End without a word, as a killed process does."""
        with self._network.changed:
            if self._network.endpoints.pop(self.name, None) is None:
                return
            told = self._network.endpoints.values() if self.name == HUB else [self._network.endpoints.get(HUB)]
            for endpoint in told:
                if endpoint is not None:
                    endpoint._inbox.append((self.name, None))
            self._network.changed.notify_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class InMemoryHub(InMemoryEndpoint):
    """The hub of an `InMemoryNetwork`; see `Hub`."""

    endpoints: tuple[str, ...] = ()

    @property
    def peers(self) -> frozenset[str]:
        with self._network.changed:
            return frozenset(self._network.endpoints) - {HUB}

    def await_peers(
        self, names: Collection[str], timeout: float, waiting: Callable[[list[str]], None] = lambda _: None
    ) -> None:
        watch = Waiting(names, timeout, waiting)
        while watch.missing(present := self.peers):
            with self._network.changed:
                self._network.changed.wait_for(lambda: self.peers != present, watch.left())

    def forget(self, name: str) -> None:
        with self._network.changed:
            self._network.free(name)
            self._streams.forget(name)
            self._departed.discard(name)
            self._inbox = deque(item for item in self._inbox if item[0] != name)
