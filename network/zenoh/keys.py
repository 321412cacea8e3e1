"""The keys of a run (docs/protocol.md)."""

from __future__ import annotations

from dataclasses import dataclass

from network.envelope import check_name


@dataclass(frozen=True)
class Keys:
    """The keys of a run. Chunks that begin with @ are matched by no wildcard."""

    root: str

    def inbox(self, receiver: str) -> str:
        return f"{self.root}/{receiver}/*"

    def message(self, receiver: str, sender: str) -> str:
        return f"{self.root}/{receiver}/{sender}"

    def alive(self, name: str, token: str) -> str:
        return f"{self.root}/@alive/{name}/{token}"

    def join(self, name: str) -> str:
        return f"{self.root}/@join/{name}"


def keys_of(run: str, namespace: str | None) -> Keys:
    """Those of a run, below its namespace.

    Raises:
        ValueError: a name that cannot be part of a key.
    """
    chunks = ["netcosim", check_name(run, "run")]
    if namespace is not None:
        chunks.insert(1, check_name(namespace, "namespace"))
    return Keys("/".join(chunks))
