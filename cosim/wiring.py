"""The signals of one agent: which values move between its components and its mailbox, and in which order.

All values live in one flat vector, the signals: first the outputs of the components that somebody reads, then the
mailbox, then what comes from outside. A `Transfer` moves values between that vector and one component. Both micro-step
loops, the Python one and the native one, carry out the same transfers.
"""

from __future__ import annotations

import itertools
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Component, Element, Variable
from cosim.components.presented import Scales, pieces
from cosim.plan import AgentPlan, Method, Port
from network.messages import NEVER, MessageLayout

Positions = NDArray[np.int32]
_Key = tuple[int, str, str | None]


class AlgebraicLoopError(ValueError):
    """Outputs and inputs feed each other directly, with no state in between, and cannot be solved."""


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
        scales: (total size,) each, of the values on their way; None where they pass as they are.
    """

    direction: Direction
    component: int
    variables: tuple[Variable, ...]
    positions: Positions
    scales: Scales | None = None

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Variable by variable."""
        ends = itertools.accumulate((variable.size for variable in self.variables), initial=0)
        ranges = [slice(begin, end) for begin, end in itertools.pairwise(ends)]
        return tuple(
            Part(
                variable,
                _as_slice(self.positions[where]),
                np.zeros(variable.size),
                None if self.scales is None else Scales(self.scales.gains[where], self.scales.offsets[where]),
            )
            for variable, where in zip(self.variables, ranges, strict=True)
        )


class Part(NamedTuple):
    """One variable of a transfer, where its values lie (as a slice if they can be), as many zeros, and their scales."""

    variable: Variable
    positions: Positions | slice
    zeros: NDArray[np.float64]
    scales: Scales | None


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
class Wiring:
    """Everything that moves inside one agent.

    Attributes:
        n_signals: length of the signal vector.
        owner: (n_signals,) component whose output a signal is; -1 for the mailbox and what comes from outside.
        mailbox: its place.
        external: of each value from outside, its place.
        held: GET of arrays of which only some elements are fed: the others keep what they have at the start.
        propagate: outputs to inputs, ordered so that every output is read after the inputs that feed through to it;
            outputs that feed each other are solved together. Empty unless the coupling is `joint`, the only one that
            evaluates outputs between steps.
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
    held: tuple[Transfer, ...]
    propagate: tuple[Transfer | AlgebraicLoop, ...]
    outputs: tuple[tuple[Transfer, ...], ...]
    inputs: tuple[tuple[Transfer, ...], ...]
    listen: tuple[Transfer, ...]
    sample: tuple[Transfer, ...]
    published: Positions
    recorded: Positions

    @property
    def loops(self) -> tuple[AlgebraicLoop, ...]:
        """The algebraic loops among what is propagated."""
        return tuple(part for part in self.propagate if isinstance(part, AlgebraicLoop))

    def fill(self, signals: NDArray[np.float64], plan: AgentPlan) -> None:
        """At the start: no neighbour heard yet; weights, and values from outside, in place; all else stays zero."""
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
    connected = _unique(connection.source for connection in plan.connections)
    sampled = _unique([*plan.publish, *(port for _, port in plan.record)])
    outputs = _unique([*connected, *sampled])

    places = _Places()
    for port in outputs:
        places.add_output(port)
    mailbox = _mailbox_layout(len(plan.neighbours), layout, places.n)
    places.skip(mailbox.values.size + 3 * len(plan.neighbours))
    external = [places.skip(len(source.start)) for source in plan.external]
    connections = [(x.target, places.of(x.source)) for x in plan.connections]
    heard = _heard(plan, layout, mailbox, external)
    inputs = _Inputs([*connections, *heard], places)

    components = range(len(plan.components))
    joint = plan.coupling.method is Method.JOINT
    connected_keys = {_key(port) for port in connected}
    return Wiring(
        n_signals=places.n,
        owner=np.array(places.owner, dtype=np.int32),
        mailbox=mailbox,
        external=tuple(external),
        held=inputs.held,
        propagate=_propagation(plan, places, inputs) if joint else (),
        outputs=tuple(places.gets([p for p in connected if p.component == c]) for c in components),
        inputs=tuple(inputs.sets(feed[0] for feed in connections if feed[0].component == c) for c in components),
        listen=tuple(
            transfer for c in components for transfer in inputs.sets(port for port, _ in heard if port.component == c)
        ),
        sample=tuple(
            transfer
            for c in components
            for transfer in places.gets([p for p in sampled if p.component == c and _key(p) not in connected_keys])
        ),
        published=_concatenate(places.of(port) for port in plan.publish),
        recorded=_concatenate(places.of(port) for _, port in plan.record),
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


def _key(port: Port) -> _Key:
    """A variable may be published in another unit than it has inside the agent."""
    return port.component, port.variable.name, port.variable.unit


def _unique(ports: Iterable[Port]) -> list[Port]:
    return list({_key(port): port for port in ports}.values())


def _concatenate(parts: Iterable[Positions]) -> Positions:
    return np.concatenate([np.empty(0, dtype=np.int32), *parts])


@dataclass(frozen=True)
class _Move:
    """The values of one of a component's own variables, and where they lie in the signals."""

    variable: Variable
    positions: Positions
    scales: Scales | None = None


