"""The signals of one agent: which values move between its components and its mailbox, and in which order.

All values live in one flat vector, the signals: first the outputs of the components that somebody reads, then the
mailbox, then what comes from outside. A `Transfer` moves values between that vector and one component. Both micro-step
loops, the Python one and the native one, carry out the same transfers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Component, Variable
from cosim.plan import AgentPlan, Method, Port
from network.messages import NEVER, MessageLayout

Positions = NDArray[np.int32]


class AlgebraicLoopError(ValueError):
    """Outputs and inputs feed each other directly, with no state in between."""


class Direction(IntEnum):
    """Which way the values of a transfer go."""

    GET = 0  # component -> signals
    SET = 1  # signals -> component


@dataclass(frozen=True)
class Transfer:
    """Some variables of one component and where their values lie in the signals.

    Attributes:
        variables: in the order of the values.
        positions: (total size,) indices into the signals.
    """

    direction: Direction
    component: int
    variables: tuple[Variable, ...]
    positions: Positions

    @cached_property
    def parts(self) -> tuple[tuple[Variable, Positions | slice, NDArray[np.float64]], ...]:
        """Each variable with its own positions, as a slice where they follow each other, and as many zeros."""
        ends = itertools.accumulate((variable.size for variable in self.variables), initial=0)
        pieces = [self.positions[begin:end] for begin, end in itertools.pairwise(ends)]
        zeros = [np.zeros(len(piece)) for piece in pieces]
        return tuple(zip(self.variables, map(_as_slice, pieces), zeros, strict=True))


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
class Wiring:
    """Everything that moves inside one agent.

    Attributes:
        n_signals: length of the signal vector.
        owner: (n_signals,) component whose output a signal is; -1 for the mailbox and what comes from outside.
        mailbox: its place.
        external: of each value from outside, its place.
        propagate: outputs to inputs, ordered so that every output is read after the inputs that feed through to it.
            Empty unless the coupling is `joint`, the only one that evaluates outputs between steps.
        outputs: per component, GET of every output that some input is connected to.
        inputs: per component, SET of every connected input.
        listen: SET of every input that the mailbox or the outside feeds.
        sample: GET of what is published or recorded and not among `outputs`.
        published, recorded: positions of the published message, and of the recorded row, in the signals.
    """

    n_signals: int
    owner: Positions
    mailbox: MailboxLayout
    external: tuple[Positions, ...]
    propagate: tuple[Transfer, ...]
    outputs: tuple[tuple[Transfer, ...], ...]
    inputs: tuple[tuple[Transfer, ...], ...]
    listen: tuple[Transfer, ...]
    sample: tuple[Transfer, ...]
    published: Positions
    recorded: Positions

    def fill(self, signals: NDArray[np.float64], plan: AgentPlan) -> None:
        """At the start: no neighbour heard yet; weights, and values from outside, in place; all else stays zero."""
        signals[self.mailbox.stamp] = NEVER
        signals[self.mailbox.weight] = plan.weights
        for positions, external in zip(self.external, plan.external, strict=True):
            signals[positions] = external.start


def wire(plan: AgentPlan, layout: MessageLayout) -> Wiring:
    """The wiring of an agent.

    Raises:
        AlgebraicLoopError: `joint`, and direct feedthrough closes a loop; the message names the variables in it.
    """
    connected = _unique(connection.source for connection in plan.connections)
    sampled = _unique([*plan.publish, *(port for _, port in plan.record)])
    outputs = _unique([*connected, *sampled])

    where: dict[tuple[int, str], Positions] = {}
    owner: list[int] = []
    for port in outputs:
        where[_key(port)] = np.arange(len(owner), len(owner) + port.variable.size, dtype=np.int32)
        owner += [port.component] * port.variable.size
    mailbox = _mailbox_layout(len(plan.neighbours), layout, len(owner))
    owner += [-1] * (mailbox.values.size + 3 * len(plan.neighbours))
    external: list[Positions] = []
    for source in plan.external:
        external.append(np.arange(len(owner), len(owner) + len(source.start), dtype=np.int32))
        owner += [-1] * len(source.start)

    components = range(len(plan.components))
    joint = plan.coupling.method is Method.JOINT
    connected_keys = {_key(port) for port in connected}
    return Wiring(
        n_signals=len(owner),
        owner=np.array(owner, dtype=np.int32),
        mailbox=mailbox,
        external=tuple(external),
        propagate=_propagation(plan, where) if joint else (),
        outputs=tuple(_gets([p for p in connected if p.component == c], where) for c in components),
        inputs=tuple(
            _sets([(x.target, where[_key(x.source)]) for x in plan.connections if x.target.component == c])
            for c in components
        ),
        listen=_listen(plan, layout, mailbox, external),
        sample=tuple(
            transfer
            for c in components
            for transfer in _gets([p for p in sampled if p.component == c and _key(p) not in connected_keys], where)
        ),
        published=_concatenate(where[_key(port)] for port in plan.publish),
        recorded=_concatenate(where[_key(port)] for _, port in plan.record),
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
        key = (*map(id, parts), plan.coupling.method, len(plan.neighbours), external)
        if key not in self._known:
            self._known[key] = plan, wire(plan, self._layout)  # the plan stays alive, and with it its parts' identity
        return self._known[key][1]


def takes_in_event_mode(component: Component, inputs: Iterable[Transfer]) -> bool:
    """Whether a Co-Simulation component takes these inputs in Event Mode only: some of them are discrete."""
    return component.uses_events and any(not v.is_continuous for transfer in inputs for v in transfer.variables)


def _as_slice(positions: Positions) -> Positions | slice:
    """The same positions, as a slice if they can be."""
    n = len(positions)
    if n and np.array_equal(positions, np.arange(positions[0], positions[0] + n)):
        return slice(int(positions[0]), int(positions[0]) + n)
    return positions


def _key(port: Port) -> tuple[int, str]:
    return port.component, port.variable.name


def _unique(ports: Iterable[Port]) -> list[Port]:
    return list({_key(port): port for port in ports}.values())


def _concatenate(parts: Iterable[Positions]) -> Positions:
    return np.concatenate([np.empty(0, dtype=np.int32), *parts])


def _gets(ports: Sequence[Port], where: dict[tuple[int, str], Positions]) -> tuple[Transfer, ...]:
    """One transfer for ports of one component."""
    if not ports:
        return ()
    positions = _concatenate(where[_key(port)] for port in ports)
    return (Transfer(Direction.GET, ports[0].component, tuple(port.variable for port in ports), positions),)


def _sets(targets: Sequence[tuple[Port, Positions]]) -> tuple[Transfer, ...]:
    """One transfer for inputs of one component."""
    if not targets:
        return ()
    ports = [port for port, _ in targets]
    positions = _concatenate(position for _, position in targets)
    return (Transfer(Direction.SET, ports[0].component, tuple(port.variable for port in ports), positions),)


def _mailbox_layout(n: int, layout: MessageLayout, offset: int) -> MailboxLayout:
    """One block of n rows per message variable, as the inputs want them, then stamps, times and weights."""
    blocks = []
    for size in layout.sizes:
        blocks.append(np.arange(offset, offset + n * size, dtype=np.int32).reshape(n, size))
        offset += n * size
    stamp, time, weight = (np.arange(offset + i * n, offset + (i + 1) * n, dtype=np.int32) for i in range(3))
    values = np.concatenate([np.empty((n, 0), dtype=np.int32), *blocks], axis=1)
    return MailboxLayout(np.ascontiguousarray(values), stamp, time, weight)


def _listen(
    plan: AgentPlan, layout: MessageLayout, mailbox: MailboxLayout, external: Sequence[Positions]
) -> tuple[Transfer, ...]:
    """The inputs that the mailbox and the outside feed, grouped by component."""
    feeds = [
        (port, mailbox.values[:, layout.slices[name]].reshape(-1).astype(np.int32))
        for name, port in plan.mailbox.values.items()
    ]
    for special, positions in (
        (plan.mailbox.stamp, mailbox.stamp),
        (plan.mailbox.time, mailbox.time),
        (plan.mailbox.weight, mailbox.weight),
    ):
        if special is not None:
            feeds.append((special, positions))
    feeds += [(source.port, positions) for source, positions in zip(plan.external, external, strict=True)]
    feeds = [(port, positions) for port, positions in feeds if positions.size]
    return tuple(
        transfer
        for c in range(len(plan.components))
        for transfer in _sets([feed for feed in feeds if feed[0].component == c])
    )


def _propagation(plan: AgentPlan, where: dict[tuple[int, str], Positions]) -> tuple[Transfer, ...]:
    """Kahn's algorithm over outputs: read all outputs whose feeding inputs are set, set what they feed, repeat."""
    source_of = {_key(x.target): _key(x.source) for x in plan.connections}
    waiting = _unique(connection.source for connection in plan.connections)
    done: set[tuple[int, str]] = set()
    transfers: list[Transfer] = []
    components = range(len(plan.components))
    while waiting:
        ready = [port for port in waiting if all(key in done for key in _feeding(plan, port, source_of))]
        if not ready:
            raise AlgebraicLoopError(_loop_message(plan, waiting, done, source_of))
        for c in components:
            transfers += _gets([port for port in ready if port.component == c], where)
        now = {_key(port) for port in ready}
        for c in components:
            targets = [
                (x.target, where[_key(x.source)])
                for x in plan.connections
                if x.target.component == c and _key(x.source) in now
            ]
            transfers += _sets(targets)
        done |= now
        waiting = [port for port in waiting if _key(port) not in now]
    return tuple(transfers)


