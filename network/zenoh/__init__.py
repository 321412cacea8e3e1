"""Endpoints over Zenoh: the hub's, and those of the processes that connect to it. Only this and `plain` import it.

Keys, joining and the rules behind the settings are in docs/protocol.md. Nothing of Zenoh is trusted to deliver: every
message is numbered and checked by `network.envelope`, and every wait ends.
"""

from __future__ import annotations

from network.zenoh.client import ZenohClient, connect
from network.zenoh.endpoint import ZenohEndpoint
from network.zenoh.hub import ZenohHub, open_hub
from network.zenoh.session import LEASE, WATCHED, open_session

__all__ = ["LEASE", "WATCHED", "ZenohClient", "ZenohEndpoint", "ZenohHub", "connect", "open_hub", "open_session"]
