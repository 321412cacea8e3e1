r"""The digest of a run: two runs are the same if and only if, in practice, their digests are.

    digest = SHA-256(H ‖ R ‖ F), as 64 hexadecimal digits, where ‖ puts bytes one after the other

H: one line of JSON in ASCII, keys sorted, no blanks:
    `{"agents":[[name,[column,…]],…],"format":1,"period_ns":T}`, with the agents in the order of the file and, of each,
    the columns of `trajectories.parquet` that it records, in the file's order of columns. Characters beyond ASCII are
    escaped as `\uXXXX`.
R: the 32 bytes of SHA-256 over what is recorded: tick by tick from 0, agent by agent, column by column (only the
    columns that the agent records), each number as an IEEE 754 binary64 of 8 bytes, little-endian.
F: the 32 bytes of SHA-256 over the rows of `deliveries.parquet` in their order, each as six signed 64-bit integers,
    little-endian: sender and receiver (index of the agent, from 0), stamp, sent, arrival_ns (-1 where lost), and fate
    (0 delivered, 1 superseded, 2 lost, 3 in flight).

Neither the size of the row groups, nor how the fates were grouped, nor a time of day, a machine or a process goes in.
The digest of an aborted run is that of what its files hold.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence

from network.messages import Floats, Ints

FORMAT = 1


class RunDigest:
    """Takes rows and fates as they come, in blocks of any size.

    Args:
        period_ns: T.
        agents: name and recorded columns of every agent.
    """

    def __init__(self, period_ns: int, agents: Iterable[tuple[str, Sequence[str]]]) -> None:
        header = {
            "agents": [[name, list(columns)] for name, columns in agents],
            "format": FORMAT,
            "period_ns": period_ns,
        }
        self._header = json.dumps(header, sort_keys=True, separators=(",", ":")).encode("ascii")
        self._rows = hashlib.sha256()
        self._fates = hashlib.sha256()

    def rows(self, values: Floats) -> None:
        """Whole ticks: (n_ticks, width), each agent by agent and column by column."""
        self._rows.update(values.astype("<f8", order="C", copy=False).data)

    def fates(self, values: Ints) -> None:
        """(n, 6): sender, receiver, stamp, sent, arrival_ns, fate."""
        self._fates.update(values.astype("<i8", order="C", copy=False).data)

    def hexdigest(self) -> str:
        """The digest of everything so far; more may follow."""
        return hashlib.sha256(self._header + self._rows.digest() + self._fates.digest()).hexdigest()