def _transfers(direction: Direction, component: int, moves: Sequence[_Move]) -> tuple[Transfer, ...]:
    """One transfer for variables of one component."""
    if not moves:
        return ()
    variables, positions = tuple(move.variable for move in moves), _concatenate(move.positions for move in moves)
    if all(move.scales is None for move in moves):
        return (Transfer(direction, component, variables, positions),)
    scales = [move.scales or Scales(np.ones(move.variable.size), np.zeros(move.variable.size)) for move in moves]
    gains, offsets = (np.concatenate(arrays) for arrays in zip(*scales, strict=True))
    return (Transfer(direction, component, variables, positions, Scales(gains, offsets)),)


class _Places:
    """Where values lie in the signals, and what must be read to fill them.

    Attributes:
        owner: see `Wiring`.
    """

    def __init__(self) -> None:
        self.owner: list[int] = []
        self._of: dict[_Key, Positions] = {}
        self._moves: dict[_Key, list[_Move]] = {}

    @property
    def n(self) -> int:
        """How many signals there are so far."""
        return len(self.owner)

    def skip(self, size: int, owner: int = -1) -> Positions:
        """The next places."""
        first = self.n
        self.owner += [owner] * size
        return np.arange(first, first + size, dtype=np.int32)

    def add_output(self, port: Port) -> None:
        """Places for an output; of a mapped one, for all numbers of the own variables that it stands for."""
        key, variable = _key(port), port.variable
        if variable.elements is None:
            self._of[key] = self.skip(variable.size, port.component)
            self._moves[key] = [_Move(variable, self._of[key])]
            return
        positions = np.empty(variable.size, dtype=np.int32)
        self._moves[key] = []
        for piece in pieces(variable.elements):
            places = self.skip(piece.own.size, port.component)
            wanted = piece.places >= 0
            positions[piece.places[wanted]] = places[wanted]
            self._moves[key].append(_Move(piece.own, places, piece.scales))
        self._of[key] = positions

    def of(self, port: Port) -> Positions:
        """Where the values of an output lie."""
        return self._of[_key(port)]

    def gets(self, ports: Sequence[Port]) -> tuple[Transfer, ...]:
        """What reads outputs of one component."""
        moves = [move for port in ports for move in self._moves[_key(port)]]
        return _transfers(Direction.GET, ports[0].component, moves) if ports else ()


class _Inputs:
    """What sets the inputs that something feeds.

    An array is set as a whole, whichever of its elements is new; elements that nothing feeds keep what they have when
    the run starts.

    Args:
        feeds: inputs, and where what they take lies in the signals.
        places: takes room for the elements that nothing feeds.
    """

    def __init__(self, feeds: Sequence[tuple[Port, Positions]], places: _Places) -> None:
        self._moves: dict[tuple[int, str], _Move] = {}
        self._behind: dict[tuple[int, str], list[str]] = {}
        fed: dict[int, tuple[list[Element], list[Positions]]] = {}
        for port, positions in feeds:
            if port.variable.elements is None:
                self._behind[_target(port)] = [port.variable.name]
                self._moves[_target(port)] = _Move(port.variable, positions)
                continue
            elements, sources = fed.setdefault(port.component, ([], []))
            elements += port.variable.elements
            sources.append(positions)
            self._behind[_target(port)] = list(dict.fromkeys(x.variable.name for x in port.variable.elements))
        held: dict[int, list[_Move]] = {}
        for component, (elements, sources) in fed.items():
            source = _concatenate(sources)
            for piece in pieces(elements):
                positions = source[piece.places]
                if (piece.places < 0).any():
                    image = places.skip(piece.own.size)
                    held.setdefault(component, []).append(_Move(piece.own, image))
                    positions = np.where(piece.places < 0, image, positions)
                move = _Move(piece.own, positions.astype(np.int32), piece.scales)
                self._moves[component, piece.own.name] = move
        self.held = tuple(transfer for c in sorted(held) for transfer in _transfers(Direction.GET, c, held[c]))

    def sets(self, ports: Iterable[Port]) -> tuple[Transfer, ...]:
        """What sets inputs of one component."""
        keys = {(port.component, name): None for port in ports for name in self._behind[_target(port)]}
        return _transfers(Direction.SET, next(iter(keys))[0], [self._moves[key] for key in keys]) if keys else ()


