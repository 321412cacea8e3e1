"""The micro-step loop in C, for agents whose components are all FMUs: one call per tick for all of them.

The library calls the FMUs' functions directly and gives the same bits as `cosim.agents.mailbox` with
`cosim.agents.coupling.PythonLoop`. It is called without Python's global lock.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cosim.attention import idle
from cosim.components.component import Component
from cosim.errors import ComponentError
from cosim.kernel import layout
from cosim.kernel.kind import Kind, only_fmus
from cosim.plan import CouplingPlan
from network.units import to_seconds

if TYPE_CHECKING:
    from cosim.agents.memory import LoopMemory
    from cosim.agents.wiring import Wiring
    from network.messages import Floats, Ints, Mail

_LATEST_NS = 2**53
"""Up to here (104 days) a time in nanoseconds is exact as a float64, as the kernel needs it."""

_NOTHING: NDArray[np.int64] = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Member:
    """A native agent.

    Attributes:
        index: among the agents that get the mail, and whose memory it is.
        components: open FMUs, sized by their structural parameters.
    """

    index: int
    wiring: Wiring
    components: Sequence[Component]
    coupling: CouplingPlan


@dataclass(frozen=True)
class Failed:
    """The first member that failed at a tick."""

    index: int
    error: ComponentError


class NativeBlock:
    """Advances agents as `Agent.advance` does, on the same memory; it is `Agent` that initialises them.

    Args:
        members: in ascending order of their index.
        memory: of these and possibly other agents.
        period_ns: T.
        samples: indices into the signals of what is taken of all agents at a tick, to be published.
        row: likewise, to be recorded.
        attended: kept up to date; see `cosim.attention`.

    Raises:
        ConfigError: the library is missing, a component is no FMU, or a connected variable holds no numbers.
    """

    def __init__(  # noqa: PLR0917
        self,
        members: Sequence[Member],
        memory: LoopMemory,
        period_ns: int,
        samples: Ints = _NOTHING,
        row: Ints = _NOTHING,
        attended: Ints | None = None,
    ) -> None:
        self._advance = layout.library().cosim_kernel_advance
        self._memory = memory
        self._period_ns = period_ns
        self._indices = [member.index for member in members]
        self._fmus = [only_fmus(member.components) for member in members]
        self._kinds = _kinds(members)
        self._over = False
        components = [row for kind, fmus in zip(self._kinds, self._fmus, strict=True) for row in kind.rows(fmus)]
        self._components = np.array(components, np.dtype(layout.Component))
        self._members = self._table()
        self._attended = idle() if attended is None else attended
        self._selected = [_plain(places.ravel(), np.int64) for places in (samples, row)]
        self._block = layout.Block(
            len(members),
            len(memory.time),
            period_ns,
            *(array.ctypes.data for array in (self._members, self._attended, memory.signals)),
            *(layout.Selection(len(places), places.ctypes.data) for places in self._selected),
        )
        self._address = ctypes.addressof(self._block)

    def advance(
        self, tick: int, n_ticks: int, mail: Mail, samples: Floats | None = None, rows: Floats | None = None
    ) -> tuple[int, Failed | None]:
        """From `tick` over some periods; the first failure ends it, and members after that one stay where they are.

        Args:
            tick: the one at which the agents are.
            n_ticks: how many periods.
            mail: of all agents whose memory it is, tick by tick.
            samples: (n_ticks, …) takes what is published at the end of every period.
            rows: (n_ticks, …) likewise, what is recorded.

        Returns:
            How many periods all members have advanced, and what ended it.
        """
        if self._over:
            raise ValueError("a member has failed or ended")
        if (tick + n_ticks) * self._period_ns > _LATEST_NS:
            text = f"the native loop counts time up to {to_seconds(_LATEST_NS):.0f} s; use `coupling: {{loop: python}}`"
            return 0, self._failed(0, ComponentError(self._fmus[0][0].name, text))
        columns = [_plain(column, np.int64) for column in (mail.ends, mail.arrival_ns, mail.slot, mail.stamp)]
        columns.append(_plain(mail.values, np.float64))
        arguments = layout.Mail(*map(_address, columns))
        taken = (None if array is None else _address(array) for array in (samples, rows))
        advanced = self._advance(self._address, tick, n_ticks, ctypes.addressof(arguments), *taken)
        if advanced == n_ticks:
            return n_ticks, None
        failed = self._block.failed
        return advanced, self._failed(failed, self._kinds[failed].failure(self._fmus[failed]))

    def end(self) -> None:
        """The instances are about to be freed: refuse to advance them any further."""
        self._over = True

    def _failed(self, member: int, error: ComponentError) -> Failed:
        self._over = True
        return Failed(self._indices[member], error)

    def _table(self) -> np.ndarray[Any, Any]:
        """The kernel's `Member`s."""
        memory, indices = self._memory, np.array(self._indices, np.int64)
        first_component = np.cumsum([0, *map(len, self._fmus)])[:-1]
        table = np.zeros(len(indices), np.dtype(layout.Member))
        table["agent"] = [kind.address for kind in self._kinds]
        table["components"] = _addresses(self._components, first_component)
        table["signals"] = _addresses(memory.signals, memory.first_signal[indices])
        table["previous"] = _addresses(memory.previous, memory.first_signal[indices])
        table["steps"] = _addresses(memory.steps, indices)
        table["next_event"] = _addresses(memory.next_event, memory.first_component[indices])
        table["time"] = _addresses(memory.time, indices)
        table["place"] = indices
        return table


def _kinds(members: Sequence[Member]) -> list[Kind]:
    """The kind of every member; members that share their wiring share it."""
    known: dict[tuple[object, ...], Kind] = {}
    kinds = []
    for member in members:
        sizes = ((component.n_states, component.n_indicators) for component in member.components)
        key = (id(member.wiring), member.coupling, *sizes)
        if key not in known:
            known[key] = Kind(member.wiring, member.components, member.coupling)
        kinds.append(known[key])
    return kinds


def _addresses(array: np.ndarray[Any, Any], rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Of rows of an array."""
    return array.ctypes.data + rows * array.strides[0]


def _address(array: np.ndarray[Any, Any]) -> int:
    """Of the first number; five of them are wanted at every tick, and `array.ctypes.data` costs a microsecond each."""
    if not array.size:
        return 0
    return ctypes.addressof(ctypes.c_char.from_buffer(array.data)) if array.flags.writeable else array.ctypes.data


def _plain(array: np.ndarray[Any, Any], dtype: Any) -> np.ndarray[Any, Any]:
    """The array as C wants it; not copied if it is so already."""
    flags = array.flags
    if array.dtype == dtype and flags.c_contiguous and flags.aligned:
        return array
    return np.require(array, dtype, ("C", "A"))
