from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from network import authority

LONG_AGO = datetime.now(UTC) - timedelta(days=30)


@pytest.fixture(scope="session", autouse=True)
def package() -> None:
    pytest.importorskip("cryptography", reason="keys need netcosim[tls]")


@pytest.fixture(scope="session")
def team(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, and keys of everybody."""
    folder = tmp_path_factory.mktemp("keys") / "team"
    authority.create(folder)
    authority.issue(folder, "orchestrator", ["127.0.0.1", "hub.lab"])
    for name in ("emulator", "worker-1", "worker-2"):
        authority.issue(folder, name)
    authority.issue(folder, "expired", days=1, since=LONG_AGO)
    return folder


@pytest.fixture(scope="session")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another authority, and keys of the same names."""
    folder = tmp_path_factory.mktemp("keys") / "strangers"
    authority.create(folder)
    authority.issue(folder, "orchestrator", ["127.0.0.1"])
    authority.issue(folder, "worker-1")
    return folder
