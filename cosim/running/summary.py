"""The lines at the end of a run: what was done, where it is, and how far the agents are from agreeing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cosim.agents.step_control import StepAccount, manifest
from cosim.bridge import Bridge
from cosim.components.component import Floats
from cosim.errors import RunEndedError
from cosim.plan import Plan
from cosim.recording.recorder import Recorder
from cosim.running.estimation import Estimate
from cosim.running.pacing import Pacer
from cosim.running.progress import Disagreement
from network.messages import Fates


class Summary:
    """An observer that keeps what the lines at the end say; what the manifest says, too, it gives to the recorder."""

    def __init__(self, plan: Plan, pacer: Pacer | None, recorder: Recorder) -> None:
        self._plan = plan
        self._recorder = recorder
        self._accounts: Sequence[StepAccount] = []
        self._pacer = pacer
        self._started = time.perf_counter()
        self._tick, self._row = -1, np.empty(0)
        self._ended: RunEndedError | None = None

    def tick(self, tick: int, row: Floats) -> None:
        self._tick, self._row = tick, row

    @property
    def reached(self) -> int:
        """The last tick, -1 before the first one."""
        return self._tick

    def fates(self, fates: Fates) -> None:
        """Not needed."""

    def ended(self, ended: RunEndedError) -> None:
        """A component asked for the end."""
        self._ended = ended
        who = {"agent": ended.agent, "component": ended.component}
        self._recorder.add({"ended": {**who, "time_s": ended.time, "message": ended.message}})

    def steps(self, accounts: Sequence[StepAccount]) -> None:
        self._accounts = accounts
        self._recorder.add({"step_control": manifest(accounts)})

    def show(self, folder: Path, digest: str, bridge: Bridge | None, estimate: Estimate | None) -> None:
        """Say what was done, where it is, and how far the agents are from agreeing."""
        wall = time.perf_counter() - self._started
        simulated, planned = (n * self._plan.period for n in (self._tick, self._plan.ticks))
        of_planned = f" of {planned:g} s" if self._ended is not None else ""
        pace = f"{simulated / wall:.0f} x real time"
        print(f"{self._plan.name}: {simulated:g} s{of_planned} simulated in {wall:.2f} s ({pace})")
        if self._ended is not None:
            who = f"component {self._ended.component} of agent {self._ended.agent}"
            print(f"  ended                    at t = {self._ended.time:.9g} s by {who}, which asked for it")
        disagreement = Disagreement(self._plan).of(self._row)
        if disagreement is not None:
            print(f"  disagreement at the end  {disagreement:.3g} (largest |p_1 - p_i|)")
        if estimate is not None:
            worst = max(estimate.errors(), key=lambda error: error.relative, default=None)
            print(f"  coupling error           {'nothing is recorded' if worst is None else f'about {worst}'}")
        if self._accounts:
            worst_steps = max(self._accounts, key=lambda account: account.ratio)
            print(f"  steps of agent {worst_steps.agent:<10}{worst_steps}")
        for i, line in enumerate(bridge.account() if bridge is not None else ()):
            print(f"  {'' if i else 'bridge':<25}{line}")
        if self._pacer is not None:
            print(self._pacer)
        print(f"  digest                   {digest}")
        print(f"  run folder               {folder}")
