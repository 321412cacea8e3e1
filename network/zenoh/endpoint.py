"""What the endpoints of the hub and of the others have in common."""

from __future__ import annotations

import atexit
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Final, Self

import zenoh

from network.envelope import Envelope, Kind, Part, Streams, Tamper
from network.transport import (
    HUB,
    PeerLost,
    TransportError,
    TransportTimeout,
    nothing_arrived,
)
from network.zenoh.alarm import Alarm
from network.zenoh.keys import Keys

INBOX: Final = 2**20  # messages; if it were full, Zenoh's receiving thread would wait, and with it every other link
_QOS: Final[Mapping[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "express": True,
    "priority": zenoh.Priority.REAL_TIME,
}
_Samples = zenoh.handlers.Handler[zenoh.Sample]


class ZenohEndpoint:
    """What the hub's and the others' endpoints have in common; see `network.transport.Endpoint`."""

    def __init__(  # noqa: PLR0917
        self, session: zenoh.Session, keys: Keys, run: str, name: str, token: str, tamper: Tamper | None
    ) -> None:
        self.name = name
        self._session = session
        self._keys = keys
        self._streams = Streams(run, name)
        self._tamper = tamper
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._senders: dict[str, str] = {}
        self._losses: deque[PeerLost] = deque()
        self._departed: set[str] = set()
        self._closed = False
        self._changed = threading.Condition(threading.RLock())
        self._threads: list[threading.Thread] = []
        self._token = token
        self._own_key = keys.message(name, name)
        self._alarm = Alarm(self._wake)
        atexit.register(self.leave)  # threads that wait in Zenoh while the interpreter ends would abort the process

    def begin(self) -> None:
        """Receive from now on, then be seen: whoever sees us reaches us.

        Raises:
            TransportError: the session is gone.
        """
        with self._using_session("begin"):
            self._subscriber = self._session.declare_subscriber(
                self._keys.inbox(self.name), zenoh.handlers.FifoChannel(INBOX)
            )
            self._inbox: _Samples = self._subscriber.handler
            self._look_around()
            self._liveliness = self._session.liveliness().declare_token(self._keys.alive(self.name, self._token))

    def _look_around(self) -> None:
        """Declare what else there is to hear of."""

    @contextmanager
    def _using_session(self, what: str) -> Iterator[None]:
        """Zenoh's only error here is that the session is closed, which it is by itself where all is lost."""
        try:
            yield
        except zenoh.ZError as error:
            raise self._broken(f"cannot {what}: {error}") from error

    def _broken(self, why: str) -> TransportError:
        return TransportError(f"{self.name} {why}")

    def send(self, receiver: str, kind: Kind, tick: int, *parts: Part) -> None:
        self._check_open()
        frame = self._streams.encode(receiver, kind, tick, parts)
        try:
            publisher = self._publishers.get(receiver)
            if publisher is None:
                publisher = self._session.declare_publisher(self._keys.message(receiver, self.name), **_QOS)
                self._publishers[receiver] = publisher
            for sent in (frame,) if self._tamper is None else self._tamper(self.name, receiver, frame):
                publisher.put(sent)
        except zenoh.ZError as error:
            raise self._broken(f"cannot send to {receiver}: {error}") from error

    def receive(self, timeout: float) -> Envelope:
        self._check_open()
        try:
            return self._receive(timeout)
        except zenoh.ZError as error:
            raise self._broken(f"cannot receive: {error}") from error

    def _receive(self, timeout: float) -> Envelope:
        deadline: float | None = None
        while True:
            some_lost = bool(self._losses)  # looked at first: what arrived before a loss comes out before it
            sample = self._inbox.try_recv()
            if sample is None:
                if some_lost:
                    self._report_loss()
                    continue
                now = time.monotonic()
                if deadline is None:
                    deadline = now + timeout
                if now >= deadline:
                    raise TransportTimeout(nothing_arrived(self.name, timeout))
                self._alarm.set(deadline)
                sample = self._inbox.recv()
                self._alarm.set(math.inf)
            key = str(sample.key_expr)
            if key != self._own_key:
                sender = self._senders.get(key)
                if sender is None:
                    sender = self._senders[key] = key.rpartition("/")[2]
                return self._decode(sender, sample.payload.to_bytes())

    def _decode(self, sender: str, frame: Part) -> Envelope:
        envelope = self._streams.decode(sender, frame)
        if envelope.kind is Kind.BYE:
            self._departed.add(sender)
        return envelope

    def _report_loss(self) -> None:
        """Raise the next loss, unless that process has said BYE."""
        loss = self._losses.popleft()
        if loss.name in self._departed:
            return
        if loss.name == HUB:
            self._losses.append(loss)
        raise loss

    def _check_open(self) -> None:
        if self._closed:
            raise TransportError(f"{self.name}: the endpoint is closed")

    def _wake(self) -> None:
        """End a `recv` that takes no timeout: a message to ourselves, which never leaves the session."""
        with suppress(zenoh.ZError):  # the session is closed, which ends it as well
            self._session.put(self._own_key, b"", allowed_destination=zenoh.Locality.SESSION_LOCAL, **_QOS)

    def _lose(self, name: str, reason: str) -> None:
        self._losses.append(PeerLost(name, reason))
        self._wake()

    def _watch(self, whom: str, on_change: Callable[[str, str, bool], None]) -> None:
        """Tell `on_change` (name, token, alive) of every change, in a thread of its own."""
        subscriber = self._session.liveliness().declare_subscriber(
            self._keys.alive(whom, "*"), zenoh.handlers.FifoChannel(INBOX), history=True
        )

        def changed(sample: zenoh.Sample) -> None:
            _, name, token = str(sample.key_expr).rsplit("/", 2)
            on_change(name, token, sample.kind == zenoh.SampleKind.PUT)

        self._serve(subscriber.recv, changed)

    def _serve(self, receive: Callable[[], Any], act: Callable[[Any], None]) -> None:
        """`act` on whatever `receive` gives until the session is closed."""

        def loop() -> None:
            while True:
                try:
                    item = receive()
                except zenoh.ZError:  # the session is closed
                    return
                act(item)

        thread = threading.Thread(target=loop, name=f"{self.name} {act.__name__}", daemon=True)
        thread.start()
        self._threads.append(thread)

    def close(self) -> None:
        self.leave()

    def leave(self) -> None:
        """End without a word; safe twice."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.leave)
        self._alarm.close()
        with suppress(zenoh.ZError):  # it could not tell the others in time; it is closed all the same
            self._session.close()  # type: ignore[no-untyped-call]
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


@contextmanager
def left_if_it_fails(endpoint: ZenohEndpoint) -> Iterator[None]:
    """A session that nobody gets is closed."""
    try:
        yield
    except BaseException:
        endpoint.leave()
        raise
