"""Making keys, and finding out what is wrong with them."""

from __future__ import annotations

import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from cosim.cli import main
from network import authority
from network.keyfiles import KeysError, certificate_name, check
from tests.security.conftest import LONG_AGO


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def copy(source: Path, target: Path) -> Path:
    return Path(shutil.copytree(source, target))


# --- making ------------------------------------------------------------------------------------------------------
def test_a_team_gets_its_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["keys", "init"]) == 0
    assert main(["keys", "issue", "orchestrator", "--host", "hub.lab", "--host", "::1", "--days", "10"]) == 0
    assert main(["keys", "issue", "--days", "20", "lab-b", "keys"]) == 0
    keys = tmp_path / "keys"
    assert sorted(path.name for path in keys.iterdir()) == ["ca.key.pem", "ca.pem", "lab-b", "orchestrator"]
    for name in ("lab-b", "orchestrator"):
        assert sorted(path.name for path in (keys / name).iterdir()) == ["ca.pem", "cert.pem", "key.pem"]
        assert (mode(keys / name), mode(keys / name / "key.pem")) == (0o700, 0o600)
        assert check(keys / name, name, listens=name == "orchestrator") == []
    assert (mode(keys), mode(keys / "ca.key.pem")) == (0o700, 0o600)
    capsys.readouterr()
    assert main(["keys", "show"]) == 0
    _, lab, hub = capsys.readouterr().out.splitlines()
    in_days = (datetime.now(UTC) + timedelta(days=10)).strftime("%Y-%m-%d")
    assert lab.startswith("lab-b")
    assert hub.split() == ["orchestrator", "valid", "until", in_days, "hub.lab,", "::1"]


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys = tmp_path / "keys"
    authority.create(keys)
    authority.issue(keys, "worker-1")
    before = {path: path.read_bytes() for path in keys.rglob("*.pem")}
    assert main(["keys", "init", str(keys)]) == 2
    assert main(["keys", "issue", "worker-1", str(keys)]) == 2
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    assert main(["keys", "init", str(tmp_path / "other")]) == 2
    errors = capsys.readouterr().err
    assert f"{keys}: error: holds an authority already; to issue keys: cosim keys issue NAME {keys}" in errors
    assert f"{keys / 'worker-1'}: error: exists already, and is not overwritten" in errors
    assert f"{tmp_path / 'other'}: error: exists already, and is not overwritten" in errors
    assert {path: path.read_bytes() for path in keys.rglob("*.pem")} == before


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["a/b"], "name 'a/b': write letters, digits"),
        (["@alive"], "name '@alive': write letters, digits"),
        (["worker-1.2"], "what replaces 'worker-1' uses its key; write 'worker-1'"),
        (["n" * 65], "a certificate has room for 64 characters, not 65"),
        (["ca.pem"], "a file of the authority is called so"),
        (["x", "--host", "hub.lab:7447"], "--host hub.lab:7447: write the name or address of a host, without a port"),
        (["x", "--host", "10.0.0"], "--host 10.0.0: write the name or address of a host"),
        (["x", "--days", "0"], "--days 0: write a number from 1 to 36"),
        (["x", "--days", "99999"], "--days 99999: write a number from 1 to 36"),
    ],
)
def test_what_cannot_be_issued_is_refused(
    team: Path, arguments: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(team.rglob("*"))
    assert main(["keys", "issue", *arguments, str(team)]) == 2
    assert what in capsys.readouterr().err
    assert sorted(team.rglob("*")) == before


def test_where_there_is_no_authority_it_is_said(tmp_path: Path, team: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "issue", "worker-1", str(tmp_path)]) == 2
    assert f"to make one: cosim keys init {tmp_path}" in capsys.readouterr().err
    assert main(["keys", "show", str(tmp_path)]) == 2
    assert "to make some: cosim keys init" in capsys.readouterr().err


