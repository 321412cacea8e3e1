"""`cosim run`: from a scenario file to a finished run folder."""

from __future__ import annotations

import argparse
import gc
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from cosim.agents.step_control import StepAccount, manifest
from cosim.bridge import Bridge, open_bridge, recorded
from cosim.components.component import Floats
from cosim.errors import (
    ClusterError,
    ConfigError,
    CosimError,
    NetworkError,
    OverrunError,
    Problem,
    RunEndedError,
    RunError,
)
from cosim.logs import LOG_FOLDER, Logs
from cosim.native_output import captured
from cosim.plan import Plan
from cosim.recording.recorder import Recorder
from cosim.running.estimation import Estimate
from cosim.running.inline import Interrupted, Observer, Take, run
from cosim.running.pacing import Overrun, Pacer, precise_timers
from cosim.running.progress import Disagreement, Progress, say
from cosim.running.stopping import StopRequest
from cosim.running.watching import Watch
from network.messages import Fates


def run_folder(name: str, out: Path | None) -> Path:
    """`out`, or a new `runs/<name>/<timestamp>` below the current folder; a second run in one second gets a number."""
    if out is not None:
        return out
    stamp = time.strftime("%Y-%m-%dT%H-%M-%S")
    candidates = (Path("runs") / name / (f"{stamp}-{i}" if i else stamp) for i in itertools.count())
    return next(folder for folder in candidates if not folder.exists())


def main(args: argparse.Namespace) -> int:
    """Run `args.config`; exit code 0, or 128 and the number of the signal that stopped it: 130 after Ctrl-C.

    Raises:
        CosimError: a mistake in the scenario, or a run that failed; what was computed until then is on disk.
    """
    from cosim.planning import load
    from cosim.running import check

    settings = list(args.set or ())
    if args.on_worker_loss is not None:
        settings.append(f"on_worker_loss={args.on_worker_loss}")
    planned = load(args.config, settings, seed=args.seed, until=args.until)
    for warning in planned.warnings:
        print(warning, file=sys.stderr)
    plan = planned.plan
    if absent := check.absent(plan):
        raise ConfigError([*absent, Problem("cosim serve runs this, with workers that have the whole files")])
    return record(args, plan, _way_to_play, here=not args.distributed)


def record(args: argparse.Namespace, plan: Plan, way: Way, *, here: bool = False) -> int:
    """Play a plan into a run folder, and draw its report.

    Args:
        args: as of `cosim run`, as far as it has them in common with `cosim serve`.
        plan: what is played.
        way: to play it.
        here: whether its components live in this process.

    Returns:
        The exit code.

    Raises:
        CosimError: the run failed; what was computed until then is on disk.
    """
    pacer = _pacer(args, plan)
    folder = run_folder(plan.name, args.out)
    restarts: list[Mapping[str, Any]] = []

    def tell(text: str, restart: Mapping[str, Any] | None) -> None:
        say(text)
        if restart is not None:
            restarts.append(restart)
            recorder.add({"distributed": {**details["distributed"], "restarts": restarts}})

    estimate = Estimate(plan) if getattr(args, "estimate_error", False) else None
    stop, record = StopRequest(), _Record()
    watch = Watch(plan.agents, plan.period_ns, args.step_deadline, stop, record) if here else None
    play, details = way(args, plan, pacer, folder.absolute(), tell, watch)
    recorder = Recorder(plan, folder, details)
    summary = _Summary(plan, pacer, recorder)
    with (
        _native_output(recorder.place, here=here),
        stop.listening(),
        watch or nullcontext(),
        open_bridge(plan, _warn) as bridge,
        Progress(plan, quiet=args.quiet, pacer=pacer) as progress,
    ):
        if estimate is not None and not _prepared(estimate, stop, watch, quiet=args.quiet):
            return stop.exit_code
        recorder.open()
        record.recorder = recorder
        gc.enable()
        if bridge is not None and not args.quiet:
            say(f"the bridge {bridge.where}")
        try:
            with _accounted(pacer, recorder):
                observers: list[Observer] = [recorder, *([] if estimate is None else [estimate]), summary, progress]
                try:
                    if bridge is None:
                        play(observers, stop)
                    else:
                        play([recorder, bridge, *observers[1:]], stop, take=recorded(bridge, recorder.external))
                except RunEndedError as ended:
                    summary.ended(ended)
            if estimate is not None:
                recorder.add({"coupling_error": estimate.account()})
        except Interrupted as interrupted:
            reached = f"t = {interrupted.tick * plan.period:.9g} s"
            recorder.close(f"aborted: interrupted at {reached}")
            print(f"interrupted at {reached}; everything until then is in {recorder.folder}", file=sys.stderr)
            return stop.exit_code
        except BaseException as error:
            _close_after(error, recorder)
            raise
    digest = recorder.close("complete")
    if not args.quiet:
        summary.show(recorder.folder, digest, bridge, estimate)
    for warning in estimate.warnings() if estimate is not None else ():
        print(f"warning: {warning}", file=sys.stderr)
    return _draw(recorder, quiet=args.quiet) if args.report else 0


def _prepared(estimate: Estimate, stop: StopRequest, watch: Watch | None, *, quiet: bool) -> bool:
    """Play with half the steps, for the estimate; False where somebody asked to stop."""
    if not quiet:
        say("playing with half the micro steps, for the estimate of the error")
    try:
        estimate.prepare(stop, watch)
    except Interrupted as interrupted:
        print(f"interrupted after tick {interrupted.tick} of the estimate; nothing is recorded", file=sys.stderr)
        return False
    return True