def _target(port: Port) -> tuple[int, str]:
    return port.component, port.variable.name


def _mailbox_layout(n: int, layout: MessageLayout, offset: int) -> MailboxLayout:
    """One block of n rows per message variable, as the inputs want them, then stamps, times and weights."""
    blocks = []
    for size in layout.sizes:
        blocks.append(np.arange(offset, offset + n * size, dtype=np.int32).reshape(n, size))
        offset += n * size
    stamp, time, weight = (np.arange(offset + i * n, offset + (i + 1) * n, dtype=np.int32) for i in range(3))
    values = np.concatenate([np.empty((n, 0), dtype=np.int32), *blocks], axis=1)
    return MailboxLayout(np.ascontiguousarray(values), stamp, time, weight)


def _heard(
    plan: AgentPlan, layout: MessageLayout, mailbox: MailboxLayout, external: Sequence[Positions]
) -> list[tuple[Port, Positions]]:
    """The inputs that the mailbox and the outside feed, and where what they take lies."""
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
    return [(port, positions) for port, positions in feeds if positions.size]


def _propagation(plan: AgentPlan, places: _Places, inputs: _Inputs) -> tuple[Transfer | AlgebraicLoop, ...]:
    """Kahn's algorithm over outputs: read all outputs whose feeding inputs are set, set what they feed, repeat.

    Where none is left of these, some feed each other: such a loop is solved as a whole, and counts as read.
    """
    source_of = {_target(x.target): _key(x.source) for x in plan.connections}
    waiting = _unique(connection.source for connection in plan.connections)
    done: set[_Key] = set()
    parts: list[Transfer | AlgebraicLoop] = []
    components = range(len(plan.components))

    def gets(ports: Sequence[Port]) -> Iterator[Transfer]:
        for c in components:
            yield from places.gets([port for port in ports if port.component == c])

    def sets(sources: Container[_Key]) -> Iterator[Transfer]:
        for c in components:
            yield from inputs.sets(
                x.target for x in plan.connections if x.target.component == c and _key(x.source) in sources
            )

    while waiting:
        feeding = {_key(port): [key for key in _feeding(plan, port, source_of) if key not in done] for port in waiting}
        ready = [port for port in waiting if not feeding[_key(port)]]
        if ready:
            parts += gets(ready)
            parts += sets({_key(port) for port in ready})
        else:
            members = _first_loop(feeding)
            ready = [port for port in waiting if _key(port) in members]
            names = _loop_names(plan, feeding, members)
            if any(not port.variable.dtype.startswith("Float") for port in ready):
                raise AlgebraicLoopError(
                    f"an algebraic loop: {names}; each of these outputs depends directly on the one before it, and not "
                    "all of them are real numbers, so that it cannot be solved. Use `coupling: {method: midpoint}`, or "
                    "break the loop with a component that has a state"
                )
            positions = _concatenate(places.of(port) for port in ready)
            parts.append(AlgebraicLoop(names, ready[0].component, tuple(sets(members)), tuple(gets(ready)), positions))
        done |= {_key(port) for port in ready}
        waiting = [port for port in waiting if _key(port) not in done]
    return tuple(parts)


def _first_loop(feeding: Mapping[_Key, Sequence[_Key]]) -> frozenset[_Key]:
    """Outputs that all feed each other, if only through others, and that nothing else still waiting feeds."""
    reached = {key: _reached(feeding, key) for key in feeding}
    return min((others for key, others in reached.items() if key in others), key=len)


def _reached(feeding: Mapping[_Key, Sequence[_Key]], key: _Key) -> frozenset[_Key]:
    """What feeds an output, directly or not."""
    found: set[_Key] = set()
    ahead = list(feeding[key])
    while ahead:
        if (other := ahead.pop()) not in found:
            found.add(other)
            ahead += feeding[other]
    return frozenset(found)


def _feeding(plan: AgentPlan, port: Port, source_of: dict[tuple[int, str], _Key]) -> list[_Key]:
    """The outputs that feed, through one connected input, straight through to this output."""
    inputs = port.variable.dependencies
    if inputs is None:  # the component does not say: assume all of them
        inputs = tuple(x.target.variable.name for x in plan.connections if x.target.component == port.component)
    keys = [(port.component, name) for name in inputs]
    return [source_of[key] for key in keys if key in source_of]


def _loop_names(plan: AgentPlan, feeding: Mapping[_Key, Sequence[_Key]], members: Container[_Key]) -> str:
    """Follow what feeds an output of a loop until one repeats."""
    path = [next(key for key in feeding if key in members)]
    while path[-1] not in path[:-1]:
        path.append(next(key for key in feeding[path[-1]] if key in members))
    loop = path[path.index(path[-1]) :]
    return " -> ".join(f"{plan.components[c].name}.{name}" for c, name, _ in reversed(loop))
