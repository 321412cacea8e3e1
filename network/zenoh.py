"""Endpoints over Zenoh: the hub's, and those of the processes that connect to it. Only this file and `plain` import it.

Keys, joining and the rules behind the settings are in docs/protocol.md. Nothing of Zenoh is trusted to deliver: every
message is numbered and checked by `network.envelope`, and every wait ends.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import socket
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final, Self

# Two threads for all of Zenoh: a fifth less time per exchange than by default. Receiving has one of its own, because
# the hub's waits where it passes on more than a receiver's queue holds; were it also the one that sends, for ever.
os.environ.setdefault(  # read when the first session opens
    "ZENOH_RUNTIME",
    "(rx:(worker_threads:1),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))",
)
import zenoh

from network.codec import decode_object, encode_object
from network.envelope import Envelope, Kind, Part, Streams, Tamper, WireError, check_name
from network.transport import (
    HUB,
    PeerLost,
    Refused,
    TransportError,
    TransportTimeout,
    Waiting,
    name_is_used,
    nothing_arrived,
)

LEASE: Final = 5.0
"""Seconds without a sign of life after which a process that is stopped, or cut off, counts as lost; less than this is
not rare where many processes start on few cores."""

HUB_STALL: Final = 5.0
"""Seconds for which a process's Zenoh may take nothing before the hub closes the connection, and it counts as lost."""

STALL: Final = 60.0
"""The same for what the others send to the hub: longer, so that the one who does not take its messages is named."""

_WAIT: Final = "transport/link/tx/queue/congestion_control/block/wait_before_close"  # µs
_LEASE: Final = "transport/link/tx/lease"  # ms
_BUSY: Final = 20.0
WATCHED: Final[Mapping[str, object]] = {_LEASE: int(_BUSY * 1e3), _WAIT: int(_BUSY * 1e6)}
"""Settings of processes that somebody watches who sees them end or stop: on a busy host they may be silent for long."""

