"""UDP packets with their time of sending, and when they arrive: run by `test_kernel_netem` in two namespaces.

    python udp_probe.py receive ADDRESS
    python udp_probe.py send ADDRESS N INTERVAL_MS BYTES

`receive` says `ready`, and once nothing has come for two seconds, writes [[number, sent, arrived], …] in nanoseconds.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time

PORT = 9
_FIRST_WITHIN, _QUIET = 30.0, 2.0  # seconds
_TIMESTAMP_NS, _RECEIVE_BUFFER_FORCE = 35, 33  # asm-generic/socket.h


def receive(address: str) -> list[list[int]]:
    """Number, time of sending and of arrival, as the kernel noted it, of every packet."""
    rows = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, _TIMESTAMP_NS, 1)
        sock.setsockopt(socket.SOL_SOCKET, _RECEIVE_BUFFER_FORCE, 1 << 24)
        sock.bind((address, PORT))
        sock.settimeout(_FIRST_WITHIN)
        print("ready", flush=True)
        try:
            while True:
                data, ancillary, _, _ = sock.recvmsg(2048, 64)
                seconds, nanoseconds = struct.unpack("qq", ancillary[0][2])
                rows.append([*struct.unpack_from("qq", data), seconds * 10**9 + nanoseconds])
                sock.settimeout(_QUIET)
        except TimeoutError:
            return rows


def send(address: str, n: int, interval_ms: float, size: int) -> None:
    """One packet after the other at even times."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        begin = time.monotonic()
        for number in range(n):
            time.sleep(max(0.0, begin + number * interval_ms / 1e3 - time.monotonic()))
            sock.sendto(struct.pack("qq", number, time.time_ns()).ljust(size, b"\0"), (address, PORT))


if __name__ == "__main__":
    if sys.argv[1] == "receive":
        print(json.dumps(receive(sys.argv[2])))
    else:
        send(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]))