def test_the_missing_package_is_named(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['cryptography'] = None\n"
        "from cosim.cli import main\n"
        f"sys.exit(main(['keys', 'init', {str(tmp_path / 'keys')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[0] == "error: keys need the package cryptography: pip install 'netcosim[tls]'"


# --- checking ----------------------------------------------------------------------------------------------------
def spoil(file: str) -> Callable[[Path, Path], None]:
    return lambda own, _: (own / file).write_text("-----BEGIN NONSENSE-----") and None


def take(*files: str) -> Callable[[Path, Path], None]:
    """Files of the strangers' instead."""

    def act(own: Path, strangers: Path) -> None:
        for file in files:
            shutil.copy(strangers / "worker-1" / file, own / file)

    return act


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda own, _: (own / "key.pem").unlink(), ["key.pem: cannot be read: No such file"]),
        (lambda own, _: (own / "key.pem").chmod(0o640), ["key.pem: can be read by others on this host: chmod 600 "]),
        (
            lambda own, _: [spoil(file)(own, own) for file in ("ca.pem", "cert.pem", "key.pem")],
            ["ca.pem: is no certificate", "cert.pem: is no certificate", "key.pem: is no private key"],
        ),
        (take("key.pem"), ["key.pem: does not belong to "]),
        (take("cert.pem", "key.pem"), ["cert.pem: was not issued by the authority in "]),
        (take("ca.pem"), ["cert.pem: was not issued by the authority in "]),
    ],
)
def test_what_is_wrong_with_the_files_is_found(
    team: Path, strangers: Path, tmp_path: Path, harm: Callable[[Path, Path], object], said: list[str]
) -> None:
    own = copy(team / "worker-1", tmp_path / "own")
    harm(own, strangers)
    faults = check(own, "worker-1", listens=False)
    assert len(faults) == len(said)
    for fault, text in zip(faults, said, strict=True):
        assert str(fault).startswith(f"{own}/{text}")


def test_dates_are_checked(team: Path) -> None:
    (fault,) = check(team / "expired", "expired", listens=False)
    assert f"{team / 'expired' / 'cert.pem'}: expired at {LONG_AGO + timedelta(days=1):%Y-%m-%d}" in str(fault)
    early = check(team / "worker-1", "worker-1", listens=False, now=LONG_AGO)
    assert [fault.file.name for fault in early if fault.file] == ["cert.pem", "ca.pem"]
    assert all(f"this host's clock says {LONG_AGO:%Y-%m-%d}" in fault.what for fault in early)


def test_the_wrong_folder_is_noticed(team: Path, tmp_path: Path) -> None:
    def only(folder: Path, name: str) -> str:
        (fault,) = check(folder, name, listens=False)
        return str(fault)

    assert only(team, "worker-1") == f"{team}: is the authority's folder; the keys of worker-1 are in {team}/worker-1"
    assert only(team / "worker-2", "worker-1").endswith("is the certificate of 'worker-2', not of 'worker-1'")
    assert "there is no such folder" in only(tmp_path / "none", "worker-1")
    assert check(team / "worker-1", "worker-1.2", listens=False) == []
    (fault,) = check(team / "worker-1", "worker-1", listens=True)
    assert "names no host" in str(fault)


@pytest.mark.parametrize(
    ("process", "certificate"),
    [
        ("worker-1", "worker-1"),
        ("worker-1.2", "worker-1"),
        ("worker-1.2.3", "worker-1"),
        ("a.b", "a.b"),
        ("a.b.7", "a.b"),
    ],
)
def test_a_replacement_uses_the_certificate_of_what_it_replaces(process: str, certificate: str) -> None:
    assert certificate_name(process) == certificate


def test_an_encrypted_key_is_refused(team: Path, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives.serialization import (
        BestAvailableEncryption,
        Encoding,
        PrivateFormat,
        load_pem_private_key,
    )

    own = copy(team / "worker-1", tmp_path / "own")
    key = load_pem_private_key((own / "key.pem").read_bytes(), None)
    (own / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"x")))
    assert [fault.what for fault in check(own, "worker-1", listens=False)] == [
        "is encrypted; Zenoh takes a key without a password only"
    ]


def test_half_a_folder_is_never_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(KeysError, match="No space left on device"):
        authority.create(tmp_path / "keys")
    assert list(tmp_path.iterdir()) == []