_ASK_AGAIN: Final = 0.05  # s
_TRY: Final = 1.0  # s in one attempt to reach somebody: a request to stop is heard in between
_INBOX: Final = 2**20  # messages; if it were full, Zenoh's receiving thread would wait, and with it every other link
_SETTINGS: Final[Mapping[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/shared_memory/enabled": False,
    "timestamping/enabled": False,
    _LEASE: int(LEASE * 1e3),
    _WAIT: int(STALL * 1e6),
    "transport/unicast/max_sessions": 4000,
}
_QOS: Final[Mapping[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "express": True,
    "priority": zenoh.Priority.REAL_TIME,
}
_Samples = zenoh.handlers.Handler[zenoh.Sample]


@dataclass(frozen=True)
class _Keys:
    """The keys of a run. Chunks that begin with @ are matched by no wildcard."""

    root: str

    def inbox(self, receiver: str) -> str:
        return f"{self.root}/{receiver}/*"

    def message(self, receiver: str, sender: str) -> str:
        return f"{self.root}/{receiver}/{sender}"

    def alive(self, name: str, token: str) -> str:
        return f"{self.root}/@alive/{name}/{token}"

    def join(self, name: str) -> str:
        return f"{self.root}/@join/{name}"


def _keys(run: str, namespace: str | None) -> _Keys:
    chunks = ["netcosim", check_name(run, "run")]
    if namespace is not None:
        chunks.insert(1, check_name(namespace, "namespace"))
    return _Keys("/".join(chunks))


def open_session(settings: Mapping[str, object]) -> zenoh.Session:
    """A session with these settings of Zenoh, by path, over those that all of ours have."""
    config = zenoh.Config()
    for key, value in {**_SETTINGS, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _listening(endpoints: Sequence[str]) -> dict[str, object]:
    """Settings of a session that is the router of a run."""
    return {"mode": "router", "listen/endpoints": list(endpoints), _WAIT: int(HUB_STALL * 1e6)}


def _connecting(endpoints: Sequence[str], timeout: float) -> dict[str, object]:
    """Settings of a session that connects to a router, which need not be there yet."""
    return {
        "mode": "client",
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": int(timeout * 1e3),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
    }


class _Alarm:
    """Calls `ring` when a deadline has passed, in a thread of its own.

    The thread is woken only for a deadline earlier than the one it sleeps for; setting later ones costs next to
    nothing, and it finds out when it wakes.
    """

    def __init__(self, ring: Callable[[], None]) -> None:
        self._ring = ring
        self._changed = threading.Condition()
        self._deadline = math.inf
        self._sleeps_until = math.inf
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="alarm", daemon=True)
        self._thread.start()

    def set(self, deadline: float) -> None:
        """Ring at `deadline` (of `time.monotonic`) instead of any earlier setting; infinity for never."""
        self._deadline = deadline
        if deadline < self._sleeps_until:
            with self._changed:
                self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        with self._changed:
            while not self._closed:
                self._sleeps_until = math.inf  # from here until it waits, `set` always asks for the lock
                left = self._deadline - time.monotonic()
                if left <= 0:
                    self._deadline = math.inf
                    self._ring()
                    continue
                self._sleeps_until = time.monotonic() + left
                self._changed.wait(None if left == math.inf else left)


class ZenohEndpoint:
    """What the hub's and the others' endpoints have in common; see `network.transport.Endpoint`."""

    def __init__(  # noqa: PLR0917
        self, session: zenoh.Session, keys: _Keys, run: str, name: str, token: str, tamper: Tamper | None
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
        self._alarm = _Alarm(self._wake)
        atexit.register(self.leave)  # threads that wait in Zenoh while the interpreter ends would abort the process

    def begin(self) -> None:
        """Receive from now on, then be seen: whoever sees us reaches us.

        Raises:
            TransportError: the session is gone.
        """
        with self._using_session("begin"):
            self._subscriber = self._session.declare_subscriber(
                self._keys.inbox(self.name), zenoh.handlers.FifoChannel(_INBOX)
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
            self._keys.alive(whom, "*"), zenoh.handlers.FifoChannel(_INBOX), history=True
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


@dataclass(frozen=True)
class _Member:
    """A process that was admitted: the token of its liveliness, and where it runs."""

    token: str
    where: str


class ZenohHub(ZenohEndpoint):
    """The hub's endpoint: see `network.transport.Hub`, and `open_hub`."""

    def __init__(
        self, session: zenoh.Session, keys: _Keys, run: str, endpoints: tuple[str, ...], tamper: Tamper | None
    ) -> None:
        super().__init__(session, keys, run, HUB, str(session.info.zid()), tamper)
        self.endpoints = endpoints
        self._run = run
        self._members: dict[str, _Member] = {}
        self._alive: dict[str, bool] = {}  # by token; False: it was alive

    def _look_around(self) -> None:
        self._watch("*", self._liveliness_changed)
        joining = self._session.declare_queryable(self._keys.join("*"), zenoh.handlers.FifoChannel(_INBOX))
        self._serve(joining.recv, self._answer)

    def has_another(self, timeout: float) -> bool:
        """Whether the run has a hub; before this one has begun.

        Raises:
            TransportError: the session is gone.
        """
        with self._using_session("begin"):
            return any(r.ok for r in self._session.liveliness().get(self._keys.alive(HUB, "*"), timeout=timeout))

    @property
    def peers(self) -> frozenset[str]:
        with self._changed:
            return frozenset(name for name, member in self._members.items() if self._alive.get(member.token))

    def await_peers(
        self, names: Collection[str], timeout: float, waiting: Callable[[list[str]], None] = lambda _: None
    ) -> None:
        watch = Waiting(names, timeout, waiting)
        while watch.missing(present := self.peers):
            with self._changed:
                self._changed.wait_for(lambda: self.peers != present, watch.left())

    def forget(self, name: str) -> None:
        with self._changed:
            self._members.pop(name, None)
            self._streams.forget(name)
            self._departed.discard(name)
            self._losses = deque(loss for loss in self._losses if loss.name != name)

    def _liveliness_changed(self, name: str, token: str, alive: bool) -> None:
        with self._changed:
            self._alive[token] = alive
            member = self._members.get(name)
            if member is not None and member.token == token and not alive:
                self._lose(name, f"{member.where} ended without saying so, was killed, or is cut off")
            self._changed.notify_all()

    def _answer(self, query: zenoh.Query) -> None:
        """Let a process join, or tell it why not. Whoever asks under an impossible name gets no answer."""
        name = str(query.key_expr).rpartition("/")[2]
        with query, suppress(ValueError, zenoh.ZError):  # ZError: it has gone again
            answer = Streams(self._run, HUB)
            try:
                refusal = self._admit(name, b"" if query.payload is None else query.payload.to_bytes())
            except WireError as error:
                refusal = str(error)
            kind, body = (Kind.FAILURE, encode_object({"message": refusal})) if refusal else (Kind.WELCOME, [])
            query.reply(query.key_expr, answer.encode(check_name(name, "process"), kind, 0, body))

    def _admit(self, name: str, hello: bytes) -> str | None:
        """Take a process in; why not, if not.

        Raises:
            WireError: it speaks another version, or does not belong here.
        """
        content = decode_object(Streams(self._run, HUB).decode(name, hello).expect(Kind.HELLO, 0))
        member = _Member(str(content.get("token")), str(content.get("where")))
        with self._changed:
            holder = self._members.setdefault(name, member)
            if name == HUB or holder.token != member.token:
                return name_is_used(name, "" if name == HUB else holder.where)
            self._changed.notify_all()
        return None


class ZenohClient(ZenohEndpoint):
    """The endpoint of a process that is not the hub: see `network.transport.Endpoint`, and `connect`."""

    def __init__(self, session: zenoh.Session, keys: _Keys, run: str, name: str, tamper: Tamper | None) -> None:
        super().__init__(session, keys, run, name, uuid.uuid4().hex, tamper)
        self._run = run
        self._hub_is_there = False

    def _look_around(self) -> None:
        self._watch(HUB, self._hub_changed)

    def _broken(self, why: str) -> TransportError:
        return PeerLost(HUB, f"{self.name} {why}")

    def join(self, deadline: float, waiting: Callable[[str], None]) -> None:
        """Ask the hub, as soon as it is there.

        Raises:
            TransportTimeout: it is not there at `deadline` (of `time.monotonic`), or does not answer.
            Refused: it says no.
            PeerLost: the session is gone.
        """
        with self._using_session("join"):
            self._join(deadline, waiting)

    def _join(self, deadline: float, waiting: Callable[[str], None]) -> None:
        where = f"process {os.getpid()} on {socket.gethostname()}"
        content = {"token": self._token, "where": where}
        hello = Streams(self._run, self.name).encode(HUB, Kind.HELLO, 0, encode_object(content))
        while True:
            self._await_hub(deadline, waiting)
            left = deadline - time.monotonic()
            # Asked again if a hub goes before it has answered, and another comes; to ask twice is to ask once.
            patience = max(0.01, min(left, _TRY))
            replies = self._session.get(self._keys.join(self.name), payload=hello, timeout=patience)
            for reply in replies:
                if reply.ok is not None:
                    self._welcomed(reply.ok.payload.to_bytes())
                    return
            with self._changed:
                unheard = self._hub_is_there
            if unheard:
                waiting(f"{HUB} of run {self._run} {self._unheard()}")
            time.sleep(_ASK_AGAIN)  # it has just gone, or may not hear us

    def _await_hub(self, deadline: float, waiting: Callable[[str], None]) -> None:
        while True:
            with self._changed:
                left = deadline - time.monotonic()
                there = self._changed.wait_for(lambda: self._hub_is_there, min(left, _TRY))
                if there and left > 0:
                    return
            others = f"; it {self._unheard()}" if there else self._other_runs()
            if left <= 0:
                raise TransportTimeout(
                    f"{self.name}: {HUB} of run {self._run} is not there, or does not answer{others}"
                )
            waiting(f"run {self._run} has not begun to wait for its processes{others}")

    def _other_runs(self) -> str:
        """A remark on the orchestrators that are there instead of ours.

        Raises:
            Refused: the one that we are connected to can only be that of another run.
        """
        routers = {str(router) for router in self._session.info.routers_zid()}
        runs = []
        for reply in self._session.liveliness().get(f"netcosim/**/@alive/{HUB}/*", timeout=_TRY):
            if reply.ok is None:
                continue
            *root, _, _, token = str(reply.ok.key_expr).split("/")
            if "/".join(root) == self._keys.root:
                return f"; it {self._unheard()}"
            runs.append(root[-1] + (f" (namespace {root[1]})" if len(root) > 2 else ""))
            if token in routers:
                raise Refused(f"{self.name} may not join run {self._run}: the orchestrator there plays run {runs[-1]}")
        return f"; there is run {', '.join(runs)}" if runs else ""

    def _unheard(self) -> str:
        return f"is there, but does not hear {self.name} (are name and keys those of one of the run's?)"

    def _welcomed(self, answer: bytes) -> None:
        try:
            envelope = Streams(self._run, self.name).decode(HUB, answer)
            if envelope.kind is Kind.FAILURE:
                raise Refused(f"{self.name} may not join run {self._run}: {decode_object(envelope).get('message')}")
            envelope.expect(Kind.WELCOME, 0)
        except WireError as error:
            raise Refused(f"{self.name} cannot join run {self._run}: {error}") from error

    def _hub_changed(self, _name: str, _token: str, alive: bool) -> None:
        with self._changed:
            if not alive and self._hub_is_there:
                self._lose(HUB, "it ended without saying so, was killed, or the connection to it is gone")
            self._hub_is_there = alive
            self._changed.notify_all()

    def send(self, receiver: str, kind: Kind, tick: int, *parts: Part) -> None:
        if self._losses:
            raise self._losses[0]
        super().send(receiver, kind, tick, *parts)

    def close(self) -> None:
        if not self._closed and not self._losses:
            with suppress(PeerLost):
                self.send(HUB, Kind.BYE, 0)
        self.leave()


def open_hub(
    run: str,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    namespace: str | None = None,
    settings: Mapping[str, object] | None = None,
    timeout: float = 10.0,
    tamper: Tamper | None = None,
) -> ZenohHub:
    """Open the centre of a run.

    Args:
        run: identifies the run.
        listen: Zenoh endpoints, such as `tcp/127.0.0.1:7447`.
        connect: endpoints of a router, instead.
        namespace: keeps runs on one router apart.
        settings: of Zenoh, by path (`transport/link/tls/…`), added to ours.
        timeout: seconds to reach `connect`.
        tamper: for tests.

    Raises:
        TransportError: an endpoint cannot be listened to or reached.
        Refused: the run has an orchestrator.
    """
    keys = _keys(run, namespace)
    own = _connecting(connect, timeout) if connect else _listening(listen)
    try:
        session = open_session({**own, **(settings or {})})
    except zenoh.ZError as error:
        verb, where = ("reach", connect) if connect else ("listen at", listen)
        raise TransportError(f"{HUB}: cannot {verb} {', '.join(where)}: {error}") from error
    hub = ZenohHub(session, keys, run, tuple(connect or listen), tamper)
    with _left_if_it_fails(hub):
        if connect and hub.has_another(timeout):
            raise Refused(f"run {run} has an orchestrator already")
        hub.begin()
    return hub


def connect(
    run: str,
    name: str,
    endpoints: Sequence[str],
    *,
    namespace: str | None = None,
    settings: Mapping[str, object] | None = None,
    timeout: float = 10.0,
    waiting: Callable[[str], None] = lambda _: None,
    listen: bool = False,
    tamper: Tamper | None = None,
) -> ZenohClient:
    """Join a run as `name`; the hub need not be there yet.

    Args:
        run: identifies the run.
        name: of this process; no other of the run has, or had, it.
        endpoints: `Hub.endpoints`, or those of the user's router.
        namespace: as in `open_hub`.
        settings: as in `open_hub`.
        timeout: seconds for all of it.
        waiting: told what for, again and again.
        listen: be the router at `endpoints`, to which the hub and all others connect.
        tamper: for tests.

    Raises:
        TransportTimeout: no orchestrator of that run was found.
        Refused: it says why this process may not join.
        PeerLost: the connection is gone.
    """
    deadline = time.monotonic() + timeout
    keys = _keys(run, namespace)
    check_name(name, "process")
    if listen:
        session = _listen(name, endpoints, settings or {})
    else:
        session = _reach(name, endpoints, settings or {}, deadline, waiting)
    endpoint = ZenohClient(session, keys, run, name, tamper)
    with _left_if_it_fails(endpoint):
        endpoint.begin()
        endpoint.join(deadline, waiting)
    return endpoint


@contextmanager
def _left_if_it_fails(endpoint: ZenohEndpoint) -> Iterator[None]:
    """A session that nobody gets is closed."""
    try:
        yield
    except BaseException:
        endpoint.leave()
        raise


def _listen(name: str, endpoints: Sequence[str], settings: Mapping[str, object]) -> zenoh.Session:
    """A session that is the router; see `connect`."""
    try:
        return open_session({**_listening(endpoints), **settings})
    except zenoh.ZError as error:
        raise Refused(f"{name}: cannot listen at {', '.join(endpoints)}: {error}") from error


def _reach(
    name: str,
    endpoints: Sequence[str],
    settings: Mapping[str, object],
    deadline: float,
    waiting: Callable[[str], None],
) -> zenoh.Session:
    """A session that is connected; see `connect`."""
    while True:
        left = max(0.01, deadline - time.monotonic())
        try:
            return open_session({**_connecting(endpoints, min(left, _TRY)), **settings})
        except zenoh.ZError as error:
            what = f"nobody answers at {', '.join(endpoints)}"
            if time.monotonic() >= deadline:
                raise TransportTimeout(f"{name}: {what}: {error}") from error
            waiting(what)
