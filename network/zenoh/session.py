"""Sessions of Zenoh, and the settings that all of ours have; the rules behind them are in docs/protocol.md."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Final

# Two threads for all of Zenoh: a fifth less time per exchange than by default. Receiving has one of its own, because
# the hub's waits where it passes on more than a receiver's queue holds; were it also the one that sends, for ever.
os.environ.setdefault(  # read when the first session opens
    "ZENOH_RUNTIME",
    "(rx:(worker_threads:1),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))",
)
import zenoh

LEASE: Final = 5.0
"""Seconds without a sign of life after which a process that is stopped, or cut off, counts as lost; less than this is
not rare where many processes start on few cores."""

HUB_STALL: Final = 5.0
"""Seconds for which a process's Zenoh may take nothing before the hub closes the connection, and it counts as lost."""

STALL: Final = 60.0
"""The same for what the others send to the hub: longer, so that the one who does not take its messages is named."""

_WAIT: Final = "transport/link/tx/queue/congestion_control/block/wait_before_close"  # µs
_LEASE: Final = "transport/link/tx/lease"  # ms
_BUSY: Final = 20.0
WATCHED: Final[Mapping[str, object]] = {_LEASE: int(_BUSY * 1e3), _WAIT: int(_BUSY * 1e6)}
"""Settings of processes that somebody watches who sees them end or stop: on a busy host they may be silent for long."""

_SETTINGS: Final[Mapping[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/shared_memory/enabled": False,
    "timestamping/enabled": False,
    _LEASE: int(LEASE * 1e3),
    _WAIT: int(STALL * 1e6),
    "transport/unicast/max_sessions": 4000,
}


def open_session(settings: Mapping[str, object]) -> zenoh.Session:
    """A session with these settings of Zenoh, by path, over those that all of ours have."""
    config = zenoh.Config()
    for key, value in {**_SETTINGS, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def listening(endpoints: Sequence[str]) -> dict[str, object]:
    """Settings of a session that is the router of a run."""
    return {"mode": "router", "listen/endpoints": list(endpoints), _WAIT: int(HUB_STALL * 1e6)}


def connecting(endpoints: Sequence[str], timeout: float) -> dict[str, object]:
    """Settings of a session that connects to a router, which need not be there yet."""
    return {
        "mode": "client",
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": int(timeout * 1e3),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 1.5},
    }
