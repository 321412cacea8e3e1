"""The in-process run: one loop carries every message between the agents, the emulator and the master."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from cosim.agents.group import Agents
from cosim.agents.step_control import StepAccount
from cosim.components.component import Floats
from cosim.errors import NetworkError, RunEndedError
from cosim.logs import NO_LOGS, Logs
from cosim.master import Emulate, Master
from cosim.plan import Plan
from cosim.running.pacing import Pacer
from network.channel import ChannelError
from network.emulator import Emulator
from network.messages import Fates

if TYPE_CHECKING:
    from cosim.running.watching import Watch

Take = Callable[[int], Mapping[int, Floats]]
"""The values from outside that are new at a tick, by subscription; see `cosim.bridge`."""


class Observer(Protocol):
    """Sees every tick: a recorder, a progress bar, a test."""

    def tick(self, tick: int, row: Floats) -> None:
        """The recorded values at a tick: agent by agent in the order of the file, each in that of its plan's `record`.

        The array is the observer's to keep, not to change.
        """

    def fates(self, fates: Fates) -> None:
        """Messages whose fate became known in a tick."""


class CourseObserver(Observer, Protocol):
    """An observer that can be told of several ticks at once."""

    def course(self, first: int, rows: Floats, fates: Fates, counts: Sequence[int]) -> None:
        """What `tick` of each row and `fates` of its period would tell, one after the other.

        Args:
            first: the tick of the first row.
            rows: (n_ticks, width).
            fates: of all those ticks.
            counts: of each tick, how many of `fates` are its.
        """


def tell(
    observers: Sequence[Observer | CourseObserver], first: int, rows: Floats, fates: Fates, counts: Sequence[int]
) -> None:
    """Tell observers of several ticks; see `CourseObserver.course`."""
    one_by_one = [observer for observer in observers if not hasattr(observer, "course")]
    for observer in observers:
        if hasattr(observer, "course"):
            observer.course(first, rows, fates, counts)
    if one_by_one:
        ends = accumulate(counts, initial=0)
        for tick, (row, (begin, end)) in enumerate(zip(rows, pairwise(ends), strict=True), first):
            for observer in one_by_one:
                observer.tick(tick, row)
                observer.fates(fates.between(begin, end))


@runtime_checkable
class StepObserver(Protocol):
    """An observer that wants to know what became of the steps, where they are controlled."""

    def steps(self, accounts: Sequence[StepAccount]) -> None:
        """At the end of a run, however it ends: agent by agent."""


def tell_of_steps(observers: Sequence[object], accounts: Sequence[StepAccount]) -> None:
    """Tell those that want to know, if there is anything."""
    for observer in observers if accounts else ():
        if isinstance(observer, StepObserver):
            observer.steps(accounts)


class Interrupted(Exception):  # noqa: N818 - it is a request, not an error
    """Somebody asked the run to stop; everything observed so far is complete up to this tick."""

    def __init__(self, tick: int) -> None:
        self.tick = tick
        super().__init__(f"interrupted after tick {tick}")


def run(  # noqa: PLR0917
    plan: Plan,
    observers: Sequence[Observer],
    stop_requested: Callable[[], bool] = lambda: False,
    pacer: Pacer | None = None,
    take: Take | None = None,
    logs: Logs = NO_LOGS,
    watch: Watch | None = None,
) -> None:
    """Play a plan from tick 0 to its last tick.

    Args:
        plan: what to run.
        observers: told of every tick and every fate, in order.
        stop_requested: asked once per tick, and every 20 ms while the pacer waits.
        pacer: holds the run back to the pace of the wall; without one, it runs as fast as it can.
        take: gives the values from outside that are new at a tick; needed if the plan subscribes to any.
        logs: where what the components log goes.
        watch: looks on while components are called.

    Raises:
        RunError: a component failed, or (`RunEndedError`) asked for the end.
        Interrupted: `stop_requested` said so.
        OverrunError: the pacer said so.
        NetworkError: a channel of the user's own failed.
    """
    at_components = nullcontext() if watch is None else watch.at_components
    if watch is not None:
        watch.agents = None  # those of a run before
    with at_components:
        agents = Agents(plan, attended=None if watch is None else watch.attended, logs=logs)
    if watch is not None:
        watch.agents = agents
    try:
        _play(plan, agents, at_components, observers, stop_requested, pacer, take)
    except ChannelError as error:
        raise NetworkError(str(error)) from error
    finally:
        tell_of_steps(observers, agents.accounts())
        with at_components:
            agents.terminate()


def _play(  # noqa: PLR0917
    plan: Plan,
    agents: Agents,
    at_components: AbstractContextManager[None],
    observers: Sequence[Observer],
    stop_requested: Callable[[], bool],
    pacer: Pacer | None,
    take: Take | None,
) -> None:
    emulator = Emulator(plan.links, plan.channels, plan.link_channel, plan.layout, plan.seed, plan.period_ns)
    master = Master([len(plan.agents)], plan.layout.width, plan.ticks)
    with at_components:
        agents.initialise()
    if pacer is not None:
        observers = [*observers, pacer]
        pacer.start()
    while True:
        tick = master.tick
        instruction = master.published(0, tick, agents.samples())
        row = agents.row()
        for observer in observers:
            observer.tick(tick, row)
        if not isinstance(instruction, Emulate):
            break
        taken = take(tick) if take is not None else {}
        if stop_requested() or (pacer is not None and not pacer.wait(tick + 1, stop_requested)):
            raise Interrupted(tick)
        exchange = emulator.emulate(instruction.tick, instruction.values)
        for observer in observers:
            observer.fates(exchange.fates)
        order = master.exchanged(exchange)
        try:
            with at_components:
                agents.advance(order.tick, order.mail, taken)
        except RunEndedError:
            _tell_of_flight(observers, emulator.finish())
            raise
    _tell_of_flight(observers, emulator.finish())


def _tell_of_flight(observers: Sequence[Observer], in_flight: Fates) -> None:
    for observer in observers:
        observer.fates(in_flight)
