"""A barrier over Unix sockets: the least that such an exchange costs in Python.

python -m benchmarks.peers.raw --agents 10 --workers 10

Every worker writes its samples to the delaying component and waits for its mail; the delaying component reads from all,
one after the other, then writes to all. No numbering, no deadline, no recording.
"""

from __future__ import annotations

import socket
import tempfile
from contextlib import ExitStack
from pathlib import Path

from benchmarks.peers.exchange import AGE, SENDERS, WIDTH, Agents, Delayer, Shape, Spawned, Stopwatch, arguments


def read(connection: socket.socket, buffer: bytearray) -> bytes:
    """Fill a buffer."""
    view = memoryview(buffer)
    while view:
        n = connection.recv_into(view)
        if not n:
            raise ConnectionError("the other end has gone")
        view = view[n:]
    return bytes(buffer)


def worker(shape: Shape, index: int, address: str) -> None:
    """One worker."""
    agents = Agents(shape, index)
    first, end = shape.block(index)
    buffer = bytearray((end - first) * len(SENDERS) * WIDTH * 8)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(address)
        connection.sendall(bytes([index]))
        for step in range(shape.total):
            connection.sendall(agents.samples(step))
            agents.hear(step, read(connection, buffer))


def delay(shape: Shape, server: socket.socket) -> None:
    """The delaying component."""
    with ExitStack() as stack:
        connections = {}
        for _ in range(shape.workers):
            connection = stack.enter_context(server.accept()[0])
            connections[connection.recv(1)[0]] = connection
        ordered = [connections[index] for index in range(shape.workers)]
        blocks = [shape.block(index) for index in range(shape.workers)]
        buffers = [bytearray((end - first) * WIDTH * 8) for first, end in blocks]
        delayer, stopwatch = Delayer(shape, AGE), Stopwatch(shape)
        for _ in range(shape.total):
            samples = [read(connection, buffer) for connection, buffer in zip(ordered, buffers, strict=True)]
            for connection, mail in zip(ordered, delayer.exchange(samples), strict=True):
                connection.sendall(mail)
            stopwatch.step()


def main() -> None:
    """Measure."""
    shape, _ = arguments(__doc__, ["unix"])
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as server, ExitStack() as stack:
        address = str(Path(folder) / "socket")
        server.bind(address)
        server.listen(shape.workers)
        for index in range(shape.workers):
            stack.enter_context(Spawned(worker, shape, index, address))
        delay(shape, server)


if __name__ == "__main__":
    main()
