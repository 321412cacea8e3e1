"""The endpoints of the processes that connect to the hub."""

from __future__ import annotations

import os
import socket
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Final

import zenoh

from network.codec import decode_object, encode_object
from network.envelope import Kind, Part, Streams, Tamper, WireError, check_name
from network.transport import (
    HUB,
    PeerLost,
    Refused,
    TransportError,
    TransportTimeout,
)
from network.zenoh.endpoint import ZenohEndpoint, left_if_it_fails
from network.zenoh.keys import Keys, keys_of
from network.zenoh.session import connecting, listening, open_session

_ASK_AGAIN: Final = 0.05  # s
_TRY: Final = 1.0  # s in one attempt to reach somebody: a request to stop is heard in between


class ZenohClient(ZenohEndpoint):
    """The endpoint of a process that is not the hub: see `network.transport.Endpoint`, and `connect`."""

    def __init__(self, session: zenoh.Session, keys: Keys, run: str, name: str, tamper: Tamper | None) -> None:
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
    keys = keys_of(run, namespace)
    check_name(name, "process")
    if listen:
        session = _listen(name, endpoints, settings or {})
    else:
        session = _reach(name, endpoints, settings or {}, deadline, waiting)
    endpoint = ZenohClient(session, keys, run, name, tamper)
    with left_if_it_fails(endpoint):
        endpoint.begin()
        endpoint.join(deadline, waiting)
    return endpoint


def _listen(name: str, endpoints: Sequence[str], settings: Mapping[str, object]) -> zenoh.Session:
    """A session that is the router; see `connect`."""
    try:
        return open_session({**listening(endpoints), **settings})
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
            return open_session({**connecting(endpoints, min(left, _TRY)), **settings})
        except zenoh.ZError as error:
            what = f"nobody answers at {', '.join(endpoints)}"
            if time.monotonic() >= deadline:
                raise TransportTimeout(f"{name}: {what}: {error}") from error
            waiting(what)
