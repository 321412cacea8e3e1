"""The start of an agent: in Initialization Mode, outputs go to inputs until both agree.

Outputs may depend there on inputs that they do not depend on later, as start values of states do, and no order is
declared for that which all FMUs give. So they are carried over again and again, as often as there are components. Those
that still change then feed each other, and Newton's method solves for all of them together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.agents.algebraic import Solver, UnsolvedError, close
from cosim.agents.transfers import Transfer
from cosim.agents.wiring import Wiring
from cosim.components.component import Component, Floats
from cosim.errors import ComponentError

CarryOut = Callable[[Sequence[Transfer]], None]


def settle(wiring: Wiring, components: Sequence[Component], signals: Floats, carry_out: CarryOut) -> None:
    """Bring outputs and inputs to agree.

    Args:
        wiring: of the agent.
        components: in Initialization Mode.
        signals: take the outputs.
        carry_out: makes transfers between the two.

    Raises:
        ComponentError: a component failed, or outputs that feed each other have no solution.
    """
    for gets in wiring.outputs:
        carry_out(gets)
    first = before = signals.copy()
    for _ in components:
        before = signals.copy()
        for sets, gets in zip(wiring.inputs, wiring.outputs, strict=True):
            carry_out(sets)
            carry_out(gets)
    moving = wiring.continuous & ~close(signals, before)
    if not moving.any():
        return
    positions = np.flatnonzero(moving)  # what does not change now does not depend on them

    def outputs(y: Floats) -> Floats:
        signals[positions] = y
        for sets in wiring.inputs:
            carry_out(sets)
        for gets in wiring.outputs:
            carry_out(gets)
        return signals[positions]

    try:
        signals[positions] = Solver(len(positions)).solve(outputs, first[positions])
    except UnsolvedError as error:
        names = ", ".join(_names(wiring, components, moving))
        raise ComponentError(
            components[wiring.owner[np.argmax(moving)]].name,
            f"at the start, the outputs {names} depend on each other, and that {error}",
        ) from None
    for sets in wiring.inputs:  # outputs that are not continuous may have followed
        carry_out(sets)


def _names(wiring: Wiring, components: Sequence[Component], chosen: NDArray[np.bool_]) -> Iterator[str]:
    """Of outputs."""
    for component, gets in zip(components, wiring.outputs, strict=True):
        for part in (part for transfer in gets for part in transfer.parts):
            if np.any(chosen[part.positions]):
                yield f"{component.name}.{part.variable.name}"
