"""Where the processes of a run meet, as the command line says: checked before anything is opened."""

from __future__ import annotations

import argparse
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.errors import ClusterError, ConfigError, CosimError, Problem
from network import access
from network.envelope import check_name
from network.transport import HUB, Endpoint, Hub, Refused, TransportError, TransportTimeout

DEFAULT_RUN = "run"
_REACH_SECONDS = 10.0


@dataclass(frozen=True)
class Place:
    """Where a run's processes meet.

    Attributes:
        endpoints: of Zenoh.
        listens: whether this process is the one that listens there.
        run: name of the run, for those who share a router.
        namespace: keeps apart those who share a router.
        keys: folder of key files, if there is one.
        insecure: the user says that it may do without keys.
    """

    endpoints: tuple[str, ...]
    listens: bool
    run: str
    namespace: str | None
    keys: Path | None
    insecure: bool

    @classmethod
    def of(cls, args: argparse.Namespace, name: str = HUB) -> Place:
        """As the command line of the process of that name has it.

        Raises:
            ConfigError: everything that is wrong with it.
        """
        listen = getattr(args, "listen", None)
        place = cls((listen or args.connect,), listen is not None, args.run, args.namespace, args.keys, args.insecure)
        problems = [Problem(fault) for fault in place._faults(name)]
        if problems:
            raise ConfigError(problems)
        return place

    def _faults(self, name: str) -> list[str]:
        check = access.check_listen if self.listens else access.check_connect
        faults = [str(fault) for fault in check(self.endpoints, self.keys, self.insecure, name)]
        for text, what in ((self.run, "run"), (self.namespace, "namespace"), (name, "process")):
            try:
                check_name(text or "x", what)
            except ValueError as error:
                faults.append(str(error))
        return faults or [fault for text in self.endpoints if (fault := _unknown_host(text))]

    # --- the hub ----------------------------------------------------------------------------------------------------
    def open_hub(self, names: Sequence[str]) -> Hub:
        """Open the centre; `names` are those of the processes that come, as far as they are known.

        Raises:
            CosimError: the endpoint cannot be used, or the run has an orchestrator.
        """
        from network.zenoh import open_hub

        try:
            return open_hub(
                self.run,
                listen=self.endpoints if self.listens else (),
                connect=() if self.listens else self.endpoints,
                namespace=self.namespace,
                settings=self._settings(names),
                timeout=_REACH_SECONDS,
            )
        except Refused as error:
            raise CosimError(f"{error}; choose another name with --run") from error
        except TransportError as error:
            raise CosimError(_in_use(str(error))) from error

    def for_others(self) -> str:
        """The endpoint that the others connect to."""
        address = access.Endpoint.of(self.endpoints[0])
        if not address.is_everywhere:
            return self.endpoints[0]
        return f"{address.protocol}/{socket.gethostname()}:{address.port}"

    def options(self, name: str) -> list[str]:
        """What the process of that name has to add."""
        words = [] if self.run == DEFAULT_RUN else ["--run", self.run]
        words += ["--namespace", self.namespace] if self.namespace else []
        words += ["--keys", str(self.keys.parent / name)] if self.keys else []
        return words + (["--insecure"] if self.insecure else [])

    # --- the others -------------------------------------------------------------------------------------------------
    def join(self, name: str, seconds: float, tell: Callable[[str], object]) -> Endpoint:
        """Join the run as `name`, as soon as its orchestrator is there.

        Raises:
            CosimError: it says no.
            ClusterError: it is not there in time.
        """
        from network.zenoh import connect

        told: list[str] = []

        def waiting(what: str) -> None:
            if told[-1:] != [what]:
                told.append(what)
                tell(f"{what}; waiting for it")

        settings = self._settings([name])
        try:
            return connect(
                self.run,
                name,
                self.endpoints,
                namespace=self.namespace,
                settings=settings,
                timeout=seconds,
                waiting=waiting,
            )
        except Refused as error:
            raise CosimError(str(error)) from error
        except TransportTimeout as error:
            raise ClusterError(f"{error} (after {seconds:g} s)") from error
        except TransportError as error:
            raise ClusterError(str(error)) from error

    def _settings(self, names: Sequence[str]) -> dict[str, object]:
        if self.keys is None:
            return {}
        if not self.listens:
            return access.connecting(self.keys)
        members = access.Members(names, ["emulator"], self.run, self.namespace)
        return access.listening(self.keys, self.endpoints, members)


def _unknown_host(text: str) -> str | None:
    """Why nobody can be found at an endpoint."""
    host = access.Endpoint.of(text).host
    if not host:
        return None
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        return f"{text}: the host {host!r} is unknown: {error}"
    return None


def _in_use(said: str) -> str:
    """What Zenoh says, in short where it is the usual thing."""
    if "in use" in said or "AddrInUse" in said:
        return f"{said.split(': ')[1]}: another program listens there already; stop it or choose another port"
    return said
