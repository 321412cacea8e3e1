"""What a person sees while a run goes on: simulated time, speed against real time, current disagreement."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Floats
from cosim.plan import Plan
from cosim.running.pacing import Pacer
from network.messages import Fates

if TYPE_CHECKING:
    from tqdm import tqdm

REFRESH_SECONDS = 0.1


class Disagreement:
    """`max |p_1 - p_i|` over agents and axes, read from a recorded row."""

    def __init__(self, plan: Plan) -> None:
        self._columns: list[NDArray[np.intp]] = []
        position = plan.analysis.position
        offset = 0
        for agent in plan.agents:
            for name, port in agent.record:
                if name == position:
                    self._columns.append(np.arange(offset, offset + port.variable.size))
                offset += port.variable.size

    def of(self, row: Floats) -> float | None:
        """In the position's unit; None where fewer than two agents record a position."""
        if len(self._columns) < 2:
            return None
        positions = row[np.stack(self._columns)]
        return float(np.max(np.abs(positions - positions[0])))


def say(text: str) -> None:
    """A line on standard error, above a bar if there is one."""
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)
    else:
        print(text, file=sys.stderr)


class Progress:
    """An observer that draws a bar on standard error; in a log file, a line after 1, 2, 4, 8, … seconds."""

    def __init__(self, plan: Plan, *, quiet: bool, pacer: Pacer | None = None) -> None:
        self._plan = plan
        self._pacer = pacer
        self._quiet = quiet
        self._disagreement = Disagreement(plan)
        self._on_terminal = sys.stderr.isatty()
        self._started = time.perf_counter()
        self._due = self._started + (REFRESH_SECONDS if self._on_terminal else 1.0)
        self._bar: tqdm[NoReturn] | None = None

    def tick(self, tick: int, row: Floats) -> None:
        now = time.perf_counter()
        if self._quiet or now < self._due:
            return
        self._due = now + (REFRESH_SECONDS if self._on_terminal else now - self._started)
        simulated = tick * self._plan.period
        text = f"{simulated:.1f} s simulated, "
        if self._pacer is None:
            text += f"{simulated / (now - self._started):.3g} x real time"
        else:
            text += f"real-time factor {self._pacer.reached:.4g}, {self._pacer.missed} ticks missed"
        disagreement = self._disagreement.of(row)
        if disagreement is not None:
            text += f", disagreement {disagreement:.3g}"
        if self._on_terminal:
            self._draw(tick, text)
        else:
            print(f"{100 * tick / self._plan.ticks:3.0f} %: {text}", file=sys.stderr)

    def _draw(self, tick: int, text: str) -> None:
        if self._bar is None:
            from tqdm import tqdm  # only runs that last long enough to be watched pay for the import

            self._bar = tqdm(total=self._plan.ticks, file=sys.stderr, dynamic_ncols=True)
        self._bar.bar_format = "{percentage:3.0f}%|{bar}| " + text + " [{elapsed}<{remaining}]"
        self._bar.update(tick - self._bar.n)

    def fates(self, fates: Fates) -> None:
        """Nothing to show."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
