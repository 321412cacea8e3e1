"""What moves between the components of an agent and its signals, and where in the signals it lies.

A mapped variable stands for elements of a component's own variables: here, and only here, the ones become the others.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.components.component import Element, Variable
from cosim.components.presented import Scales, pieces, read_back
from cosim.plan import Port

Positions = NDArray[np.int32]
Key = tuple[int, str, str | None]
"""Component, variable and unit of an output."""


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
                None if self.scales is None else Scales(self.scales.gains[where], self.scales.offsets[where]),
            )
            for variable, where in zip(self.variables, ranges, strict=True)
        )


class Part(NamedTuple):
    """One variable of a transfer, where its values lie (as a slice if they can be), and their scales."""

    variable: Variable
    positions: Positions | slice
    scales: Scales | None


def _as_slice(positions: Positions) -> Positions | slice:
    """The same positions, as a slice if they can be."""
    n = len(positions)
    if n and np.array_equal(positions, np.arange(positions[0], positions[0] + n)):
        return slice(int(positions[0]), int(positions[0]) + n)
    return positions


def key_of(port: Port) -> Key:
    """Of an output; it may be published in another unit than it has inside the agent."""
    return port.component, port.variable.name, port.variable.unit


def unique(ports: Iterable[Port]) -> list[Port]:
    """Each output once."""
    return list({key_of(port): port for port in ports}.values())


def concatenate(parts: Iterable[Positions]) -> Positions:
    """Of no parts as well."""
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
    variables, positions = tuple(move.variable for move in moves), concatenate(move.positions for move in moves)
    if all(move.scales is None for move in moves):
        return (Transfer(direction, component, variables, positions),)
    scales = [move.scales or Scales(np.ones(move.variable.size), np.zeros(move.variable.size)) for move in moves]
    gains, offsets = (np.concatenate(arrays) for arrays in zip(*scales, strict=True))
    return (Transfer(direction, component, variables, positions, Scales(gains, offsets)),)


class Places:
    """Where values lie in the signals, and what must be read to fill them.

    Attributes:
        owner, continuous: see `Wiring`.
    """

    def __init__(self) -> None:
        self.owner: list[int] = []
        self.continuous: list[bool] = []
        self._of: dict[Key, Positions] = {}
        self._moves: dict[Key, list[_Move]] = {}

    @property
    def n(self) -> int:
        """How many signals there are so far."""
        return len(self.owner)

    def skip(self, size: int) -> Positions:
        """The next places, of what is no output."""
        return self._take(size, -1, continuous=False)

    def _take(self, size: int, owner: int, *, continuous: bool) -> Positions:
        first = self.n
        self.owner += [owner] * size
        self.continuous += [continuous] * size
        return np.arange(first, first + size, dtype=np.int32)

    def add_output(self, port: Port) -> None:
        """Places for what is read; of a mapped variable, for all numbers of the own variables that it stands for."""
        key, variable = key_of(port), port.variable
        if variable.elements is None:
            self._of[key] = self._take(variable.size, port.component, continuous=variable.is_continuous)
            self._moves[key] = [_Move(variable, self._of[key])]
            return
        positions = np.empty(variable.size, dtype=np.int32)
        self._moves[key] = []
        for piece in pieces(read_back(variable)):
            places = self._take(piece.own.size, port.component, continuous=piece.own.is_continuous)
            wanted = piece.places >= 0
            positions[piece.places[wanted]] = places[wanted]
            self._moves[key].append(_Move(piece.own, places, piece.scales))
        self._of[key] = positions

    def of(self, port: Port) -> Positions:
        """Where the values of an output lie."""
        return self._of[key_of(port)]

    def gets(self, ports: Sequence[Port]) -> tuple[Transfer, ...]:
        """What reads outputs of one component."""
        moves = [move for port in ports for move in self._moves[key_of(port)]]
        return _transfers(Direction.GET, ports[0].component, moves) if ports else ()


class Inputs:
    """What sets the inputs that something feeds.

    An array is set as a whole, whichever of its elements is new; elements that nothing feeds keep what they have when
    the run starts.

    Args:
        feeds: inputs, and where what they take lies in the signals.
        places: takes room for the elements that nothing feeds.
    """

    def __init__(self, feeds: Sequence[tuple[Port, Positions]], places: Places) -> None:
        self._moves: dict[tuple[int, str], _Move] = {}
        self._behind: dict[tuple[int, str], list[str]] = {}
        fed: dict[int, tuple[list[Element], list[Positions]]] = {}
        for port, positions in feeds:
            if port.variable.elements is None:
                self._behind[target_of(port)] = [port.variable.name]
                self._moves[target_of(port)] = _Move(port.variable, positions)
                continue
            elements, sources = fed.setdefault(port.component, ([], []))
            elements += port.variable.elements
            sources.append(positions)
            self._behind[target_of(port)] = list(dict.fromkeys(x.variable.name for x in port.variable.elements))
        held: dict[int, list[_Move]] = {}
        for component, (elements, sources) in fed.items():
            source = concatenate(sources)
            for piece in pieces(elements):
                positions = source[piece.places]
                if (piece.places < 0).any():
                    image = places.skip(piece.own.size)
                    held.setdefault(component, []).append(_Move(piece.own, image))
                    positions = np.where(piece.places < 0, image, positions)
                move = _Move(piece.own, positions.astype(np.int32), piece.scales)
                self._moves[component, piece.own.name] = move
        self.held = tuple(transfer for c in sorted(held) for transfer in _transfers(Direction.GET, c, held[c]))

    def sets(self, ports: Iterable[Port], *, continuous: bool = False) -> tuple[Transfer, ...]:
        """What sets inputs of one component; only those that may change between events, if wanted."""
        keys = {key: None for port in ports for key in self._keys(port, continuous=continuous)}
        return _transfers(Direction.SET, next(iter(keys))[0], [self._moves[key] for key in keys]) if keys else ()

    def follows(self, port: Port) -> bool:
        """Whether anything behind an input may change between events."""
        return bool(self._keys(port, continuous=True))

    def _keys(self, port: Port, *, continuous: bool) -> list[tuple[int, str]]:
        keys = [(port.component, name) for name in self._behind[target_of(port)]]
        return [key for key in keys if not continuous or self._moves[key].variable.is_continuous]


def target_of(port: Port) -> tuple[int, str]:
    """Component and variable of an input."""
    return port.component, port.variable.name
