"""Who may listen, join and say what: the settings of Zenoh for TLS with mutual authentication and access control. Pure.

The settings go to `network.zenoh.open_hub` and `connect`. What a process may do is what docs/protocol.md says of its
name, and its name is what its certificate says; `<name>.<number>`, which replaces it, has the same certificate.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from network.envelope import check_name
from network.keyfiles import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    Certificate,
    KeysError,
    certificate_name,
    check,
    read_certificates,
)
from network.transport import HUB, SOCKET_PATH_BYTES

TLS, TCP, UNIX = "tls", "tcp", "unixsock-stream"
_ANY: Final = "*"  # a chunk of a key


# --- settings -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Members:
    """Who takes part.

    Attributes:
        names: of all processes other than the hub.
        centre: those of them that write to everybody (the emulator); the others write to these and the hub.
        run: as in `open_hub`; `*` for all.
        namespace: as in `open_hub`.
    """

    names: Sequence[str]
    centre: Sequence[str]
    run: str = _ANY
    namespace: str | None = None


def listening(keys: Path, endpoints: Sequence[str], members: Members) -> dict[str, object]:
    """Settings of a hub that listens itself.

    Args:
        keys: its folder of key files.
        endpoints: at which it listens. Whoever reaches one that is a Unix socket may do everything: keep it in a folder
            that only one user can enter.
        members: who may join.

    Raises:
        KeysError: one name's certificate would do for another name.
    """
    protocols = sorted({Endpoint.of(endpoint).protocol for endpoint in endpoints})
    return {
        "transport/link/protocols": protocols,
        **_tls(keys, "listen"),
        "access_control": _control(members, local=UNIX in protocols),
    }


def connecting(keys: Path) -> dict[str, object]:
    """Settings of a process that connects: to the hub, or as the hub to a router of the user's."""
    return {"transport/link/protocols": [TLS], **_tls(keys, "connect")}


def router(keys: Path, endpoints: Sequence[str], members: Members) -> dict[str, object]:
    """The configuration of a router of the user's, for `zenohd --config`.

    Args:
        keys: the router's own folder of key files.
        endpoints: at which it is to listen.
        members: who may join.

    Raises:
        KeysError: one name's certificate would do for another name.
    """
    tls = {path.rpartition("/")[2]: value for path, value in _tls(keys, "listen").items()}
    return {
        "mode": "router",
        "listen": {"endpoints": list(endpoints)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"protocols": [TLS], "tls": tls}},
        "access_control": _control(members, hub=True),
    }


def _tls(keys: Path, side: str) -> dict[str, object]:
    own = keys.resolve()
    return {
        "transport/link/tls/root_ca_certificate": str(own / AUTHORITY),
        f"transport/link/tls/{side}_private_key": str(own / KEY),
        f"transport/link/tls/{side}_certificate": str(own / CERTIFICATE),
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/verify_name_on_connect": True,
        "transport/link/tls/close_link_on_expiration": True,
    }


# --- access control -----------------------------------------------------------------------------------------------
def _control(members: Members, *, local: bool = False, hub: bool = False) -> dict[str, object]:
    """What is allowed to those who connect, and nothing else."""
    chunks = ["netcosim", members.run if members.run == _ANY else check_name(members.run, "run")]
    if members.namespace is not None:
        chunks.insert(1, check_name(members.namespace, "namespace"))
    root = "/".join(chunks)
    certificates = list(dict.fromkeys(certificate_name(check_name(name, "process")) for name in members.names))
    _refuse_ambiguous([*certificates, HUB])
    centre = [key for name in (HUB, *members.centre) for key in _with_replacements(name)]
    tree = _Tree()
    for name in certificates:
        tree.add(name, _rights(root, name, [_ANY] if name in members.centre else centre))
    if hub:
        tree.add(HUB, _rights_of_hub(root))
    if local:
        tree.trust(UNIX)
    return tree.tree


_Rights = Sequence[tuple[str, Sequence[str], Sequence[str]]]  # flow as the router sees it, messages, keys
_IN, _OUT = "ingress", "egress"
_TOKENS = ("declare_liveliness_subscriber", "liveliness_query")


