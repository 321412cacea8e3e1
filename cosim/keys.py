"""What `cosim keys` does: a team's certificate authority, and the keys of its processes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from datetime import UTC, datetime

from cosim.errors import ConfigError, Location, Problem
from network import access, authority
from network.keyfiles import (
    AUTHORITY,
    AUTHORITY_KEY,
    CERTIFICATE,
    Certificate,
    KeysError,
    need_cryptography,
    read_certificates,
)
from network.transport import HUB


def main(args: argparse.Namespace) -> int:
    """Carry out `args.action`.

    Raises:
        ConfigError: something is wrong with the arguments or with what is there.
    """
    try:
        return {"init": _init, "issue": _issue, "show": _show, "router": _router}[args.action](args)
    except KeysError as error:
        raise ConfigError(problems([error])) from error


def problems(faults: Iterable[KeysError]) -> list[Problem]:
    """As users are told of them."""
    return [Problem(fault.what, Location(str(fault.file)) if fault.file else None) for fault in faults]


def _init(args: argparse.Namespace) -> int:
    authority.create(args.folder)
    print(
        f"wrote {args.folder}, the authority; {args.folder / AUTHORITY_KEY} must not leave this host\n"
        f"next: cosim keys issue {HUB} --host NAME_OR_ADDRESS {args.folder}"
    )
    return 0


def _issue(args: argparse.Namespace) -> int:
    folder = authority.issue(args.folder, args.name, args.host, authority.DAYS if args.days is None else args.days)
    print(f"wrote {folder}; copy it to the host of {args.name} (scp -rp), and let nobody else read it")
    if args.name == HUB and not args.host:
        print(f"it names no host, so that {HUB} can connect to a router of yours, but not listen itself")
    return 0


def _router(args: argparse.Namespace) -> int:
    faults = access.check_listen([args.listen], args.keys, insecure=False, name=access.name_in(args.keys) or "router")
    if faults:
        raise ConfigError(problems(faults))
    try:
        members = access.Members(["emulator", *args.workers], ["emulator"], namespace=args.namespace)
        tree = access.router(args.keys, [args.listen], members)
    except ValueError as error:
        raise ConfigError([Problem(str(error))]) from None
    text = json.dumps(tree, indent=2) + "\n"
    if args.out is None:
        print(text, end="")
        return 0
    try:
        args.out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise KeysError(f"cannot be written: {error.strerror}", args.out) from None
    print(f"wrote {args.out}; next: zenohd --config {args.out}")
    return 0


def _show(args: argparse.Namespace) -> int:
    need_cryptography()
    if (args.folder / CERTIFICATE).exists():
        found = [args.folder / CERTIFICATE]
    elif (args.folder / AUTHORITY).exists():
        found = [args.folder / AUTHORITY, *sorted(args.folder.glob(f"*/{CERTIFICATE}"))]
    else:
        raise KeysError("there are no keys here; to make some: cosim keys init", args.folder)
    rows = [_row(Certificate.of(read_certificates(path)[0])) for path in found]
    widths = [max(len(row[column]) for row in rows) for column in range(2)]
    for name, until, hosts in rows:
        print(f"{name:{widths[0]}}  {until:{widths[1]}}  {hosts}".rstrip())
    return 0


def _row(certificate: Certificate) -> tuple[str, str, str]:
    now = datetime.now(UTC)
    if now > certificate.ends:
        state = f"expired on {certificate.ends:%Y-%m-%d}"
    elif now < certificate.begins:
        state = f"valid from {certificate.begins:%Y-%m-%d}"
    else:
        state = f"valid until {certificate.ends:%Y-%m-%d}"
    return certificate.name, state, ", ".join(certificate.hosts)
