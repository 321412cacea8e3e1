"""What the control of steps watches (`cosim.agents.step_control`).

Where steps are made twice, that is all that changes continuously: outputs, whoever reads them, and those states that a
component tells of, as an error of one of them is seen in others later. Else it is what others read.

An output that depends directly on an input which is read before whoever gives it steps comes a step late. Its error is
of order h, not h^(p + 1), so it is not watched: who reads it integrates its error, and is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol

import numpy as np

from cosim.agents.transfers import Transfer
from cosim.agents.wiring import Wiring
from cosim.components.component import Description, Variable
from cosim.plan import CouplingPlan, Method


class Described(Protocol):
    """A component, or the plan of one."""

    @property
    def name(self) -> str: ...

    @property
    def description(self) -> Description: ...


def watched_outputs(
    wiring: Wiring, components: Sequence[Described], coupling: CouplingPlan
) -> tuple[dict[int, str], list[int]]:
    """The names of outputs and states by where they lie in the signals, and which of them are watched.

    Args:
        wiring: of the agent.
        components: of the agent.
        coupling: whose steps are controlled.
    """
    names: dict[int, str] = {}
    watched, connected = list[int](), list[int]()
    for c, component in enumerate(components):
        late = _read_late(wiring, c, component.description, jacobi=coupling.method is Method.JACOBI)
        states = component.description.states
        in_time, unknown = list[int](), list[int]()
        for variable, places in _variables((*wiring.outputs[c], *wiring.watch[c])):
            names |= _names(component.name, variable, places)
            if variable.name in states or late.isdisjoint(variable.dependencies or ()):
                known = not late or variable.name in states or variable.dependencies is not None
                (in_time if known else unknown).extend(places)
        read = [place for _, places in _variables(wiring.outputs[c]) for place in places]
        connected += read
        watched += in_time or ([] if read else unknown)
    return names, sorted(watched or connected)


def unwatched_readers(wiring: Wiring, components: Sequence[Described], coupling: CouplingPlan) -> list[str]:
    """The components that read others, where steps are made twice and yet the errors of none of them would be seen."""
    _, watched = watched_outputs(wiring, components, coupling)
    readers = [
        c
        for c in range(len(components))
        if any(np.any(wiring.owner[transfer.positions] >= 0) for transfer in wiring.inputs[c])
    ]
    seen = np.isin(wiring.owner[watched], readers).any()
    rollback = coupling.control is not None and coupling.control.rollback
    return [] if seen or not rollback else [components[c].name for c in readers]


def _read_late(wiring: Wiring, component: int, description: Description, *, jacobi: bool) -> set[str]:
    """The inputs of a component that are read before whoever gives them steps, named as dependencies name them."""
    read = [
        part.variable
        for transfer in wiring.inputs[component]
        for part in transfer.parts
        if np.any(wiring.owner[part.positions] >= (0 if jacobi else component + 1))
    ]
    names = {variable.name for variable in read}
    elements = {(variable.dtype, reference) for variable in read for reference in variable.references}
    return names | {  # arrays of which only elements are fed
        variable.name
        for variable in (description.own or description).variables.values()
        if not elements.isdisjoint((variable.dtype, reference) for reference in variable.references)
    }


def _variables(transfers: Iterable[Transfer]) -> Iterator[tuple[Variable, list[int]]]:
    """What is read, and where it lies in the signals."""
    for transfer in transfers:
        places = iter(transfer.positions.tolist())
        for variable in transfer.variables:
            yield variable, list(itertools.islice(places, variable.size))


def _names(component: str, variable: Variable, places: Sequence[int]) -> dict[int, str]:
    name = f"{component}.{variable.name}"
    return {place: name if variable.size == 1 else f"{name}[{i + 1}]" for i, place in enumerate(places)}