def _rights(root: str, name: str, receivers: Sequence[str]) -> _Rights:
    selves = _with_replacements(name)
    return [
        (_IN, ["put"], [f"{root}/{receiver}/{self}" for receiver in receivers for self in selves]),
        (_IN, ["declare_subscriber"], [f"{root}/{self}/*" for self in selves]),
        (_IN, ["liveliness_token"], [f"{root}/@alive/{self}/*" for self in selves]),
        (_IN, _TOKENS, [f"{root}/@alive/{HUB}/*"]),
        (_IN, ["query"], [f"{root}/@join/{self}" for self in selves]),
        (_OUT, ["put"], [f"{root}/{self}/*" for self in selves]),
        (_OUT, ["declare_subscriber"], [f"{root}/{receiver}/*" for receiver in receivers]),
        (_OUT, ["liveliness_token"], [f"{root}/@alive/{HUB}/*"]),
        (_OUT, _TOKENS, [f"{root}/@alive/{self}/*" for self in selves]),
        (_OUT, ["declare_queryable"], [f"{root}/@join/*"]),
        (_OUT, ["reply"], [f"{root}/@join/{self}" for self in selves]),
    ]


def _rights_of_hub(root: str) -> _Rights:
    return [
        (_IN, ["put"], [f"{root}/*/{HUB}"]),
        (_IN, ["declare_subscriber"], [f"{root}/{HUB}/*"]),
        (_IN, ["liveliness_token"], [f"{root}/@alive/{HUB}/*"]),
        (_IN, _TOKENS, [f"{root}/@alive/*/*"]),
        (_IN, ["declare_queryable", "reply"], [f"{root}/@join/*"]),
        (_OUT, ["put"], [f"{root}/{HUB}/*"]),
        (_OUT, ["declare_subscriber"], [f"{root}/*/*"]),
        (_OUT, ["liveliness_token"], [f"{root}/@alive/*/*"]),
        (_OUT, _TOKENS, [f"{root}/@alive/{HUB}/*"]),
        (_OUT, ["query"], [f"{root}/@join/*"]),
    ]


def _with_replacements(name: str) -> list[str]:
    return [name] if name == HUB else [name, f"{name}.$*"]


def _refuse_ambiguous(certificates: Sequence[str]) -> None:
    """`lab.*` is what replaces `lab`, so that nothing else may be called so."""
    for name in certificates:
        for other in certificates:
            if other.startswith(f"{name}."):
                raise KeysError(f"process {other!r}: the certificate of {name!r} would do for it; rename one of them")


class _Tree:
    """Zenoh's `access_control`, as it grows."""

    def __init__(self) -> None:
        self._rules: list[object] = []
        self._subjects: list[object] = []
        self._policies: list[object] = []
        self.tree: dict[str, object] = {
            "enabled": True,
            "default_permission": "deny",
            "rules": self._rules,
            "subjects": self._subjects,
            "policies": self._policies,
        }

    def add(self, name: str, rights: _Rights) -> None:
        """Let whoever has the certificate of that name do this."""
        self._policy(f"certificate {name}", {"cert_common_names": [name]}, rights)

    def trust(self, protocol: str) -> None:
        """Let whoever comes that way do everything."""
        every = [
            "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
            "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
        ]  # fmt: skip
        keys = ["netcosim/**", "netcosim/**/@alive/**", "netcosim/**/@join/**"]
        rights = [(flow, every, keys) for flow in (_IN, _OUT)]
        self._policy(f"protocol {protocol}", {"link_protocols": [protocol]}, rights)

    def _policy(self, who: str, subject: Mapping[str, object], rights: _Rights) -> None:
        rules = []
        for number, (flow, messages, keys) in enumerate(rights):
            rules.append(f"{who}: {number}")
            self._rules.append(
                {
                    "id": rules[-1],
                    "permission": "allow",
                    "flows": [flow],
                    "messages": list(messages),
                    "key_exprs": list(keys),
                }
            )
        self._subjects.append({"id": who, **subject})
        self._policies.append({"rules": rules, "subjects": [who]})


# --- endpoints ----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Endpoint:
    """A Zenoh endpoint in its parts, `protocol/address?metadata#config`.

    Attributes:
        host: without brackets; empty where there is none.
        config: what is said of this endpoint alone, which would override the settings.
    """

    text: str
    protocol: str
    host: str
    port: str
    config: str

    @classmethod
    def of(cls, text: str) -> Endpoint:
        """Take it apart."""
        protocol, _, rest = text.partition("/")
        address, _, config = rest.partition("#")
        if protocol == UNIX:
            return cls(text, protocol, "", "", config)
        host, _, port = address.partition("?")[0].rpartition(":")
        return cls(text, protocol, host.removeprefix("[").removesuffix("]"), port, config)

    @property
    def stays_here(self) -> bool:
        """Whether nobody beyond this host can reach it."""
        if self.protocol == UNIX:
            return True
        address = self._address
        return self.host == "localhost" if address is None else address.is_loopback

    @property
    def is_everywhere(self) -> bool:
        """Whether it stands for all addresses of the host."""
        address = self._address
        return address is not None and address.is_unspecified

    @property
    def _address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
        try:
            return ipaddress.ip_address(self.host.partition("%")[0])
        except ValueError:
            return None


