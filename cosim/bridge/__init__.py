"""The way out of a run and in again: variables on plain Zenoh keys at every tick, inputs whose values others send.

`Live` talks to the outside; `Replay` stands in for it with what an earlier run has recorded. Whoever plays the run asks
at every tick for the values that are new (`take`), and they are recorded before they are used: so the same values at
the same ticks give the same digest. Formats and rules are in docs/bridge.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol

from cosim.components.component import Floats
from cosim.plan import Plan
from network.messages import Fates

Taken = Mapping[int, Floats]
"""New values by index in `BridgePlan.subscribe`; what is not in it keeps its value."""


class Bridge(Protocol):
    """What is on the other side. It is an observer of the run, too.

    Attributes:
        where: what people are told of it at the beginning.
    """

    where: str

    def take(self, tick: int) -> Taken:
        """The newest values that have come since the tick before; asked once per tick, in order."""

    def tick(self, tick: int, row: Floats) -> None:
        """Publish what is recorded; it never waits."""

    def fates(self, fates: Fates) -> None:
        """Not needed."""

    def account(self) -> list[str]:
        """What there was, for the lines at the end of a run."""


@contextmanager
def open_bridge(plan: Plan, warn: Callable[[str], None]) -> Iterator[Bridge | None]:
    """The bridge of a plan, if it has one, while inside.

    Args:
        plan: what runs.
        warn: told of messages that are refused.

    Raises:
        ConfigError: the recording that is to be replayed cannot be used, or an endpoint cannot be opened.
    """
    if plan.bridge and plan.bridge.replay is not None:
        from cosim.bridge.replay import Replay

        yield Replay(plan.bridge)
    elif plan.bridge:
        from cosim.bridge.live import Live

        with Live(plan, warn) as live:
            yield live
    else:
        yield None


def recorded(bridge: Bridge, record: Callable[[int, Taken], None]) -> Callable[[int], Taken]:
    """`bridge.take`; what is taken is recorded before anybody uses it."""

    def take(tick: int) -> Taken:
        taken = bridge.take(tick)
        record(tick, taken)
        return taken

    return take
