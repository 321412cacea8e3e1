"""What stands in the agent's process for a component in another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cosim.components.component import Component, Floats, Interface, Value, Variable
from cosim.components.isolation.calls import (
    FAULT,
    Call,
    Closed,
    ProtocolError,
    TooLate,
    call,
    call_with_json,
    fault,
    results,
)
from cosim.components.isolation.process import HostProcess
from cosim.components.presented import own_starts
from cosim.errors import ComponentError, ConfigError, DiscardedStepError, EndRequestedError, Problem
from cosim.logs import Sink
from cosim.plan import ComponentPlan
from network.units import to_seconds

_OPENING_SECONDS = 60.0
_ENDING_SECONDS = 2.0

_STEP = -1


class IsolatedComponent(Component):
    """A component in a process of its own.

    Calls that return nothing wait, and travel with the next one that does, or with `step`; values that were read right
    after a call the last time come back with it. So a micro step costs one message each way.

    Args:
        plan: of the component.
        interface: Model Exchange or Co-Simulation.
        log: takes what is printed and logged in the process.

    Raises:
        ComponentError: the process cannot be started. Whether the component opens is known after `await_open`.
    """

    def __init__(self, plan: ComponentPlan, interface: Interface, log: Sink) -> None:
        self.name = plan.name
        self.interface = interface
        self.description = plan.description.own or plan.description
        assert plan.isolation is not None
        self._deadline = to_seconds(plan.isolation.deadline_ns)
        self._number = 0
        self._waiting: list[bytes] = []
        self._n_values = 0
        self._declared: dict[int, tuple[int, Variable]] = {}
        self._sizes: list[int] = []
        self._follows: dict[int, int] = {}
        self._known: dict[int, Floats] = {}
        self._last_read: int | None = None
        self._n_saved = 0
        self._failed = False
        try:
            self._process = HostProcess(log)
        except OSError as error:
            message = f"a process of its own cannot be started: {error.strerror or error}"
            raise ComponentError(self.name, message) from error
        self._add(call_with_json(Call.OPEN, _opening(plan, interface)))

    # --- values -----------------------------------------------------------------------------------------------------
    def get(self, variable: Variable) -> Floats:
        number = self._declare(variable)
        if self._last_read is not None:
            self._follows[self._last_read] = number
        self._last_read = number
        if number not in self._known:
            self._fetch(number)
        return self._known[number]

    def set(self, variable: Variable, values: Floats) -> None:
        self._add(call(Call.SET, self._declare(variable), values))

    def start(self, variable: Variable, values: Sequence[Value]) -> None:
        self._add(call_with_json(Call.START, {"values": list(values)}, self._declare(variable)))

    def _declare(self, variable: Variable) -> int:
        """The number by which the process knows the variable."""
        known = self._declared.get(id(variable))
        if known is None:
            known = len(self._declared), variable  # which stays alive, and with it its identity
            self._declared[id(variable)] = known
            self._sizes.append(variable.size)
            self._waiting.append(call_with_json(Call.DECLARE, _described(variable)))
        return known[0]

    # --- life cycle -------------------------------------------------------------------------------------------------
    def await_open(self) -> None:
        sizes = self._vector(Call.SIZES, 3, max(self._deadline, _OPENING_SECONDS))
        self.n_states, self.n_indicators = map(int, sizes[:2])
        self.uses_events = bool(sizes[2])

    def enter_initialization(self, start_time: float, stop_time: float) -> None:
        self._add(call(Call.ENTER_INITIALIZATION, values=(start_time, stop_time)))
        self._exchange(max(self._deadline, _OPENING_SECONDS))

    def exit_initialization(self) -> None:
        self._add(call(Call.EXIT_INITIALIZATION))
        self._exchange(max(self._deadline, _OPENING_SECONDS))

    def terminate(self) -> None:
        if self._failed:
            self._process.kill()
            return
        self._failed = True
        try:
            self._waiting = [call(Call.TERMINATE)]
            self._number += 1
            self._process.channel.send(self._number, 1, b"".join(self._waiting), min(self._deadline, _ENDING_SECONDS))
            self._process.channel.receive(min(self._deadline, _ENDING_SECONDS))
        except (Closed, TooLate, ProtocolError):
            self._process.kill()
        else:
            self._process.end()

    # --- saved states -----------------------------------------------------------------------------------------------
    # They stay there, and are known by numbers.
    def save(self) -> object:
        self._n_saved += 1
        self._add(call(Call.SAVE, values=(self._n_saved,)))
        return self._n_saved

    def restore(self, saved: object) -> None:
        assert isinstance(saved, int)
        self._add(call(Call.RESTORE, values=(saved,)))

    def forget(self, saved: object) -> None:
        assert isinstance(saved, int)
        if not self._failed:
            self._add(call(Call.FORGET, values=(saved,)))

    # --- Co-Simulation ----------------------------------------------------------------------------------------------
    def step(self, time: float, step: float) -> None:
        self._step(call(Call.STEP, values=(time, step)))

    def step_in_halves(self, time: float, step: float, halvings: int) -> None:
        self._step(call(Call.STEP_IN_HALVES, values=(time, step, halvings)))

    def _step(self, what: bytes) -> None:
        self._add(what)
        self._last_read = _STEP
        self._fetch(self._follows.get(_STEP))

    def enter_step_mode(self) -> None:
        self._add(call(Call.ENTER_STEP_MODE))

    # --- Model Exchange ---------------------------------------------------------------------------------------------
    def set_time(self, time: float) -> None:
        self._add(call(Call.SET_TIME, values=(time,)))

    def get_states(self) -> Floats:
        return self._vector(Call.GET_STATES, self.n_states)

    def set_states(self, states: Floats) -> None:
        self._add(call(Call.SET_STATES, values=states))

    def derivatives(self) -> Floats:
        return self._vector(Call.DERIVATIVES, self.n_states)

    def event_indicators(self) -> Floats:
        return self._vector(Call.EVENT_INDICATORS, self.n_indicators)

    def completed_step(self) -> bool:
        return bool(self._vector(Call.COMPLETED_STEP, 1)[0])

    def enter_event_mode(self) -> None:
        self._add(call(Call.ENTER_EVENT_MODE))

    def update_discrete_states(self) -> float | None:
        time = self._ask(Call.UPDATE_DISCRETE_STATES)
        return float(time[0]) if len(time) else None

    def enter_continuous_time_mode(self) -> None:
        self._add(call(Call.ENTER_CONTINUOUS_TIME_MODE))

    # --- the other process ------------------------------------------------------------------------------------------
    def _add(self, what: bytes) -> None:
        """A call that can wait; what was read is not valid after it."""
        self._waiting.append(what)
        self._last_read = None
        self._known.clear()

    def _fetch(self, number: int | None) -> None:
        """Have all calls carried out, and read a variable with those that were read right after it the last time."""
        wanted: list[int] = []
        while number is not None and number not in wanted:
            wanted.append(number)
            number = self._follows.get(number)
        self._waiting += (call(Call.GET, number) for number in wanted)
        self._n_values += len(wanted)
        values = self._exchange(self._deadline)
        for number, value in zip(wanted, values, strict=True):
            if len(value) != self._sizes[number]:
                raise self._lies(f"{len(value)} numbers where there are {self._sizes[number]}")
            self._known[number] = value

    def _vector(self, what: Call, size: int, deadline: float | None = None) -> Floats:
        values = self._ask(what, deadline)
        if len(values) != size:
            raise self._lies(f"{len(values)} numbers where there are {size}")
        return values.copy()

    def _ask(self, what: Call, deadline: float | None = None) -> Floats:
        self._waiting.append(call(what))
        self._n_values += 1
        self._last_read = None
        self._known.clear()
        return self._exchange(self._deadline if deadline is None else deadline)[0]

    def _exchange(self, deadline: float) -> list[Floats]:
        """Have all calls carried out that wait.

        Returns:
            What they return.

        Raises:
            ComponentError: the component refused, its process is gone, or did not answer in time.
            ConfigError: the component's file is at fault.
        """
        if self._failed:
            raise ComponentError(self.name, "has failed or ended and cannot be called any more")
        waiting, n_values = self._waiting, self._n_values
        self._waiting, self._n_values = [], 0
        self._number += 1
        channel = self._process.channel
        try:
            channel.send(self._number, len(waiting), b"".join(waiting), deadline)
            return self._answer(*channel.receive(deadline), n_values)
        except Closed:
            raise self._gone() from None
        except TooLate:
            self._failed = True
            self._process.kill()
            message = f"did not answer within {deadline:g} s, and its process was killed"
            raise ComponentError(self.name, message, self._process.last_lines) from None
        except ProtocolError as error:
            raise self._lies(str(error)) from None

    def _answer(self, number: int, count: int, body: bytes, n_values: int) -> list[Floats]:
        """The results in a reply.

        Raises:
            ProtocolError: it is none to the last request.
            ComponentError, ConfigError: as `_exchange`.
        """
        if number != self._number & 0xFFFFFFFF:
            raise ProtocolError(f"an answer to question {number}, not {self._number}")
        if count == FAULT:
            raise self._fault(fault(body))
        if count != n_values:
            raise ProtocolError(f"{count} results, not {n_values}")
        return results(count, body)

    def _fault(self, tree: Mapping[str, Any]) -> ComponentError | ConfigError:
        if tree.get("file"):
            return ConfigError([Problem(f"component {self.name}: {tree['message']}")])
        log = tree.get("log")
        kind = _KINDS.get(str(tree.get("kind")), ComponentError)
        return kind(self.name, str(tree["message"]), None if log is None else str(log))

    def _gone(self) -> ComponentError:
        self._failed = True
        how = self._process.ended() or "closed its connection"
        self._process.kill()
        return ComponentError(self.name, f"its process {how}", self._process.last_lines)

    def _lies(self, what: str) -> ComponentError:
        self._failed = True
        self._process.kill()
        return ComponentError(self.name, f"its process says what it must not: {what}", self._process.last_lines)


_KINDS: Mapping[str, type[ComponentError]] = {kind.__name__: kind for kind in (DiscardedStepError, EndRequestedError)}
"""What went wrong and leaves the component usable."""


def _opening(plan: ComponentPlan, interface: Interface) -> dict[str, Any]:
    starts = own_starts(plan.description.variables, plan.start)
    return {
        "name": plan.name,
        "path": None if plan.path is None else str(plan.path),
        "python": plan.python,
        "interface": str(interface),
        "sha256": plan.description.sha256,
        "tolerance": plan.description.tolerance,
        "structural": {v.name: int(x[0]) for v, x in starts if v.causality == "structuralParameter" and x},
    }


_NEEDED = ("name", "causality", "variability", "dtype", "shape", "references", "start", "items")


def _described(variable: Variable) -> dict[str, Any]:
    return {name: getattr(variable, name) for name in _NEEDED}
