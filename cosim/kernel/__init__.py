"""The micro-step loop in C, for agents whose components are all FMUs: one call per agent and tick.

The library calls the FMUs' functions directly and gives the same bits as `cosim.coupling.PythonLoop`. It is called
without Python's global lock, so that agents in threads advance in parallel.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.components.component import Component, Interface, Variable
from cosim.errors import ComponentError, ConfigError, Problem
from cosim.kernel import layout
from cosim.kernel.layout import Reason
from cosim.plan import CouplingPlan
from network.units import to_seconds

if TYPE_CHECKING:
    from cosim.components.fmu import FmuComponent, Native
    from cosim.coupling import LoopState
    from cosim.mailbox import Updates
    from cosim.wiring import Transfer, Wiring

_LATEST_NS = 2**53
"""Up to here (104 days) a time in nanoseconds is exact as a float64, as the kernel needs it."""


class NativeLoop:
    """The same as `PythonLoop.advance`, on the same memory; the components are initialised by a `PythonLoop`.

    Args:
        wiring: of the agent.
        components: open FMUs, sized by their structural parameters.
        coupling: how they are coupled.
        state: shared with the `PythonLoop`.

    Raises:
        ConfigError: the library is missing, a component is no FMU, or a connected variable holds no numbers.
    """

    def __init__(
        self, wiring: Wiring, components: Sequence[Component], coupling: CouplingPlan, state: LoopState
    ) -> None:
        self._advance = layout.library().cosim_kernel_advance
        self._components = _only_fmus(components)
        self._calls = [_Calls(component.native(), component.interface) for component in self._components]
        self._transfers = _TransferTable(self._calls)
        self._memory: list[Any] = []
        n, n_states = len(components), sum(component.n_states for component in components)
        self._agent = layout.Agent(
            n_components=n,
            n_states=n_states,
            n_signals=wiring.n_signals,
            width=wiring.mailbox.values.shape[1],
            propagate=self._transfers.add(wiring.propagate),
            listen=self._transfers.add(wiring.listen),
            sample=self._transfers.add(wiring.sample),
            outputs=self._keep((layout.Transfers * n)(*map(self._transfers.add, wiring.outputs))),
            inputs=self._keep((layout.Transfers * n)(*map(self._transfers.add, wiring.inputs))),
            method=layout.METHODS.index(coupling.method),
            integrator=layout.INTEGRATORS.index(coupling.integrator),
            step_ns=coupling.step_ns,
            relative_tolerance=coupling.relative_tolerance,
            absolute_tolerance=coupling.absolute_tolerance,
            owner=self._keep(wiring.owner),
            mailbox_values=self._keep(wiring.mailbox.values),
            mailbox_stamp=self._keep(wiring.mailbox.stamp),
            mailbox_time=self._keep(wiring.mailbox.time),
            signals=self._keep(state.signals),
            previous=self._keep(state.previous),
            steps=self._keep(state.steps),
            next_event=self._keep(state.next_event),
            time=self._keep(state.time),
            before=self._keep(np.zeros(wiring.n_signals)),
            middle=self._keep(np.zeros(wiring.n_signals)),
            source=self._keep(np.zeros(wiring.n_signals)),
            states=self._keep(np.zeros(n_states)),
            new_states=self._keep(np.zeros(n_states)),
            stages=self._keep(np.zeros(layout.STAGES * n_states)),
        )
        rows = self._transfers.rows
        self._agent.transfers = self._keep((layout.Transfer * len(rows))(*rows))
        self._agent.components = self._keep((layout.Component * n)(*self._component_rows(wiring)))
        self._address = ctypes.addressof(self._agent)

    def advance(self, start_ns: int, end_ns: int, updates: Updates) -> None:
        """See `cosim.coupling.PythonLoop.advance`."""
        for component in self._components:
            component.require_usable()
        if end_ns > _LATEST_NS:
            text = f"the native loop counts time up to {to_seconds(_LATEST_NS):.0f} s; use `coupling: {{loop: python}}`"
            raise ComponentError(self._components[0].name, text)
        messages = _updates(updates) if len(updates) else _NO_UPDATES
        if not self._advance(self._address, start_ns, end_ns, ctypes.addressof(messages)):
            raise self._failure()

    def _keep(self, memory: Any) -> int:
        """The address of memory, which then lives as long as the loop."""
        self._memory.append(memory)
        return memory.ctypes.data if isinstance(memory, np.ndarray) else ctypes.addressof(memory)

    def _component_rows(self, wiring: Wiring) -> Iterator[layout.Component]:
        first_state = 0
        for c, (component, calls) in enumerate(zip(self._components, self._calls, strict=True)):
            read = [wiring.owner[transfer.positions] for transfer in wiring.inputs[c]]
            yield layout.Component(
                fmi=calls.native.fmi,
                n_states=component.n_states,
                first_state=first_state,
                reads_earlier=any(np.any((owners >= 0) & (owners < c)) for owners in read),
                instance=calls.native.instance,
                functions=calls.addresses(),
            )
            first_state += component.n_states

    def _failure(self) -> ComponentError:
        """What the kernel noted, in the words of the Python loop and of `FmuComponent`."""
        failure = self._agent.failure
        index = int(failure.component)
        component = self._components[index]
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
                from cosim.coupling import EVENT_ITERATIONS

                message = f"the event iteration did not settle within {EVENT_ITERATIONS} rounds"
                return ComponentError(component.name, message)
            case Reason.DISCRETE_STATES_UNSETTLED:
                return component.unsettled()
            case _:
                return ComponentError(
                    component.name,
                    f"the step size fell below {failure.value:.3g} s without meeting the tolerances; "
                    "loosen relative_tolerance or absolute_tolerance, or look for a discontinuity",
                )


_NO_UPDATES = layout.Updates()


def _updates(updates: Updates) -> layout.Updates:
    return layout.Updates(
        count=len(updates),
        arrival_ns=updates.arrival_ns.ctypes.data,
        slot=updates.slot.ctypes.data,
        stamp=updates.stamp.ctypes.data,
        time=updates.time.ctypes.data,
        values=updates.values.ctypes.data,
    )


def _only_fmus(components: Sequence[Component]) -> list[FmuComponent]:
    from cosim.components.fmu import FmuComponent

    fmus = [component for component in components if isinstance(component, FmuComponent)]
    if len(fmus) != len(components):
        message = "the native loop serves agents made of FMUs alone; write `coupling: {loop: python}`"
        raise ConfigError([Problem(message)])
    return fmus


class _Calls:
    """The FMI functions of one component that the kernel may call: name by call number."""

    def __init__(self, native: Native, interface: Interface) -> None:
        self.native = native
        if interface is Interface.MODEL_EXCHANGE:
            self.names = dict(enumerate(layout.MODEL_EXCHANGE_CALLS[native.fmi]))
        else:
            self.names = {layout.DO_STEP: f"fmi{native.fmi}DoStep"}

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

    def addresses(self) -> ctypes.Array[ctypes.c_void_p]:
        """The table of function pointers, null where a function is not needed."""
        table = (ctypes.c_void_p * layout.N_CALLS)()
        for number, name in self.names.items():
            table[number] = self.native.address(name)
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
                    self._add(transfer, dtype, variables, transfer.positions[offset : offset + size])
                offset += size
        return layout.Transfers(first, len(self.rows))

    def _add(self, transfer: Transfer, dtype: str, variables: list[Variable], positions: Any) -> None:
        to_component = bool(transfer.direction)
        self._calls[transfer.component].access(dtype, to_component=to_component)
        references = np.array([reference for v in variables for reference in v.references], dtype=np.uint32)
        buffer = np.zeros(positions.size)  # no type is wider
        self._memory += [references, positions, buffer]
        self._variables.append(variables)
        self.rows.append(
            layout.Transfer(
                component=transfer.component,
                to_component=to_component,
                type=layout.TYPES.index(dtype),
                n_references=references.size,
                n_values=positions.size,
                references=references.ctypes.data,
                positions=positions.ctypes.data,
                buffer=buffer.ctypes.data,
            )
        )
