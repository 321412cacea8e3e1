"""What a person sees while a run goes on: simulated time, speed against real time, current disagreement."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cosim.component import Floats
from cosim.plan import Plan
from network.messages import Fates

if TYPE_CHECKING:
    from tqdm import tqdm

REFRESH_SECONDS = 0.1
REFRESH_SECONDS_IN_A_LOG = 10.0


class Disagreement:
    """`max |p_1 - p_i|` over agents and axes, read from recorded rows."""

    def __init__(self, plan: Plan) -> None:
        self._columns: list[tuple[int, slice]] = []
        position = plan.analysis.position
        for agent in plan.agents:
            offset = 0
            for name, port in agent.record:
                if name == position:
                    self._columns.append((agent.index, slice(offset, offset + port.variable.size)))
                offset += port.variable.size

    def of(self, rows: Sequence[Floats]) -> float | None:
        """In the position's unit; None where fewer than two agents record a position."""
        if len(self._columns) < 2:
            return None
        positions = np.stack([rows[agent][part] for agent, part in self._columns])
        return float(np.max(np.abs(positions - positions[0])))


class Progress:
    """An observer that draws a bar on standard error; in a log file, a line every ten seconds."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._disagreement = Disagreement(plan)
        self._interval = REFRESH_SECONDS if sys.stderr.isatty() else REFRESH_SECONDS_IN_A_LOG
        self._started = self._shown = time.perf_counter()
        self._bar: tqdm[None] | None = None

    def tick(self, tick: int, rows: Sequence[Floats]) -> None:
        now = time.perf_counter()
        if now - self._shown < self._interval:
            return
        self._shown = now
        if self._bar is None:
            from tqdm import tqdm  # only runs that last long enough to be watched pay for the import

            self._bar = tqdm(
                total=self._plan.ticks, file=sys.stderr, bar_format="{l_bar}{bar}| {desc} [{elapsed}<{remaining}]"
            )
        simulated = tick * self._plan.period
        text = f"{simulated:.1f} s simulated, {simulated / (now - self._started):.0f} x real time"
        disagreement = self._disagreement.of(rows)
        if disagreement is not None:
            text += f", disagreement {disagreement:.3g}"
        self._bar.bar_format = "{percentage:3.0f}%|{bar}| " + text + " [{elapsed}<{remaining}]"
        self._bar.update(tick - self._bar.n)

    def fates(self, fates: Fates) -> None:
        """Nothing to show."""

    def close(self) -> None:
        """Leave the line as it is."""
        if self._bar is not None:
            self._bar.close()
