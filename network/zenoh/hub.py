"""The endpoint of the hub, through which all messages of a run pass."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import zenoh

from network.codec import decode_object, encode_object
from network.envelope import Kind, Streams, Tamper, WireError, check_name
from network.transport import (
    HUB,
    Refused,
    TransportError,
    Waiting,
    name_is_used,
)
from network.zenoh.endpoint import INBOX, ZenohEndpoint, left_if_it_fails
from network.zenoh.keys import Keys, keys_of
from network.zenoh.session import connecting, listening, open_session


@dataclass(frozen=True)
class _Member:
    """A process that was admitted: the token of its liveliness, and where it runs."""

    token: str
    where: str


class ZenohHub(ZenohEndpoint):
    """The hub's endpoint: see `network.transport.Hub`, and `open_hub`."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, run: str, endpoints: tuple[str, ...], tamper: Tamper | None
    ) -> None:
        super().__init__(session, keys, run, HUB, str(session.info.zid()), tamper)
        self.endpoints = endpoints
        self._run = run
        self._members: dict[str, _Member] = {}
        self._alive: dict[str, bool] = {}  # by token; False: it was alive

    def _look_around(self) -> None:
        self._watch("*", self._liveliness_changed)
        joining = self._session.declare_queryable(self._keys.join("*"), zenoh.handlers.FifoChannel(INBOX))
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
    keys = keys_of(run, namespace)
    own = connecting(connect, timeout) if connect else listening(listen)
    try:
        session = open_session({**own, **(settings or {})})
    except zenoh.ZError as error:
        verb, where = ("reach", connect) if connect else ("listen at", listen)
        raise TransportError(f"{HUB}: cannot {verb} {', '.join(where)}: {error}") from error
    hub = ZenohHub(session, keys, run, tuple(connect or listen), tamper)
    with left_if_it_fails(hub):
        if connect and hub.has_another(timeout):
            raise Refused(f"run {run} has an orchestrator already")
        hub.begin()
    return hub