def name_in(keys: Path) -> str | None:
    """The name of the process that a folder of key files is for; None if it cannot be told."""
    try:
        return Certificate.of(read_certificates(keys / CERTIFICATE)[0]).name
    except KeysError:
        return None


def check_listen(endpoints: Sequence[str], keys: Path | None, insecure: bool, name: str = HUB) -> list[KeysError]:
    """Everything that speaks against listening there.

    Args:
        endpoints: of Zenoh.
        keys: folder of key files, if there is one.
        insecure: the user says that everybody may come.
        name: of the process that listens.
    """
    faults = [fault for endpoint in endpoints for fault in _faults(Endpoint.of(endpoint), keys, insecure, "listen")]
    if keys is None or all(Endpoint.of(endpoint).protocol == UNIX for endpoint in endpoints):
        return faults
    own = check(keys, name, listens=True)
    faults += own
    if not own:
        faults += _host_faults(endpoints, keys / CERTIFICATE)
    return faults


def check_connect(endpoints: Sequence[str], keys: Path | None, insecure: bool, name: str) -> list[KeysError]:
    """Everything that speaks against connecting there.

    Args:
        endpoints: of Zenoh.
        keys: folder of key files, if there is one.
        insecure: the user says that everybody may listen.
        name: of the process that connects.
    """
    faults = [fault for endpoint in endpoints for fault in _faults(Endpoint.of(endpoint), keys, insecure, "connect")]
    if keys is None or all(Endpoint.of(endpoint).protocol == UNIX for endpoint in endpoints):
        return faults
    return faults + check(keys, name, listens=False)


def _faults(endpoint: Endpoint, keys: Path | None, insecure: bool, does: str) -> list[KeysError]:
    """What an endpoint says that must not be."""
    text = endpoint.text
    if endpoint.protocol == UNIX:
        n_bytes = len(os.fsencode(text.partition("/")[2]))
        room = f"the path of a socket has room for {SOCKET_PATH_BYTES} bytes, this one takes {n_bytes}"
        return [KeysError(f"{text}: {room}; write a shorter one")] if n_bytes > SOCKET_PATH_BYTES else []
    if endpoint.protocol not in (TLS, TCP):
        return [KeysError(f"{text}: write tls/HOST:PORT (or {UNIX}/PATH, or tcp/127.0.0.1:PORT on one host)")]
    if not endpoint.host or not endpoint.port.isascii() or not endpoint.port.isdigit() or int(endpoint.port) > 65535:
        return [KeysError(f"{text}: write {endpoint.protocol}/HOST:PORT, such as {endpoint.protocol}/192.0.2.7:7447")]
    faults = []
    if keys is None and endpoint.protocol == TLS:
        faults.append(KeysError(f"{text}: TLS needs keys: --keys FOLDER; to make them: cosim keys init"))
    elif keys is not None and endpoint.protocol == TCP:
        faults.append(KeysError(f"{text}: would not use the keys in {keys}; write tls{text.removeprefix(TCP)}"))
    elif endpoint.protocol == TCP and not endpoint.stays_here and not insecure:
        who = (
            "anybody who reaches this host could listen and join" if does == "listen" else "anybody could answer there"
        )
        faults.append(
            KeysError(
                f"{text}: without keys {who}; make some with cosim keys init, give them with --keys FOLDER and write"
                f" tls{text.removeprefix(TCP)}; or add --insecure where nobody else is on the network"
            )
        )
    if keys is not None and endpoint.config:
        faults.append(KeysError(f"{text}: leave out what follows the #; it could switch TLS off"))
    return faults


def _host_faults(endpoints: Sequence[str], path: Path) -> list[KeysError]:
    """Hosts to listen at by which those who connect would not accept the certificate."""
    certificate = Certificate.of(read_certificates(path)[0])
    faults = []
    for endpoint in map(Endpoint.of, endpoints):
        if endpoint.protocol != TLS or not endpoint.host or endpoint.is_everywhere or certificate.is_for(endpoint.host):
            continue
        what = (
            f"is for {', '.join(certificate.hosts)}, not for {endpoint.host}; to listen at all addresses, write"
            f" tls/0.0.0.0:{endpoint.port}, else issue one with --host {endpoint.host}"
        )
        faults.append(KeysError(what, path))
    return faults
