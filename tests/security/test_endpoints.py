"""Which endpoints are refused, and the access control that goes with the others."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from network.access import Members, check_connect, check_listen, listening, router
from network.keyfiles import KeysError


@pytest.mark.parametrize(
    "endpoint",
    ["unixsock-stream//tmp/x/hub", "tcp/127.0.0.1:7447", "tcp/127.8.9.10:1", "tcp/[::1]:7447", "tcp/localhost:7447"],
)
def test_on_this_host_nothing_is_asked_for(endpoint: str) -> None:
    assert check_listen([endpoint], None, insecure=False) == []
    assert check_connect([endpoint], None, insecure=False, name="worker-1") == []


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/192.0.2.7:7447", "tcp/hub.lab:7447", "tcp/[fe80::1%eth0]:7447"],
)
def test_beyond_this_host_keys_are_asked_for(endpoint: str) -> None:
    (fault,) = check_listen([endpoint], None, insecure=False)
    assert fault.what.startswith(f"{endpoint}: without keys anybody who reaches this host could listen and join")
    assert "cosim keys init" in fault.what
    assert "--insecure" in fault.what
    assert check_listen([endpoint], None, insecure=True) == []
    (fault,) = check_connect([endpoint], None, insecure=False, name="worker-1")
    assert fault.what.startswith(f"{endpoint}: without keys anybody could answer there")


@pytest.mark.parametrize(
    ("endpoint", "what"),
    [
        ("tcp/127.0.0.1:7447", "would not use the keys"),
        ("tcp/192.0.2.7:7447", "would not use the keys"),
        ("udp/127.0.0.1:7447", "write tls/HOST:PORT"),
        ("quic/127.0.0.1:7447", "write tls/HOST:PORT"),
        ("7447", "write tls/HOST:PORT"),
        ("tls/127.0.0.1", "write tls/HOST:PORT, such as"),
        ("tls/127.0.0.1:99999", "write tls/HOST:PORT, such as"),
        ("tls/127.0.0.1:7447#enable_mtls=false", "leave out what follows the #"),
        ("tls/192.0.2.7:7447", "is for hub.lab, 127.0.0.1, not for 192.0.2.7"),
        ("tls/other.lab:7447", "is for hub.lab, 127.0.0.1, not for other.lab"),
    ],
)
@pytest.mark.parametrize("insecure", [True, False])
def test_endpoints_that_would_not_be_protected_are_refused(
    team: Path, endpoint: str, what: str, insecure: bool
) -> None:
    (fault,) = check_listen([endpoint], team / "orchestrator", insecure)
    assert what in fault.what


@pytest.mark.parametrize("endpoint", ["tls/127.0.0.1:0", "tls/HUB.lab:7447", "tls/0.0.0.0:7447", "tls/[::]:7447"])
def test_endpoints_with_keys(team: Path, endpoint: str) -> None:
    assert check_listen([endpoint, "unixsock-stream//tmp/x"], team / "orchestrator", insecure=False) == []


def test_a_path_that_is_too_long_for_a_socket_is_refused() -> None:
    for check, more in ((check_listen, ()), (check_connect, ("worker-1",))):
        (fault,) = check([f"unixsock-stream//{'x' * 107}"], None, False, *more)  # type: ignore[operator]
        assert re.search("room for 10[37] bytes, this one takes 108; write a shorter one", fault.what)


def test_tls_needs_keys() -> None:
    (fault,) = check_listen(["tls/127.0.0.1:7447"], None, insecure=True)
    assert "TLS needs keys: --keys FOLDER" in fault.what


def test_all_that_is_wrong_is_said_at_once(team: Path) -> None:
    faults = check_listen(["tcp/192.0.2.7:1", "udp/x:1", "tls/127.0.0.1:1"], team / "worker-1", insecure=False)
    assert [fault.file and fault.file.name for fault in faults] == [None, None, "cert.pem", "cert.pem"]


def test_a_name_whose_certificate_would_do_for_another_is_refused(team: Path) -> None:
    for names in (["lab", "lab.east"], ["orchestrator.x"]):
        with pytest.raises(KeysError, match="rename one of them"):
            listening(team / "orchestrator", ["tls/127.0.0.1:1"], Members(names, (), "run"))


def test_names_that_are_no_part_of_a_key_are_refused(team: Path) -> None:
    for names, run, namespace in ((["*"], "run", None), (["a"], "r/*", None), (["a"], "run", "**")):
        with pytest.raises(ValueError, match="write letters"):
            listening(team / "orchestrator", [], Members(names, (), run, namespace))


def test_a_router_serves_all_runs_of_a_namespace_only(team: Path) -> None:
    tree = router(
        team / "orchestrator", ["tls/0.0.0.0:7447"], Members(["emulator", "worker-1"], ["emulator"], namespace="lab")
    )
    control = tree["access_control"]
    assert isinstance(control, dict)
    assert control["default_permission"] == "deny"
    keys = {key for rule in control["rules"] for key in rule["key_exprs"]}
    assert all(key.startswith("netcosim/lab/*/") for key in keys)
    assert {name for subject in control["subjects"] for name in subject["cert_common_names"]} == {
        "orchestrator",
        "emulator",
        "worker-1",
    }
