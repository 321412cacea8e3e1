"""What native agents that are wired alike share: the calls of their FMUs, their transfers, and scratch memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.agents.crossings import chattering
from cosim.agents.transfers import Transfer
from cosim.agents.wiring import takes_in_event_mode
from cosim.components.component import Component, Interface, Variable
from cosim.errors import ComponentError, ConfigError, Problem
from cosim.kernel import layout
from cosim.kernel.layout import Reason
from cosim.plan import CouplingPlan

if TYPE_CHECKING:
    from cosim.agents.wiring import Wiring
    from cosim.components.fmu import FmuComponent, Native


class Kind:
    """Agents alike, as the kernel sees them.

    Args:
        wiring: of the agents.
        components: open FMUs of one of them, sized by their structural parameters.
        coupling: how they are coupled.

    Raises:
        ConfigError: a component is no FMU, or a connected variable holds no numbers.
    """

    def __init__(self, wiring: Wiring, components: Sequence[Component], coupling: CouplingPlan) -> None:
        fmus = only_fmus(components)
        if wiring.loops:
            message = f"the native loop solves no algebraic loop: {wiring.loops[0].names}"
            raise ConfigError([Problem(f"{message}; write `coupling: {{loop: python}}`")])
        self._wiring = wiring
        self._coupling = coupling
        self._calls = [_Calls(component) for component in fmus]
        self._transfers = _TransferTable(self._calls)
        self._memory: list[Any] = []
        self._tables: dict[tuple[int, int], tuple[Any, int]] = {}
        n, n_states = len(components), sum(component.n_states for component in components)
        n_indicators = sum(component.n_indicators for component in components)
        self._agent = layout.Agent(
            n_components=n,
            n_states=n_states,
            n_signals=wiring.n_signals,
            n_indicators=n_indicators,
            width=wiring.mailbox.values.shape[1],
            grid=coupling.grid,
            propagate=self._transfers.add([part for part in wiring.propagate if isinstance(part, Transfer)]),
            follow=self._transfers.add([part for part in wiring.follow if isinstance(part, Transfer)]),
            listen=self._transfers.add(wiring.listen),
            sample=self._transfers.add(wiring.sample),
            outputs=self._keep((layout.Transfers * n)(*map(self._transfers.add, wiring.outputs))),
            inputs=self._keep((layout.Transfers * n)(*map(self._transfers.add, wiring.inputs))),
            method=layout.METHODS.index(coupling.method),
            integrator=layout.INTEGRATORS.index(coupling.integrator),
            step_ns=coupling.step_ns,
            refinement=coupling.refinement,
            relative_tolerance=coupling.relative_tolerance,
            absolute_tolerance=coupling.absolute_tolerance,
            owner=self._keep(wiring.owner),
            continuous=self._keep(wiring.continuous),
            mailbox_values=self._keep(wiring.mailbox.values),
            mailbox_stamp=self._keep(wiring.mailbox.stamp),
            mailbox_time=self._keep(wiring.mailbox.time),
            before=self._keep(np.zeros(wiring.n_signals)),
            middle=self._keep(np.zeros(wiring.n_signals)),
            source=self._keep(np.zeros(wiring.n_signals)),
            states=self._keep(np.zeros(n_states)),
            new_states=self._keep(np.zeros(n_states)),
            stages=self._keep(np.zeros(layout.STAGES * n_states)),
            indicators=self._keep(np.zeros(4 * n_indicators)),
        )
        rows = self._transfers.rows
        self._agent.transfers = self._keep((layout.Transfer * len(rows))(*rows))
        self.address = ctypes.addressof(self._agent)
        """Of the kernel's `Agent`."""

    def rows(self, components: Sequence[FmuComponent]) -> Iterator[tuple[int | tuple[int, int], ...]]:
        """The kernel's `Component`, per component of an agent of this kind."""
        first_state = first_indicator = 0
        for c, component in enumerate(components):
            native = component.native()
            read = [self._wiring.owner[transfer.positions] for transfer in self._wiring.inputs[c]]
            reads_earlier = any(np.any((owners >= 0) & (owners < c)) for owners in read)
            functions = self._functions(c, native)
            sizes = (component.n_states, first_state, reads_earlier, component.n_indicators, first_indicator)
            events = component.uses_events, takes_in_event_mode(component, self._wiring.inputs[c])
            parts = self._coupling.parts_of(c), self._coupling.parts_of(c, halved=True)
            yield native.fmi, *sizes, *events, parts, native.instance, functions
            first_state += component.n_states
            first_indicator += component.n_indicators

    def failure(self, components: Sequence[FmuComponent]) -> ComponentError:
        """What the kernel noted of an agent of this kind, in the words of the Python loop and of `FmuComponent`."""
        failure = self._agent.failure
        index = int(failure.component)
        component = components[index]
        match failure.reason:
            case Reason.CALL_FAILED:
                return component.failure(self._calls[index].names[failure.call], failure.status)
            case Reason.STOP_REQUESTED:
                return component.stop_requested()
            case Reason.EARLY_RETURN:
                return component.early_return(failure.value)
            case Reason.OUTPUT_NOT_FINITE:
                name = self._transfers.variable(failure.transfer, failure.index).name
                return ComponentError(component.name, f"output {name} is not finite")
            case Reason.STATE_NOT_FINITE:
                return ComponentError(component.name, f"continuous state {failure.index + 1} is not finite")
            case Reason.EVENTS_UNSETTLED:
                from cosim.agents.coupling import EVENT_ITERATIONS

                message = f"the event iteration did not settle within {EVENT_ITERATIONS} rounds"
                return ComponentError(component.name, message)
            case Reason.DISCRETE_STATES_UNSETTLED:
                return component.unsettled()
            case Reason.INDICATOR_NAN:
                return ComponentError(component.name, f"event indicator {failure.index + 1} is not a number")
            case Reason.TOO_MANY_EVENTS:
                return component.too_many_events()
            case Reason.CHATTERING:
                return ComponentError(component.name, chattering(self._agent.step_ns))
            case _:
                return ComponentError(
                    component.name,
                    f"the step size fell below {failure.value:.3g} s without meeting the tolerances; "
                    "loosen relative_tolerance or absolute_tolerance, or look for a discontinuity",
                )

    def _functions(self, c: int, native: Native) -> int:
        """The address of a component's function pointers, of which there is one table per library."""
        key = c, id(native.library)
        if key not in self._tables:
            table = self._calls[c].addresses(native)
            self._tables[key] = native.library, self._keep(table)
        return self._tables[key][1]

    def _keep(self, memory: Any) -> int:
        """The address of memory, which then lives as long as the kind."""
        self._memory.append(memory)
        return memory.ctypes.data if isinstance(memory, np.ndarray) else ctypes.addressof(memory)


