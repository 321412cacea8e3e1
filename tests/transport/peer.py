"""A process of its own for the tests: `python -m tests.transport.peer RUN NAME ENDPOINT ROLE`."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from network.transport import HUB, Endpoint, Kind, PeerLost, Refused, TransportTimeout
from network.zenoh import connect

ROOT = Path(__file__).parents[2]
PATIENCE = 30.0  # seconds; only ever used up by a test that fails


def flood(number: int) -> bytes:
    """Message of a flood: 64 bytes to 1 MB, and different every time."""
    seed = hashlib.sha256(number.to_bytes(4, "little")).digest()
    size = 2**20 if number % 200 == 199 else 64 << (number % 8)
    return (seed * (size // len(seed) + 1))[:size]


def echo(endpoint: Endpoint) -> None:
    """Send everything back until DONE comes."""
    while (message := endpoint.receive(PATIENCE)).kind is not Kind.DONE:
        endpoint.send(message.sender, message.kind, message.tick, message.body)


def talk(endpoint: Endpoint) -> None:
    """One message, then wait to be killed."""
    endpoint.send(HUB, Kind.READY, 0, b"last words")
    endpoint.receive(PATIENCE)


def pour(endpoint: Endpoint) -> None:
    """Two thousand messages at once, then leave in good order."""
    for number in range(2000):
        endpoint.send(HUB, Kind.ROWS, number, flood(number))


def swap(endpoint: Endpoint) -> None:
    """When told to, exchange a flood with the other of two workers, both sending before they receive."""
    other = {"worker-1": "worker-2", "worker-2": "worker-1"}[endpoint.name]
    endpoint.receive(PATIENCE).expect(Kind.GRANT)
    for begin in range(0, 600, 10):
        for number in range(begin, begin + 10):
            endpoint.send(other, Kind.MAIL, number, flood(number))
        for number in range(begin, begin + 10):
            assert endpoint.receive(PATIENCE).expect(Kind.MAIL, number).body == flood(number)
    print("whole", flush=True)


def outlive(endpoint: Endpoint) -> None:
    """Say how the loss of the hub looks from here."""
    endpoint.send(HUB, Kind.READY, 0)
    with suppress(PeerLost):
        endpoint.receive(PATIENCE)
    try:
        endpoint.send(HUB, Kind.READY, 1)
    except PeerLost as lost:
        print(f"lost {lost.name}", flush=True)


def forget(endpoint: Endpoint) -> None:
    """Leave the interpreter without closing."""
    endpoint.send(HUB, Kind.READY, 0)
    endpoint.receive(PATIENCE)


ROLES: dict[str, Callable[[Endpoint], None]] = {r.__name__: r for r in (echo, talk, pour, swap, outlive, forget)}


def main(run: str, name: str, where: str, role: str) -> None:
    try:
        endpoint = connect(run, name, [where], timeout=PATIENCE)
    except (Refused, TransportTimeout) as error:
        print(error, flush=True)
        return
    print("joined", flush=True)
    if role == "forget":
        forget(endpoint)
        sys.exit(7)
    with endpoint:
        ROLES[role](endpoint)


class Peer:
    """A peer that runs."""

    def __init__(self, run: str, name: str, where: str, role: str) -> None:
        command = [sys.executable, "-m", "tests.transport.peer", run, name, where, role]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self._output: IO[str] = self.process.stdout

    def line(self) -> str:
        """The next line that it prints; empty at its end."""
        return self._output.readline().strip()

    def signal(self, number: signal.Signals) -> None:
        os.kill(self.process.pid, number)

    def end(self) -> int:
        """Wait for its end; its exit code."""
        code = self.process.wait(PATIENCE)
        self._output.close()
        return code


@contextmanager
def peer(run: str, name: str, where: str, role: str) -> Iterator[Peer]:
    """Start a peer; none is left behind."""
    started = Peer(run, name, where, role)
    try:
        yield started
    finally:
        if started.process.poll() is None:
            started.process.kill()
        started.end()


if __name__ == "__main__":
    main(*sys.argv[1:])
