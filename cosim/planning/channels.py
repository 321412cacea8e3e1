"""What can be found out about channels before a run only by opening them on their edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.planning.graph import Edge, links_of
from cosim.planning.problems import Problems
from cosim.planning.silence import without_root
from cosim.scenario.reading import Scenario
from network.channel import Setting
from network.conformance import Rule, violations
from network.custom import Custom
from network.draws import Draws
from network.messages import NEVER
from network.replay import Replay

_NAMED = 3  # silent edges
_TICKS, _EDGES = 70, 20  # a class of the user's own is tried for so long, on so many


def try_channels(scenario: Scenario, edges: Sequence[Edge], problems: Problems) -> None:
    """Open recorded networks on their edges, and play classes of the user's own."""
    for name in dict.fromkeys(edge.channel for edge in edges):
        model, where = scenario.spec.channels[name], scenario.root.locate("channels", name, key=True)
        served = [edge for edge in edges if edge.channel == name]
        if isinstance(model, Replay):
            draws = Draws(0, [edge.sender for edge in served], [edge.receiver for edge in served])
            links, period = links_of(served, list(scenario.agents)), scenario.spec.period
            try:
                channel = model.open(Setting(links, period, draws, 8))
            except ValueError as error:
                problems.error(f"channels.{name}: {error}", where)
                continue
            sent = channel.transmit_many(range(scenario.spec.duration // period))
            arrives = (sent.delay_ns != NEVER) & (sent.sent * period + sent.delay_ns < scenario.spec.duration)
            silent = [served[link] for link in np.setdiff1d(np.arange(len(served)), sent.link[arrives]).tolist()]
            if silent:
                named = ", ".join(f"{edge.sender} -> {edge.receiver}" for edge in silent[:_NAMED])
                more = f" and {len(silent) - _NAMED} more" if len(silent) > _NAMED else ""
                without = {(edge.sender, edge.receiver) for edge in silent}
                others = [edge for edge in edges if (edge.sender, edge.receiver) not in without]
                rest = without_root(scenario, edges, others)
                problems.warning(f"the channel {name!r} delivers nothing in this run on {named}{more}{rest}", where)
        elif isinstance(model, Custom):
            some = [(edge.sender, edge.receiver) for edge in served[:_EDGES]]
            for violation in violations(model.served, n_ticks=_TICKS, period_ns=scenario.spec.period, edges=some):
                say = problems.error if violation.rule in {Rule.WORKS, Rule.MESSAGES} else problems.warning
                say(f"channels.{name}: {violation}", where)