def _feeding(plan: AgentPlan, port: Port, source_of: dict[tuple[int, str], tuple[int, str]]) -> list[tuple[int, str]]:
    """The outputs that feed, through one connected input, straight through to this output."""
    inputs = port.variable.dependencies
    if inputs is None:  # the component does not say: assume all of them
        inputs = tuple(x.target.variable.name for x in plan.connections if x.target.component == port.component)
    keys = [(port.component, name) for name in inputs]
    return [source_of[key] for key in keys if key in source_of]


def _loop_message(
    plan: AgentPlan,
    waiting: Sequence[Port],
    done: set[tuple[int, str]],
    source_of: dict[tuple[int, str], tuple[int, str]],
) -> str:
    """Follow the unmet dependencies from any waiting output until one repeats: that is a loop."""
    by_key = {_key(port): port for port in waiting}
    path = [_key(waiting[0])]
    while path[-1] not in path[:-1]:
        path.append(next(key for key in _feeding(plan, by_key[path[-1]], source_of) if key not in done))
    loop = path[path.index(path[-1]) :]
    names = [f"{plan.components[c].name}.{name}" for c, name in reversed(loop)]
    return (
        f"an algebraic loop: {' -> '.join(names)}; each of these outputs depends directly on the one before it. "
        "Use `coupling: {method: midpoint}`, or break the loop with a component that has a state"
    )
