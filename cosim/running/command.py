"""`cosim run`: from a scenario file to a finished run folder."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from cosim.bridge import Bridge, open_bridge, recorded
from cosim.errors import ConfigError, CosimError, Problem, RunEndedError
from cosim.logs import LOG_FOLDER, Logs
from cosim.native_output import captured
from cosim.plan import Plan
from cosim.recording.recorder import Recorder
from cosim.running.estimation import Estimate
from cosim.running.folder import Keeper, close_after, close_interrupted, run_folder
from cosim.running.inline import Interrupted, Observer, Take, run
from cosim.running.pacing import Overrun, Pacer, precise_timers
from cosim.running.progress import Progress, say
from cosim.running.stopping import StopRequest
from cosim.running.summary import Summary
from cosim.running.watching import Watch
from cosim.screen import discard, is_gone


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
    restarts: list[Mapping[str, Any]] = []

    def tell(text: str, restart: Mapping[str, Any] | None) -> None:
        say(text)
        if restart is not None:
            restarts.append(restart)
            recorder.add({"distributed": {**details["distributed"], "restarts": restarts}})

    estimate = Estimate(plan) if getattr(args, "estimate_error", False) else None
    stop, keeper = StopRequest(), Keeper()
    watch = Watch(plan.agents, plan.period_ns, args.step_deadline, stop, keeper) if here else None
    with run_folder(plan.name, args.out) as folder:
        play, details = way(args, plan, pacer, folder.absolute(), tell, watch)
        recorder = Recorder(plan, folder, details)
        summary = Summary(plan, pacer, recorder)
        with (
            _native_output(recorder.place, here=here),
            stop.listening(),
            watch or nullcontext(),
            open_bridge(plan, _warn) as bridge,
            Progress(plan, quiet=args.quiet, pacer=pacer) as progress,
        ):
            recorder.open()
            keeper.recorder = recorder
            gc.enable()
            if bridge is not None and not args.quiet:
                say(f"the bridge {bridge.where}")
            try:
                if estimate is not None:
                    _prepare(estimate, stop, watch, quiet=args.quiet)
                _play(play, recorder, summary, estimate, progress, bridge, stop, pacer)
            except (Interrupted, KeyboardInterrupt) as error:
                tick = error.tick if isinstance(error, Interrupted) else summary.reached
                close_interrupted(recorder, tick, plan.period)
                if isinstance(error, KeyboardInterrupt):
                    raise
                return stop.exit_code
            except BaseException as error:
                close_after(error, recorder)
                raise
        digest = recorder.close("complete")
    if not args.quiet:
        try:
            summary.show(recorder.folder, digest, bridge, estimate)
        except OSError as error:
            if not is_gone(sys.stdout, error):
                raise
            discard(sys.stdout)  # who read it may still want the report
    for warning in estimate.warnings() if estimate is not None else ():
        _warn(warning)
    return _draw(recorder, quiet=args.quiet) if args.report else 0


def _play(  # noqa: PLR0917
    play: Play,
    recorder: Recorder,
    summary: Summary,
    estimate: Estimate | None,
    progress: Progress,
    bridge: Bridge | None,
    stop: StopRequest,
    pacer: Pacer | None,
) -> None:
    """Play the plan before all observers; the manifest learns what they found."""
    observers: list[Observer] = [recorder, *([] if estimate is None else [estimate]), summary, progress]
    with _accounted(pacer, recorder):
        try:
            if bridge is None:
                play(observers, stop)
            else:
                play([recorder, bridge, *observers[1:]], stop, take=recorded(bridge, recorder.external))
        except RunEndedError as ended:
            summary.ended(ended)
    if estimate is not None:
        recorder.add({"coupling_error": estimate.account()})


def _prepare(estimate: Estimate, stop: StopRequest, watch: Watch | None, *, quiet: bool) -> None:
    """Play with half the steps, for the estimate."""
    if not quiet:
        say("playing with half the micro steps, for the estimate of the error")
    try:
        estimate.prepare(stop, watch)
    except Interrupted:
        raise Interrupted(-1) from None


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