def only_fmus(components: Sequence[Component]) -> list[FmuComponent]:
    """The same components.

    Raises:
        ConfigError: there are others than FMUs among them.
    """
    from cosim.components.fmu import FmuComponent

    fmus = [component for component in components if isinstance(component, FmuComponent)]
    if len(fmus) != len(components):
        message = "the native loop serves agents made of FMUs alone; write `coupling: {loop: python}`"
        raise ConfigError([Problem(message)])
    return fmus


class _Calls:
    """The FMI functions of one component that the kernel may call: name by call number."""

    def __init__(self, component: FmuComponent) -> None:
        self.native = native = component.native()
        if component.interface is Interface.MODEL_EXCHANGE:
            self.names = dict(enumerate(layout.MODEL_EXCHANGE_CALLS[native.fmi]))
        else:
            self.names = {layout.DO_STEP: f"fmi{native.fmi}DoStep"}
        if component.uses_events:
            self.names |= layout.CO_SIMULATION_EVENT_CALLS

    def storage(self, variable: Variable) -> str:
        """Which of `layout.TYPES` holds the variable's values."""
        dtype = variable.dtype
        if dtype == "Enumeration":
            return "Int32" if self.native.fmi == 2 else "Int64"
        if dtype not in layout.TYPES:
            message = f"{variable.name} is of type {dtype}: it holds no numbers and can be neither connected nor read"
            raise ConfigError([Problem(message)])
        return "Fmi2Boolean" if self.native.fmi == 2 and dtype == "Boolean" else dtype

    def access(self, dtype: str, *, to_component: bool) -> None:
        """Ask for the getter or setter of a type."""
        number = (layout.SET_VALUES if to_component else layout.GET_VALUES) + layout.TYPES.index(dtype)
        suffix = layout.FMI2_TYPES[dtype] if self.native.fmi == 2 else dtype
        self.names[number] = f"fmi{self.native.fmi}{'Set' if to_component else 'Get'}{suffix}"

    def addresses(self, native: Native) -> ctypes.Array[ctypes.c_void_p]:
        """The table of function pointers of an instance's library, null where a function is not needed."""
        table = (ctypes.c_void_p * layout.N_CALLS)()
        for number, name in self.names.items():
            table[number] = native.address(name)
        return table


class _TransferTable:
    """The transfers of a wiring as the kernel wants them: in one table, every row with values of one type."""

    def __init__(self, calls: Sequence[_Calls]) -> None:
        self._calls = calls
        self._variables: list[list[Variable]] = []
        self._memory: list[Any] = []
        self.rows: list[layout.Transfer] = []

    def variable(self, row: int, index: int) -> Variable:
        """The variable that the value at `index` of a row belongs to."""
        return [v for v in self._variables[row] for _ in range(v.size)][index]

    def add(self, transfers: Sequence[Transfer]) -> layout.Transfers:
        """Append transfers; the rows that they became."""
        first = len(self.rows)
        for transfer in transfers:
            calls = self._calls[transfer.component]
            offset = 0
            for dtype, group in groupby(transfer.variables, calls.storage):
                variables = [variable for variable in group if variable.size]
                size = sum(variable.size for variable in variables)
                if size:
                    self._add(transfer, dtype, variables, slice(offset, offset + size))
                offset += size
        return layout.Transfers(first, len(self.rows))

    def _add(self, transfer: Transfer, dtype: str, variables: list[Variable], where: slice) -> None:
        to_component = bool(transfer.direction)
        positions = transfer.positions[where]
        self._calls[transfer.component].access(dtype, to_component=to_component)
        references = np.array([reference for v in variables for reference in v.references], dtype=np.uint32)
        buffer = np.zeros(positions.size)  # no type is wider
        gains, offsets = (x[where] for x in transfer.scales) if transfer.scales else (None, None)
        self._memory += [references, positions, buffer, gains, offsets]
        self._variables.append(variables)
        self.rows.append(
            layout.Transfer(
                component=transfer.component,
                to_component=to_component,
                type=layout.TYPES.index(dtype),
                n_references=references.size,
                n_values=positions.size,
                begin=positions[0] if gains is None and np.all(np.diff(positions) == 1) else -1,
                references=references.ctypes.data,
                positions=positions.ctypes.data,
                buffer=buffer.ctypes.data,
                gains=None if gains is None else gains.ctypes.data,
                offsets=None if offsets is None else offsets.ctypes.data,
            )
        )