Tell: TypeAlias = Callable[[str, Mapping[str, Any] | None], None]
"""Is told, in a line, what happens to a worker, and what the manifest says of a restart."""


def _warn(text: str) -> None:
    say(f"warning: {text}")


class Play(Protocol):
    """A way to play a plan."""

    def __call__(
        self, observers: Sequence[Observer], stop_requested: Callable[[], bool], take: Take | None = None
    ) -> None:
        """Play the plan to its end."""


class Way(Protocol):
    """Makes ready to play a plan."""

    def __call__(  # noqa: PLR0917
        self, args: argparse.Namespace, plan: Plan, pacer: Pacer | None, folder: Path, tell: Tell, watch: Watch | None
    ) -> tuple[Play, dict[str, Any]]:
        """How to play it, and what the manifest says of that; `watch` looks on if it is played in this process."""


def _pacer(args: argparse.Namespace, plan: Plan) -> Pacer | None:
    """What holds the run back, if it is to be held back."""
    if args.realtime is None:
        if args.overrun is not None:
            raise CosimError(f"--overrun {args.overrun} is for runs that are paced; add --realtime")
        return None
    import pyarrow.parquet  # noqa: F401 - now rather than when the first block is written, in the midst of ticks

    precise_timers()
    return Pacer(plan, args.realtime, Overrun(args.overrun or Overrun.WARN), say=say)


@contextmanager
def _accounted(pacer: Pacer | None, recorder: Recorder) -> Iterator[None]:
    """However the run inside ends, the manifest says how its schedule was kept."""
    try:
        yield
    finally:
        if pacer is not None:
            recorder.add({"realtime": pacer.report()})
            pacer.say_total()


def _way_to_play(  # noqa: PLR0917
    args: argparse.Namespace, plan: Plan, pacer: Pacer | None, folder: Path, tell: Tell, watch: Watch | None
) -> tuple[Play, dict[str, Any]]:
    """In this process, or across several; and what the manifest says of it."""
    if not args.distributed:
        for option in ("workers", "on_worker_loss"):
            if getattr(args, option) is not None:
                raise CosimError(f"--{option.replace('_', '-')} is for runs across processes; add --distributed")
        return partial(_in_process, plan, pacer, folder, watch), {}
    from cosim.distributed import cluster

    workers = cluster.division(plan, args.workers)
    play = partial(cluster.run, plan, workers, tell=tell, step_deadline=args.step_deadline, pacer=pacer, folder=folder)
    return play, {"distributed": {"workers": len(workers)}}


@contextmanager
def _native_output(folder: Path, *, here: bool) -> Iterator[None]:
    """What native code prints goes to the run folder; of other processes, they see to it themselves."""
    if not here:
        yield
        return
    with Logs(folder / LOG_FOLDER) as logs, captured(logs.sink("output")):
        yield


def _in_process(  # noqa: PLR0917
    plan: Plan,
    pacer: Pacer | None,
    folder: Path,
    watch: Watch | None,
    observers: Sequence[Observer],
    stop_requested: Callable[[], bool],
    take: Take | None = None,
) -> None:
    with Logs(folder / LOG_FOLDER) as logs:
        run(plan, observers, stop_requested, pacer, take, logs, watch)


def _close_after(error: BaseException, recorder: Recorder) -> None:
    """Leave a readable run folder behind a failure."""
    reason = str(error) if isinstance(error, CosimError) else f"{type(error).__name__}: {error}"
    with suppress(CosimError):  # the first failure is the one to tell
        recorder.close(f"aborted: {reason.splitlines()[0]}")
    if isinstance(error, (RunError, ClusterError, NetworkError, OverrunError)):
        print(f"everything until then is in {recorder.folder}", file=sys.stderr)
    if isinstance(error, RunError):
        _point_to_logs(recorder)


def _point_to_logs(recorder: Recorder) -> None:
    """They may say more than the error does."""
    if (recorder.place / LOG_FOLDER).exists():
        print(f"what components logged and printed is in {recorder.folder / LOG_FOLDER}", file=sys.stderr)


class _Record:
    """What a run leaves that is ended by force."""

    recorder: Recorder | None = None
    """Once it is open."""

    def keep(self, error: CosimError, *, in_order: bool) -> None:
        if self.recorder is None:
            return
        folder = self.recorder.folder
        if in_order:
            _close_after(error, self.recorder)
            if isinstance(error, RunError):
                return
            print(f"everything until then is in {folder}", file=sys.stderr)
        else:
            print(f"`cosim report {folder}` saves what was computed until then", file=sys.stderr)
        _point_to_logs(self.recorder)


class _Summary:
    """An observer that keeps what the lines at the end say."""

    def __init__(self, plan: Plan, pacer: Pacer | None, recorder: Recorder) -> None:
        self._plan = plan
        self._recorder = recorder
        self._accounts: Sequence[StepAccount] = []
        self._pacer = pacer
        self._started = time.perf_counter()
        self._tick, self._row = 0, np.empty(0)
        self._ended: RunEndedError | None = None

    def tick(self, tick: int, row: Floats) -> None:
        self._tick, self._row = tick, row

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


def _draw(recorder: Recorder, *, quiet: bool) -> int:
    from cosim.reporting.report import draw

    stop = StopRequest()
    with stop.listening():
        page = draw(recorder.place, stop)
    if page is None:
        print(f"the run is complete; `cosim report {recorder.folder}` draws its report", file=sys.stderr)
        return stop.exit_code
    if not quiet:
        print(f"  report                   {recorder.folder / page.name}")
    return 0
