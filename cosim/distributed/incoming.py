"""What has come to the orchestrator and is not recorded yet, in the pieces in which it came. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from network.messages import Fates, Floats


class Rows:
    """Recorded rows of a worker's agents, tick by tick."""

    def __init__(self) -> None:
        self._pieces: deque[Floats] = deque()
        self._n_ticks = 0

    def __len__(self) -> int:
        """How many ticks."""
        return self._n_ticks

    def extend(self, rows: Floats) -> None:
        """(n_ticks, width) more of them."""
        if len(rows):
            self._pieces.append(rows)
            self._n_ticks += len(rows)

    def take(self, n_ticks: int) -> Floats:
        """(n_ticks, width) the first of them, of which there must be so many; one at least."""
        self._n_ticks -= n_ticks
        taken = []
        while n_ticks:
            piece = self._pieces.popleft()
            if len(piece) > n_ticks:
                self._pieces.appendleft(piece[n_ticks:])
                piece = piece[:n_ticks]
            taken.append(piece)
            n_ticks -= len(piece)
        return taken[0] if len(taken) == 1 else np.concatenate(taken)


class FateLog:
    """Fates of messages, tick by tick."""

    def __init__(self) -> None:
        self._pieces: deque[tuple[list[int], Fates]] = deque()
        self._n_ticks = 0

    def __len__(self) -> int:
        """How many ticks."""
        return self._n_ticks

    def extend(self, counts: Sequence[int], fates: Fates) -> None:
        """More of them: how many each tick has, and those of all of them."""
        if counts:
            self._pieces.append((list(counts), fates))
            self._n_ticks += len(counts)

    def take(self, n_ticks: int) -> tuple[list[int], Fates]:
        """Those of the first ticks, of which there must be so many; one at least."""
        self._n_ticks -= n_ticks
        all_counts: list[int] = []
        taken = []
        while len(all_counts) < n_ticks:
            counts, fates = self._pieces.popleft()
            wanted = n_ticks - len(all_counts)
            if len(counts) > wanted:
                end = sum(counts[:wanted])
                self._pieces.appendleft((counts[wanted:], fates.between(end, len(fates))))
                counts, fates = counts[:wanted], fates.between(0, end)
            all_counts += counts
            taken.append(fates)
        return all_counts, Fates.joined(taken)
