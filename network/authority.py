"""A team's certificate authority: makes it, and issues the keys with which processes prove who they are.

The authority is a folder, and every process name has a folder in it that holds all that this process needs: `ca.pem`,
`cert.pem` (its common name is the name) and `key.pem`. `network.keyfiles` reads and checks these.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final

from network.envelope import check_name
from network.keyfiles import (
    AUTHORITY,
    AUTHORITY_KEY,
    CERTIFICATE,
    KEY,
    KeysError,
    certificate_name,
    need_cryptography,
    read_certificates,
    read_key,
)

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

DAYS: Final = 365
"""For which a certificate is valid unless the user says otherwise."""

_AUTHORITY_DAYS = 3650
_CLOCK_SKEW = timedelta(hours=1)  # so that hosts whose clocks are late can use it at once
_LONGEST_NAME = 64  # of a common name, RFC 5280
_LABEL = r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)"
_HOST = re.compile(rf"{_LABEL}(\.{_LABEL})*")


def create(folder: Path) -> None:
    """Make an authority in a new folder.

    Raises:
        KeysError: there is something already, or it cannot be written.
    """
    need_cryptography()
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    if (folder / AUTHORITY).exists():
        raise KeysError(f"holds an authority already; to issue keys: cosim keys issue NAME {folder}", folder)
    key = ec.generate_private_key(ec.SECP256R1())
    # Every authority has a name of its own: one is told from another, also where only the name is shown.
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"netcosim authority {secrets.token_hex(4)}")])
    builder = _builder(name, name, key, datetime.now(UTC), _AUTHORITY_DAYS)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    with _new_folder(folder) as new:
        _write_certificate(new / AUTHORITY, builder.sign(key, hashes.SHA256()))
        _write_key(new / AUTHORITY_KEY, key)


def issue(folder: Path, name: str, hosts: Sequence[str] = (), days: int = DAYS, since: datetime | None = None) -> Path:
    """Issue a key and a certificate; the new folder, which is to be copied to the host of that process.

    Args:
        folder: of the authority.
        name: of the process.
        hosts: names and addresses at which others find this process; only with such can it be the one that listens.
        days: how long the certificate is valid.
        since: from when; from now, if not given.

    Raises:
        KeysError: one of these cannot be, it has been issued before, or it cannot be written.
    """
    need_cryptography()
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    _check_issuable(name)
    alternatives = [_alternative(host) for host in hosts]
    if not (folder / AUTHORITY).exists():
        raise KeysError(f"there is no authority here; to make one: cosim keys init {folder}", folder)
    authority = read_certificates(folder / AUTHORITY)[0]
    authority_key = read_key(folder / AUTHORITY_KEY)
    begin = since or datetime.now(UTC)
    left = (authority.not_valid_after_utc - begin).days
    if not 1 <= days <= left:
        raise KeysError(f"--days {days}: write a number from 1 to {left}, as long as the authority is valid", folder)
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = _builder(authority.subject, subject, key, begin, days)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    builder = builder.add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()), critical=False
    )
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if alternatives:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    with _new_folder(folder / name) as new:
        _write_certificate(new / AUTHORITY, authority)
        _write_certificate(new / CERTIFICATE, builder.sign(authority_key, hashes.SHA256()))
        _write_key(new / KEY, key)
    return folder / name


def _check_issuable(name: str) -> None:
    try:
        check_name(name, "name")
    except ValueError as error:
        raise KeysError(str(error)) from None
    base = certificate_name(name)
    if base != name:
        raise KeysError(f"name {name!r}: what replaces {base!r} uses its key; write {base!r}, or no number at the end")
    if len(name) > _LONGEST_NAME:
        raise KeysError(f"name {name!r}: a certificate has room for {_LONGEST_NAME} characters, not {len(name)}")
    if name in (AUTHORITY, AUTHORITY_KEY):
        raise KeysError(f"name {name!r}: a file of the authority is called so; choose another one")


def _alternative(host: str) -> x509.GeneralName:
    """A host as a certificate names it."""
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        if not _HOST.fullmatch(host) or len(host) > 253 or host.rpartition(".")[2].isdigit():
            raise KeysError(
                f"--host {host}: write the name or address of a host, without a port, such as hub.lab or 192.0.2.7"
            ) from None
    return x509.DNSName(host.lower())


def _builder(
    issuer: x509.Name, subject: x509.Name, key: EllipticCurvePrivateKey, begin: datetime, days: int
) -> x509.CertificateBuilder:
    from cryptography import x509

    begin = begin.replace(microsecond=0)
    builder = x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(begin - _CLOCK_SKEW).not_valid_after(begin + timedelta(days=days))
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


# --- files --------------------------------------------------------------------------------------------------------
@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder that only this user can enter, and that is there with all that it should hold or not at all."""
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise KeysError("exists already, and is not overwritten; remove it first, or choose another one", folder)
    new: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=".new-", dir=folder.parent))  # of mode 0700
        yield new
        new.rename(folder)
    except OSError as error:
        raise KeysError(f"cannot be written: {error.strerror or error}", folder) from error
    finally:
        if new is not None:
            shutil.rmtree(new, ignore_errors=True)


def _write_certificate(path: Path, certificate: x509.Certificate) -> None:
    from cryptography.hazmat.primitives.serialization import Encoding

    _write(path, certificate.public_bytes(Encoding.PEM), 0o644)


def _write_key(path: Path, key: EllipticCurvePrivateKey) -> None:
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    _write(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 0o600)


def _write(path: Path, content: bytes, mode: int) -> None:
    path.touch(mode, exist_ok=False)
    path.write_bytes(content)
