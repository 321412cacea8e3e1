"""Warnings about channels that deliver nothing, or nothing for longer than the controllers are designed for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cosim.plan import AnalysisPlan
from cosim.planning.graph import Edge, links_of
from cosim.planning.problems import Problems
from cosim.scenario.names import in_short
from cosim.scenario.reading import Scenario
from cosim.theory import mu, published_bound
from cosim.topology import roots
from network.channel import ChannelModel, Setting
from network.draws import Draws
from network.freshness import intervals_above
from network.impairments.delay import Delay
from network.impairments.mahimahi import read_trace
from network.messages import NEVER, Links
from network.netem import Netem
from network.profile import Profile
from network.units import format_duration

_MOST_TICKS = 10_000_000
_TICKS_AT_ONCE, _MOST_TRIED = 16, 10_000


def warn_of_silence(
    scenario: Scenario, edges: Sequence[Edge], message_bytes: int, analysis: AnalysisPlan, problems: Problems
) -> None:
    """About channels in use that never deliver within the run, and about planned blackouts."""
    for name in dict.fromkeys(edge.channel for edge in edges):
        model, where = scenario.spec.channels[name], scenario.root.locate("channels", name, key=True)
        reason = never_delivers(model, scenario.spec.period, scenario.spec.duration, message_bytes)
        if reason is not None:
            rest = without_root(scenario, edges, [edge for edge in edges if edge.channel != name])
            problems.warning(f"the channel {name!r} delivers nothing in this run: {reason}{rest}", where)
        elif (blackout := longest_blackout_ns(model, scenario.spec.period, scenario.spec.duration)) > 0:
            found = _admitted(analysis, [edge.receiver for edge in edges if edge.channel == name])
            few = {agent: bound for agent, bound in found.items() if blackout > bound * 1e9}
            if few:
                problems.warning(
                    f"the schedule of the channel {name!r} is down for {format_duration(blackout)}, longer than the "
                    f"age of {min(few.values()):.4g} s that the published condition admits for agents {in_short(few)}",
                    where,
                )


def never_delivers(model: ChannelModel, period_ns: int, duration_ns: int, message_bytes: int) -> str | None:
    """Why no message can arrive before the end of a run; None if one may."""
    if model.min_delay_ns() >= duration_ns:
        return f"its least delay, {format_duration(model.min_delay_ns())}, is not shorter than the run"
    if not isinstance(model, Profile):
        return None
    if model.loss is not None and model.loss.loss_rate() >= 1:
        return "every message is lost"
    if longest_blackout_ns(model, period_ns, duration_ns) >= duration_ns:
        return "its schedule is never up at a tick"
    if model.mahimahi is not None and not model.mahimahi.spread:
        times = read_trace(Path(model.mahimahi.file)) * 1_000_000
        begin = model.mahimahi.start % int(times[-1])
        following = times[times >= begin]
        if len(following) and following[0] - begin >= duration_ns:
            return "its trace has no opportunity to send within the run"
    if model.rate is not None and (takes := model.rate.transmission_ns(message_bytes)) >= duration_ns:
        return f"at its rate a message of {message_bytes} bytes takes {format_duration(takes)}, longer than the run"
    if not _lets_through(model, period_ns, duration_ns, message_bytes):
        return f"what its capacity and delays let through of {message_bytes} bytes arrives after the run"
    return None


def _lets_through(model: Profile, period_ns: int, duration_ns: int, message_bytes: int) -> bool:
    """Whether one of its first messages arrives before the end of a run, if chance and plan let it through at best."""
    delay = None
    if model.delay is not None and model.reorder is None:
        delay = Delay.model_validate(f"{model.delay.min_delay_ns()} ns")
    best = Netem.model_construct(
        slot=model.slot, rate=model.rate, mahimahi=model.mahimahi, recorded=model.recorded, delay=delay
    )
    links = Links(("sender", "receiver"), *(np.array([i], np.int64) for i in (0, 1, 0)))
    channel = best.open(Setting(links, period_ns, Draws(0, ["sender"], ["receiver"]), message_bytes))
    n_ticks = duration_ns // period_ns
    for first in range(0, n_ticks, _TICKS_AT_ONCE):
        sent = channel.transmit_many(range(first, min(first + _TICKS_AT_ONCE, n_ticks)))
        if ((sent.delay_ns != NEVER) & (sent.sent * period_ns + sent.delay_ns < duration_ns)).any():
            return True
        if first >= _MOST_TRIED:
            return True  # who knows
    return False


def longest_blackout_ns(model: ChannelModel, period_ns: int, duration_ns: int) -> int:
    """The longest time for which the schedule of a profile lets no tick's message through, in nanoseconds."""
    n_ticks = duration_ns // period_ns
    if not isinstance(model, Profile) or model.schedule is None or n_ticks > _MOST_TICKS:
        return 0
    down = model.schedule.is_down(np.arange(n_ticks) * period_ns)
    spans = intervals_above(down.astype(np.int64), 0)
    return int((spans[:, 1] - spans[:, 0]).max(initial=0)) * period_ns


def without_root(scenario: Scenario, edges: Sequence[Edge], rest: Sequence[Edge]) -> str:
    """What to add to a warning about silent edges where the graph needs them, `rest` being the others."""
    names = list(scenario.agents)
    needed = roots(links_of(edges, names)) and not roots(links_of(rest, names))
    return "; without its edges the graph has no root" if needed else ""


def _admitted(analysis: AnalysisPlan, receivers: Sequence[str]) -> dict[str, float]:
    """The largest h* in seconds that the published condition admits, of those receivers whose gains are known."""
    k_eta, lambda_ = analysis.k_eta or {}, analysis.lambda_ or {}
    return {
        name: published_bound(mu(k_eta[name], lambda_[name]))
        for name in dict.fromkeys(receivers)
        if name in k_eta and name in lambda_
    }
