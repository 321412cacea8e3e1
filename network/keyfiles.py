"""What a process proves with who it is: a folder with `ca.pem`, `cert.pem` and `key.pem`, read and checked.

Zenoh refuses a connection that is not in order without a word to anybody, so all that can be found out is found out
before. The package `cryptography` is imported only here and in `network.authority`, and only when something is read.
"""

from __future__ import annotations

import ipaddress
import os
import re
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.types import CertificateIssuerPrivateKeyTypes

AUTHORITY: Final = "ca.pem"
"""The authority's certificate, in its own folder and in that of every process."""
CERTIFICATE: Final = "cert.pem"
KEY: Final = "key.pem"
AUTHORITY_KEY: Final = "ca.key.pem"
"""In the folder of the authority only: whoever has it can issue certificates."""

_T = TypeVar("_T")
_REPLACEMENT = re.compile(r"(.+)\.[0-9]+")


class KeysError(Exception):
    """Something about keys that the user can mend.

    Attributes:
        what: is wrong, and what to do.
        file: that it is about, if any.
    """

    def __init__(self, what: str, file: Path | None = None) -> None:
        self.what = what
        self.file = file
        super().__init__(what if file is None else f"{file}: {what}")


def need_cryptography() -> None:
    """Say what is missing, if it is.

    Raises:
        KeysError: the package is not installed.
    """
    try:
        import cryptography  # noqa: F401
    except ImportError:
        raise KeysError("keys need the package cryptography: pip install 'netcosim[tls]'") from None


def certificate_name(process: str) -> str:
    """The name in the certificate of a process: its own, or that of what it replaces (`worker-1.2` is `worker-1`)."""
    replacement = _REPLACEMENT.fullmatch(process)
    return certificate_name(replacement[1]) if replacement else process


