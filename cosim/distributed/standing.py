"""What is said of a run that does not go on: what each process waits for. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cosim.distributed.assignment import EMULATOR, Share
from cosim.plan import Plan
from cosim.scenario.names import in_short

_NAMED = 6
"""So many processes are named with their agents; more in short."""


@dataclass(frozen=True)
class Standing:
    """How far everybody is, as far as is known.

    Attributes:
        ready: whether the first tick has begun.
        released: the last tick to which everybody may go.
        exchanged: ticks that the emulator has answered.
        ticks: of each worker, the one that it is at: its mail is what it needs next.
        samples: of each worker, ticks whose samples the emulator has.
        idle: processes that answer, so are not at work.
    """

    ready: bool
    released: int
    exchanged: int
    ticks: Mapping[str, int]
    samples: Mapping[str, int]
    idle: frozenset[str]

    def culprits(self) -> tuple[str, ...]:
        """Who could go on and does not: all others wait for them."""
        behind = {name: tick for name, tick in self.ticks.items() if tick < self.exchanged or not self.samples[name]}
        suspects = {name: tick for name, tick in behind.items() if name not in self.idle} or behind
        first = min(suspects.values(), default=0)
        return tuple(name for name, tick in suspects.items() if tick == first) or (EMULATOR,)


def carried(plan: Plan, name: str, workers: Mapping[str, Share]) -> str:
    """A process as people are told of it: `worker-1 (agents 1..5)`."""
    if name not in workers:
        return f"the {name}"
    names = in_short(plan.agents[i].name for i in workers[name])
    return f"{name} (agent{'' if len(workers[name]) == 1 else 's'} {names})"


def waits(
    plan: Plan, workers: Mapping[str, Share], standing: Standing, culprits: Sequence[str], *, cut_off: bool
) -> list[str]:
    """One line for all processes that wait for the same, except the culprits'.

    Args:
        plan: what runs.
        workers: the agents of each.
        standing: how far everybody is.
        culprits: those that others wait for.
        cut_off: whether the emulator is gone, through which the workers would have answered.
    """
    if cut_off and standing.ready:
        verb = "waits" if len(workers) == 1 else "wait"
        return [f"{_together(plan, workers, [*workers])} {verb} for mail from the emulator"]
    lines = []
    if EMULATOR not in culprits:
        lines.append(f"the emulator {_reason(plan, workers, standing, EMULATOR)[0]}")
    by_reason: dict[tuple[str, str], list[str]] = {}
    for name in workers:
        if name not in culprits:
            by_reason.setdefault(_reason(plan, workers, standing, name), []).append(name)
    return lines + [
        f"{_together(plan, workers, names)} {one if len(names) == 1 else many}"
        for (one, many), names in by_reason.items()
    ]


def _reason(plan: Plan, workers: Mapping[str, Share], standing: Standing, name: str) -> tuple[str, str]:
    """Why a process does not go on: after one name, after several."""
    if not standing.ready:
        return "waits for all to be ready", "wait for all to be ready"
    if name == EMULATOR:
        tick = min(standing.samples.values())
        late = [other for other, count in standing.samples.items() if count == tick]
        if standing.exchanged >= plan.ticks:
            return "has done its part", ""
        if standing.exchanged >= standing.released:
            return f"waits for the orchestrator to release tick {standing.released + 1}", ""
        return f"waits for the samples of tick {tick} from {_together(plan, workers, late)}", ""
    tick = standing.ticks[name]
    if tick >= plan.ticks:
        return "has done its part", "have done their part"
    if tick < standing.exchanged and name not in standing.idle:
        return f"is at work on tick {tick}", f"are at work on tick {tick}"
    return f"waits for the mail of tick {tick} from the emulator", f"wait for the mail of tick {tick} from the emulator"


def _together(plan: Plan, workers: Mapping[str, Share], names: Sequence[str]) -> str:
    if len(names) > _NAMED:
        return f"{len(names)} workers ({in_short(names)})"
    texts = [carried(plan, name, workers) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"
