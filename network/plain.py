"""Plain keys over Zenoh, for programs that are no part of a run: publish without ever waiting, take what has come.

What the bytes mean is `network.payload`'s. Whoever reaches the session's endpoints can write to the keys that it
subscribes to: a message here is nothing but a claim.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Self

import zenoh

from network.transport import TransportError
from network.zenoh import open_session  # sets up Zenoh's threads, so it comes first

_KEPT: Final = 64
"""Messages of one key that are kept between two ticks; of more, the oldest are forgotten."""

_SETTINGS: Final[Mapping[str, object]] = {
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    "transport/link/tx/queue/size/data": 16,
}
_QOS: Final[Mapping[str, Any]] = {"congestion_control": zenoh.CongestionControl.DROP}


@dataclass(frozen=True)
class Arrival:
    """A message of somebody else's.

    Attributes:
        encoding: what Zenoh's own field says.
        size: bytes of the payload.
        payload: None if it is larger than was asked for, or if a value was deleted.
    """

    encoding: str
    size: int
    payload: bytes | None


class PlainKeys:
    """A session of its own, apart from that of the run.

    Args:
        listen: Zenoh endpoints that others connect to.
        connect: endpoints of routers.
        publish: key and Zenoh's encoding of everything that will be published.
        subscribe: keys to listen to.
        timeout: seconds to reach `connect`.

    Raises:
        TransportError: an endpoint cannot be listened to or reached.
    """

    def __init__(
        self,
        listen: Sequence[str],
        connect: Sequence[str],
        publish: Sequence[tuple[str, str]],
        subscribe: Sequence[str],
        timeout: float = 10.0,
    ) -> None:
        self.endpoints = (*listen, *connect)
        try:
            self._session = open_session({**_SETTINGS, **_way(listen, connect, timeout)})
        except zenoh.ZError as error:
            verb, where = ("reach", connect) if connect else ("listen at", listen)
            raise TransportError(f"cannot {verb} {', '.join(where)}: {_short(error)}") from error
        try:
            self._publishers = [
                self._session.declare_publisher(key, encoding=zenoh.Encoding(encoding), **_QOS)
                for key, encoding in publish
            ]
            self._subscribers: list[Any] = [
                self._session.declare_subscriber(key, zenoh.handlers.RingChannel(_KEPT)) for key in subscribe
            ]
        except BaseException:
            self.close()
            raise

    def put(self, index: int, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish on key number `index`; if the receiver's link is congested, the message is dropped."""
        self._publishers[index].put(payload, attachment=attachment)

    def arrived(self, index: int, largest: int) -> Iterator[Arrival]:
        """What has come on key number `index` since the last call, the newest last.

        Args:
            index: of the key in `subscribe`.
            largest: bytes that a payload may have.
        """
        inbox = self._subscribers[index].handler
        for _ in range(_KEPT):  # others may go on sending
            sample = inbox.try_recv()
            if sample is None:
                return
            size = len(sample.payload)
            usable = sample.kind == zenoh.SampleKind.PUT and size <= largest
            yield Arrival(str(sample.encoding), size, sample.payload.to_bytes() if usable else None)

    def close(self) -> None:
        """End the session; safe twice."""
        with suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


def _way(listen: Sequence[str], connect: Sequence[str], timeout: float) -> dict[str, object]:
    """A router where others connect, so that they hear each other as well; else a client of the user's router."""
    way: dict[str, object] = {"mode": "router" if listen else "client", "listen/endpoints": list(listen)}
    if connect:
        way |= {
            "connect/endpoints": list(connect),
            "connect/timeout_ms": int(timeout * 1e3),
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
        }
    return way


def _short(error: Exception) -> str:
    """Zenoh's reason without the places in its source."""
    return str(error).partition(" at /")[0].rstrip(".")
