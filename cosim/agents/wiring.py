"""The signals of one agent: which values move between its components and its mailbox, and in which order.

All values live in one flat vector, the signals: first the outputs of the components that somebody reads, then the
mailbox, then what comes from outside. A `Transfer` moves values between that vector and one component. Both micro-step
loops, the Python one and the native one, carry out the same transfers.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.agents.transfers import (
    Inputs,
    Key,
    Places,
    Positions,
    Transfer,
    concatenate,
    key_of,
    target_of,
    unique,
)
from cosim.components.component import Component
from cosim.components.presented import beginning, read_back
from cosim.plan import AgentPlan, ComponentPlan, Method, Port
from network.messages import NEVER, MessageLayout


class AlgebraicLoopError(ValueError):
    """Outputs and inputs feed each other directly, with no state in between, and cannot be solved."""


@dataclass(frozen=True)
class AlgebraicLoop:
    """An algebraic loop: outputs that feed each other directly.

    Attributes:
        names: `first.y -> second.y -> first.y`: each depends directly on the one before it.
        component: that of the first of them.
        sets: SET of every input that the outputs feed.
        gets: GET of the outputs.
        positions: of the outputs in the signals.
    """

    names: str
    component: int
    sets: tuple[Transfer, ...]
    gets: tuple[Transfer, ...]
    positions: Positions


@dataclass(frozen=True)
class MailboxLayout:
    """Where the mailbox lies in the signals, for n in-neighbours and messages of `width` numbers.

    Attributes:
        values: (n, width) position of every number of every row.
        stamp, time, weight: (n,) positions.
    """

    values: Positions
    stamp: Positions
    time: Positions
    weight: Positions

    @cached_property
    def rows(self) -> tuple[NDArray[np.intp], ...]:
        """Of each in-neighbour, the positions of its values, its stamp and its time (`Updates.content`)."""
        return tuple(np.column_stack((self.values, self.stamp, self.time)).astype(np.intp))


@dataclass(frozen=True)
class Unheard:
    """What an input has that takes values from messages, until they come.

    Attributes:
        port: the input.
        positions: of the messages' values in the signals.
        declared: what its component gives it.
        names: under which a scenario may give it something else.
    """

    port: Port
    positions: Positions
    declared: NDArray[np.float64]
    names: Sequence[str]

    @classmethod
    def of(cls, plan: AgentPlan, port: Port, positions: Positions) -> Unheard:
        """That of an input; it is the same for all agents that are planned alike."""
        variables = plan.components[port.component].description.variables
        own = {element.variable.name for element in read_back(port.variable)}
        names = [
            name
            for name, variable in variables.items()
            if any(element.variable.name in own for element in variable.elements or ())
            or (variable.elements is None and name in own)
        ]
        return cls(port, positions, beginning(port.variable, variables, {}), names)

    def values(self, component: ComponentPlan) -> NDArray[np.float64]:
        """Shape (positions.size,), in the unit of the message."""
        start = {name: component.start[name] for name in self.names if name in component.start}
        return beginning(self.port.variable, component.description.variables, start) if start else self.declared


@dataclass(frozen=True)
class Wiring:
    """Everything that moves inside one agent.

    Attributes:
        n_signals: length of the signal vector.
        owner: (n_signals,) component whose output a signal is; -1 for the mailbox and what comes from outside.
        continuous: (n_signals,) whether a signal is an output that changes continuously: others are never extrapolated.
        mailbox: its place.
        unheard: of each input that takes values from messages, what it has until they come.
        external: of each value from outside, its place.
        held: GET of arrays of which only some elements are fed: the others keep what they have at the start.
        propagate: at events, outputs to inputs, ordered so that every output is read after the inputs that feed through
            to it; outputs that feed each other are solved together. Empty unless the coupling is `joint`, the only one
            that evaluates outputs between steps.
        follow: between events, the same for the inputs that are continuous: the others may be set in Event Mode only
            (FMI 3.0, section 3.2.2; FMI 2.0.5, section 3.2.2).
        outputs: per component, GET of every output that some input is connected to.
        inputs: per component, SET of every connected input.
        listen: SET of every input that the mailbox or the outside feeds.
        sample: GET of what is published or recorded and not among `outputs`.
        watch: per component, GET of its other outputs and its states that change continuously, where the coupling makes
            steps twice to see their errors (`cosim.agents.watched`).
        published, recorded: positions of the published message, and of the recorded row, in the signals.
    """

    n_signals: int
    owner: Positions
    continuous: NDArray[np.bool_]
    mailbox: MailboxLayout
    unheard: tuple[Unheard, ...]
    external: tuple[Positions, ...]
    held: tuple[Transfer, ...]
    propagate: tuple[Transfer | AlgebraicLoop, ...]
    follow: tuple[Transfer | AlgebraicLoop, ...]
    outputs: tuple[tuple[Transfer, ...], ...]
    inputs: tuple[tuple[Transfer, ...], ...]
    listen: tuple[Transfer, ...]
    sample: tuple[Transfer, ...]
    watch: tuple[tuple[Transfer, ...], ...]
    published: Positions
    recorded: Positions

    @property
    def loops(self) -> tuple[AlgebraicLoop, ...]:
        """The algebraic loops among what is propagated."""
        return tuple(part for part in self.propagate if isinstance(part, AlgebraicLoop))

    def fill(self, signals: NDArray[np.float64], plan: AgentPlan) -> None:
        """At the start: no neighbour heard yet, and in place of what will come from them what their inputs start with;
        weights, and values from outside, in place; all else stays zero.
        """
        for unheard in self.unheard:
            signals[unheard.positions] = unheard.values(plan.components[unheard.port.component])
        signals[self.mailbox.stamp] = NEVER
        signals[self.mailbox.weight] = plan.weights
        for positions, external in zip(self.external, plan.external, strict=True):
            signals[positions] = external.start


def wire(plan: AgentPlan, layout: MessageLayout) -> Wiring:
    """The wiring of an agent.

    Raises:
        AlgebraicLoopError: `joint`, and direct feedthrough closes a loop through outputs that are no real numbers; the
            message names the variables in it.
    """
    connected = unique(connection.source for connection in plan.connections)
    sampled = unique([*plan.publish, *(port for _, port in plan.record)])
    watched = _watched(plan) if plan.coupling.control is not None and plan.coupling.control.rollback else []
    outputs = unique([*connected, *sampled, *watched])

    places = Places()
    for port in outputs:
        places.add_output(port)
    mailbox = _mailbox_layout(len(plan.neighbours), layout, places.n)
    places.skip(mailbox.values.size + 3 * len(plan.neighbours))
    external = [places.skip(len(source.start)) for source in plan.external]
    connections = [(x.target, places.of(x.source)) for x in plan.connections]
    heard = _heard(plan, layout, mailbox, external)
    inputs = Inputs([*connections, *heard], places)

    components = range(len(plan.components))
    joint = plan.coupling.method is Method.JOINT
    connected_keys = {key_of(port) for port in connected}

    def others(ports: Sequence[Port], c: int) -> tuple[Transfer, ...]:
        return places.gets([p for p in ports if p.component == c and key_of(p) not in connected_keys])

    return Wiring(
        n_signals=places.n,
        owner=np.array(places.owner, dtype=np.int32),
        continuous=np.array(places.continuous, dtype=np.bool_),
        mailbox=mailbox,
        unheard=tuple(Unheard.of(plan, port, positions) for port, positions in _messages(plan, layout, mailbox)),
        external=tuple(external),
        held=inputs.held,
        propagate=_propagation(plan, places, inputs) if joint else (),
        follow=_propagation(plan, places, inputs, continuous=True) if joint else (),
        outputs=tuple(places.gets([p for p in connected if p.component == c]) for c in components),
        inputs=tuple(inputs.sets(feed[0] for feed in connections if feed[0].component == c) for c in components),
        listen=tuple(
            transfer for c in components for transfer in inputs.sets(port for port, _ in heard if port.component == c)
        ),
        sample=tuple(transfer for c in components for transfer in others(sampled, c)),
        watch=tuple(others(watched, c) for c in components),
        published=concatenate(places.of(port) for port in plan.publish),
        recorded=concatenate(places.of(port) for _, port in plan.record),
    )


class Wirings:
    """The wirings of agents; agents that are planned alike share one.

    Args:
        layout: of the network's messages.
    """

    def __init__(self, layout: MessageLayout) -> None:
        self._layout = layout
        self._known: dict[tuple[object, ...], tuple[AgentPlan, Wiring]] = {}

    def of(self, plan: AgentPlan) -> Wiring:
        """See `wire`. Planning hands agents alike the same parts, so that it suffices to ask whether they are."""
        parts = (plan.connections, plan.publish, plan.mailbox, plan.record, *(x.description for x in plan.components))
        external = tuple((x.port.component, x.port.variable.name) for x in plan.external)
        coupling = plan.coupling.method, plan.coupling.control
        key = (*map(id, parts), *coupling, len(plan.neighbours), external)
        if key not in self._known:
            self._known[key] = plan, wire(plan, self._layout)  # the plan stays alive, and with it its parts' identity
        return self._known[key][1]


def takes_in_event_mode(component: Component, inputs: Iterable[Transfer]) -> bool:
    """Whether a Co-Simulation component takes these inputs in Event Mode only: some of them are discrete."""
    return component.uses_events and any(not v.is_continuous for transfer in inputs for v in transfer.variables)


def _mailbox_layout(n: int, layout: MessageLayout, offset: int) -> MailboxLayout:
    """One block of n rows per message variable, as the inputs want them, then stamps, times and weights."""
    blocks = []
    for size in layout.sizes:
        blocks.append(np.arange(offset, offset + n * size, dtype=np.int32).reshape(n, size))
        offset += n * size
    stamp, time, weight = (np.arange(offset + i * n, offset + (i + 1) * n, dtype=np.int32) for i in range(3))
    values = np.concatenate([np.empty((n, 0), dtype=np.int32), *blocks], axis=1)
    return MailboxLayout(np.ascontiguousarray(values), stamp, time, weight)


def _messages(plan: AgentPlan, layout: MessageLayout, mailbox: MailboxLayout) -> list[tuple[Port, Positions]]:
    """The inputs that take values from messages, and where these lie."""
    return [
        (port, mailbox.values[:, layout.slices[name]].reshape(-1).astype(np.int32))
        for name, port in plan.mailbox.values.items()
    ]


def _heard(
    plan: AgentPlan, layout: MessageLayout, mailbox: MailboxLayout, external: Sequence[Positions]
) -> list[tuple[Port, Positions]]:
    """The inputs that the mailbox and the outside feed, and where what they take lies."""
    feeds = _messages(plan, layout, mailbox)
    for special, positions in (
        (plan.mailbox.stamp, mailbox.stamp),
        (plan.mailbox.time, mailbox.time),
        (plan.mailbox.weight, mailbox.weight),
    ):
        if special is not None:
            feeds.append((special, positions))
    feeds += [(source.port, positions) for source, positions in zip(plan.external, external, strict=True)]
    return [(port, positions) for port, positions in feeds if positions.size]


def _watched(plan: AgentPlan) -> list[Port]:
    """All that changes continuously, as the components themselves call it."""
    return [
        Port(c, variable)
        for c, component in enumerate(plan.components)
        for variable in (component.description.own or component.description).variables.values()
        if variable.is_continuous and variable.size
        if variable.causality == "output" or variable.name in component.description.states
    ]


def _propagation(
    plan: AgentPlan, places: Places, inputs: Inputs, *, continuous: bool = False
) -> tuple[Transfer | AlgebraicLoop, ...]:
    """Kahn's algorithm over outputs: read all outputs whose feeding inputs are set, set what they feed, repeat.

    Where none is left of these, some feed each other: such a loop is solved as a whole, and counts as read.

    Args:
        plan: of the agent.
        places: where the outputs lie.
        inputs: what sets the inputs.
        continuous: only inputs that are; the others hold what they have, and close no loop.
    """
    connections = [x for x in plan.connections if not continuous or inputs.follows(x.target)]
    source_of = {target_of(x.target): key_of(x.source) for x in connections}
    waiting = unique(connection.source for connection in connections)
    done: set[Key] = set()
    parts: list[Transfer | AlgebraicLoop] = []
    components = range(len(plan.components))

    def gets(ports: Sequence[Port]) -> Iterator[Transfer]:
        for c in components:
            yield from places.gets([port for port in ports if port.component == c])

    def sets(sources: Container[Key]) -> Iterator[Transfer]:
        for c in components:
            targets = [x.target for x in connections if x.target.component == c and key_of(x.source) in sources]
            yield from inputs.sets(targets, continuous=continuous)

    while waiting:
        feeding = {
            key_of(port): [key for key in _feeding(plan, port, source_of) if key not in done] for port in waiting
        }
        ready = [port for port in waiting if not feeding[key_of(port)]]
        if ready:
            parts += gets(ready)
            parts += sets({key_of(port) for port in ready})
        else:
            members = _first_loop(feeding)
            ready = [port for port in waiting if key_of(port) in members]
            names = _loop_names(plan, feeding, members)
            if any(not port.variable.dtype.startswith("Float") for port in ready):
                raise AlgebraicLoopError(
                    f"an algebraic loop: {names}; each of these outputs depends directly on the one before it, and not "
                    "all of them are real numbers, so that it cannot be solved. Use `coupling: {method: midpoint}`, or "
                    "break the loop with a component that has a state"
                )
            positions = concatenate(places.of(port) for port in ready)
            parts.append(AlgebraicLoop(names, ready[0].component, tuple(sets(members)), tuple(gets(ready)), positions))
        done |= {key_of(port) for port in ready}
        waiting = [port for port in waiting if key_of(port) not in done]
    return tuple(parts)


def _first_loop(feeding: Mapping[Key, Sequence[Key]]) -> frozenset[Key]:
    """Outputs that all feed each other, if only through others, and that nothing else still waiting feeds."""
    reached = {key: _reached(feeding, key) for key in feeding}
    return min((others for key, others in reached.items() if key in others), key=len)


def _reached(feeding: Mapping[Key, Sequence[Key]], key: Key) -> frozenset[Key]:
    """What feeds an output, directly or not."""
    found: set[Key] = set()
    ahead = list(feeding[key])
    while ahead:
        if (other := ahead.pop()) not in found:
            found.add(other)
            ahead += feeding[other]
    return frozenset(found)


def _feeding(plan: AgentPlan, port: Port, source_of: dict[tuple[int, str], Key]) -> list[Key]:
    """The outputs that feed, through one connected input, straight through to this output."""
    inputs = port.variable.dependencies
    if inputs is None:  # the component does not say: assume all of them
        inputs = tuple(x.target.variable.name for x in plan.connections if x.target.component == port.component)
    keys = [(port.component, name) for name in inputs]
    return [source_of[key] for key in keys if key in source_of]


def _loop_names(plan: AgentPlan, feeding: Mapping[Key, Sequence[Key]], members: Container[Key]) -> str:
    """Follow what feeds an output of a loop until one repeats."""
    path = [next(key for key in feeding if key in members)]
    while path[-1] not in path[:-1]:
        path.append(next(key for key in feeding[path[-1]] if key in members))
    loop = path[path.index(path[-1]) :]
    return " -> ".join(f"{plan.components[c].name}.{name}" for c, name, _ in reversed(loop))
