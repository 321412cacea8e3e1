"""Plans of agents that are alone: nobody hears them, they hear nobody, and nothing of them is recorded."""

from __future__ import annotations

from collections.abc import Iterable

from cosim.plan import AgentPlan, ComponentPlan, Connection, CouplingPlan, MailboxPlan, Method, Port


def alone(
    components: Iterable[ComponentPlan],
    connections: Iterable[tuple[Port, Port]] = (),
    *,
    name: str = "a",
    method: Method = Method.JOINT,
) -> AgentPlan:
    """An agent with micro steps of 1 ms; connections are from the first to the second."""
    return AgentPlan(
        index=0,
        name=name,
        components=tuple(components),
        connections=tuple(Connection(source, target) for source, target in connections),
        publish=(),
        mailbox=MailboxPlan({}, None, None, None),
        neighbours=(),
        weights=(),
        coupling=CouplingPlan(method, 1_000_000),
        record=(),
    )