@dataclass(frozen=True)
class Certificate:
    """What a certificate says.

    Attributes:
        name: its common name.
        hosts: at which its process can be found: names and addresses.
        begins: when it becomes valid.
        ends: when it expires.
        connects, listens: what it may be used for.
    """

    name: str
    hosts: tuple[str, ...]
    begins: datetime
    ends: datetime
    connects: bool
    listens: bool

    @classmethod
    def of(cls, certificate: x509.Certificate) -> Certificate:
        """What is in a certificate."""
        from cryptography import x509
        from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

        extensions = certificate.extensions
        try:
            alternatives = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            names = alternatives.get_values_for_type(x509.DNSName)
            hosts = (*names, *map(str, alternatives.get_values_for_type(x509.IPAddress)))
        except x509.ExtensionNotFound:
            hosts = ()
        try:
            purposes = set(extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        except x509.ExtensionNotFound:  # good for all
            purposes = {ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH}
        names = [str(name.value) for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
        return cls(
            name=names[0] if names else "",
            hosts=hosts,
            begins=certificate.not_valid_before_utc,
            ends=certificate.not_valid_after_utc,
            connects=ExtendedKeyUsageOID.CLIENT_AUTH in purposes,
            listens=ExtendedKeyUsageOID.SERVER_AUTH in purposes and bool(hosts),
        )

    def is_for(self, host: str) -> bool:
        """Whether those who connect to that host are content with it."""
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            name = host.lower().rstrip(".")
            wildcard = "*." + name.partition(".")[2]
            return name in map(str.lower, self.hosts) or wildcard in map(str.lower, self.hosts)
        return str(address) in self.hosts


def read_certificates(path: Path) -> list[x509.Certificate]:
    """The certificates in a file, at least one.

    Raises:
        KeysError: it cannot be read, or there is none.
    """
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificates(_read(path))
    except ValueError as error:
        raise KeysError(f"is no certificate in PEM: {_first_line(error)}", path) from None


def read_key(path: Path) -> CertificateIssuerPrivateKeyTypes:
    """The private key in a file.

    Raises:
        KeysError: it cannot be read, or there is none.
    """
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric import ec, rsa
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key(_read(path), None)
    except TypeError:
        raise KeysError("is encrypted; Zenoh takes a key without a password only", path) from None
    except (ValueError, UnsupportedAlgorithm) as error:
        raise KeysError(f"is no private key in PEM: {_first_line(error)}", path) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey):
        raise KeysError("is neither an elliptic curve key nor an RSA key", path)
    return key


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise KeysError(f"cannot be read: {error.strerror or error}", path) from None


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def check(folder: Path, name: str, *, listens: bool, now: datetime | None = None) -> list[KeysError]:
    """Everything that is wrong with the key files of a process.

    Args:
        folder: that holds them.
        name: of the process.
        listens: whether others connect to it; else it connects to another.
        now: instead of the clock's time.
    """
    try:
        need_cryptography()
    except KeysError as error:
        return [error]
    if not folder.is_dir():
        return [KeysError(f"there is no such folder; to get one: cosim keys issue {certificate_name(name)}", folder)]
    if (folder / AUTHORITY_KEY).exists():
        known = certificate_name(name)
        return [KeysError(f"is the authority's folder; the keys of {name} are in {folder / known}", folder)]
    faults: list[KeysError] = []
    authorities = _attempt(faults, read_certificates, folder / AUTHORITY)
    chain = _attempt(faults, read_certificates, folder / CERTIFICATE)
    key = _attempt(faults, read_key, folder / KEY)
    if faults:
        return faults
    faults += _key_faults(folder, chain[0], key)
    faults += _chain_faults(folder, chain, authorities, now or datetime.now(UTC))
    return faults + _use_faults(folder / CERTIFICATE, Certificate.of(chain[0]), name, listens=listens)


def _attempt(faults: list[KeysError], read: Callable[[Path], _T], path: Path) -> _T:
    """What is read; where it cannot be, a fault, and nothing that may be used."""
    try:
        return read(path)
    except KeysError as error:
        faults.append(error)
        return None  # type: ignore[return-value]


def _key_faults(folder: Path, certificate: x509.Certificate, key: CertificateIssuerPrivateKeyTypes) -> list[KeysError]:
    faults = []
    path = folder / KEY
    if key.public_key() != certificate.public_key():
        faults.append(KeysError(f"does not belong to {folder / CERTIFICATE}; copy both anew", path))
    if os.name == "posix" and stat.S_IMODE(path.stat().st_mode) & 0o077:
        faults.append(KeysError(f"can be read by others on this host: chmod 600 {path}", path))
    return faults


def _chain_faults(
    folder: Path, chain: Sequence[x509.Certificate], authorities: Sequence[x509.Certificate], now: datetime
) -> list[KeysError]:
    faults = []
    for at, certificate in enumerate(chain):
        if not any(_is_issued_by(certificate, issuer) for issuer in (*chain[at + 1 :], *authorities)):
            what = f"was not issued by the authority in {folder / AUTHORITY}; copy both from where they were made"
            faults.append(KeysError(what, folder / CERTIFICATE))
            break
    dated = [(folder / CERTIFICATE, certificate) for certificate in chain]
    for path, certificate in [*dated, *((folder / AUTHORITY, authority) for authority in authorities)]:
        begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
        if now > ends:
            faults.append(KeysError(f"expired at {ends:%Y-%m-%d %H:%M} UTC; issue it anew", path))
        if now < begins:
            what = f"is valid from {begins:%Y-%m-%d %H:%M} UTC only, and this host's clock says {now:%Y-%m-%d %H:%M}"
            faults.append(KeysError(what, path))
    return faults


def _is_issued_by(certificate: x509.Certificate, issuer: x509.Certificate) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _use_faults(path: Path, certificate: Certificate, name: str, *, listens: bool) -> list[KeysError]:
    faults = []
    if certificate.name != certificate_name(name):
        faults.append(KeysError(f"is the certificate of {certificate.name!r}, not of {certificate_name(name)!r}", path))
    if listens and not certificate.listens:
        what = "names no host: issue one with --host NAME_OR_ADDRESS"
        faults.append(KeysError(what, path))
    if not listens and not certificate.connects:
        faults.append(KeysError("may not be used to connect (extended key usage)", path))
    return faults
