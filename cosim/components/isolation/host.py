"""The process of an isolated component: carries out the calls that come, one batch at a time, until its agent is gone.

Started as `python -m cosim.components.isolation.host SOCKET FOLDER`: the socket by its descriptor, and a folder for
temporary files, which is removed with the process. Standard input is a pipe that only the agent's process holds open:
it ends when that is gone, which is noticed even while the component hangs in native code. What is printed, and what an
FMU logs, goes to standard output, whose other end the agent's process reads.
"""

from __future__ import annotations

import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cosim.components.component import Component, Floats, Interface, Variable
from cosim.components.isolation.calls import (
    FAULT,
    Call,
    Channel,
    Closed,
    ProtocolError,
    calls,
    result,
)
from cosim.errors import ComponentError, ConfigError, CosimError
from cosim.native_output import print_by_lines
from cosim.spawning import end_group, end_with_parent

_NOTHING = np.empty(0)


class Host:
    """The component, once it is opened, and what may be asked of it."""

    def __init__(self) -> None:
        self._opened: Component | None = None
        self._variables: list[Variable] = []
        self._saved: dict[int, object] = {}

    def carry_out(self, count: int, body: bytes) -> tuple[int, bytes]:
        """The count and the body of the reply to a request.

        Raises:
            ComponentError, ConfigError: the component refused; what follows in the batch is not done.
            ProtocolError: no such request.
        """
        found = []
        for what, variable, content in calls(count, body):
            value = self._carry_out(what, variable, content)
            if value is not None:
                found.append(result(value))
        return len(found), b"".join(found)

    @property
    def log(self) -> str | None:
        """The last line that the component logged."""
        log = getattr(self._opened, "log", None)
        return getattr(log, "last", None)

    def _carry_out(self, what: Call, variable: int, content: Any) -> Floats | None:
        if what is Call.OPEN:
            self._opened = _open(content)
            return None
        if what is Call.DECLARE:
            self._variables.append(_variable(content))
            return None
        component = self._opened
        if component is None:
            raise ProtocolError(f"{what.name} before OPEN")
        if what is Call.SET:
            component.set(self._variables[variable], content)
        elif what is Call.GET:
            return component.get(self._variables[variable])
        elif what is Call.START:
            component.start(self._variables[variable], content["values"])
        elif what in _OF_STATES:
            self._keep(component, what, int(content[0]))
        else:
            return _OTHERS[what](component, content)
        return None

    def _keep(self, component: Component, what: Call, number: int) -> None:
        """Save the component's state under a number, go back to one, or forget it."""
        if what is Call.SAVE:
            self._saved[number] = component.save()
        elif what is Call.RESTORE:
            component.restore(self._saved[number])
        else:
            component.forget(self._saved.pop(number))
        component.goes_back = bool(self._saved)


_OF_STATES = frozenset({Call.SAVE, Call.RESTORE, Call.FORGET})


def _sizes(component: Component, _: Floats) -> Floats:
    return np.array([component.n_states, component.n_indicators, component.uses_events], np.float64)


def _update(component: Component, _: Floats) -> Floats:
    time = component.update_discrete_states()
    return _NOTHING if time is None else np.array([time])


_OTHERS: Mapping[Call, Callable[[Component, Floats], Floats | None]] = {
    Call.ENTER_INITIALIZATION: lambda c, x: c.enter_initialization(float(x[0]), float(x[1])),
    Call.EXIT_INITIALIZATION: lambda c, _: c.exit_initialization(),
    Call.STEP: lambda c, x: c.step(float(x[0]), float(x[1])),
    Call.STEP_IN_HALVES: lambda c, x: c.step_in_halves(float(x[0]), float(x[1]), int(x[2])),
    Call.SET_TIME: lambda c, x: c.set_time(float(x[0])),
    Call.SET_STATES: lambda c, x: c.set_states(x),
    Call.ENTER_EVENT_MODE: lambda c, _: c.enter_event_mode(),
    Call.ENTER_STEP_MODE: lambda c, _: c.enter_step_mode(),
    Call.ENTER_CONTINUOUS_TIME_MODE: lambda c, _: c.enter_continuous_time_mode(),
    Call.TERMINATE: lambda c, _: c.terminate(),
    Call.GET_STATES: lambda c, _: c.get_states(),
    Call.DERIVATIVES: lambda c, _: c.derivatives(),
    Call.EVENT_INDICATORS: lambda c, _: c.event_indicators(),
    Call.COMPLETED_STEP: lambda c, _: np.array([float(c.completed_step())]),
    Call.UPDATE_DISCRETE_STATES: _update,
    Call.SIZES: _sizes,
}


def _open(tree: Mapping[str, Any]) -> Component:
    """The component, as the agent's process describes it."""
    from dataclasses import replace

    from cosim.components.opening import describe, open_component

    path = None if tree["path"] is None else Path(tree["path"])
    description = describe(path, tree["python"], tree["structural"])
    if description.sha256 != tree["sha256"] and path is None:
        message = (
            f"the file of {tree['python']} is not the one that the scenario was checked with (its SHA-256 differs)"
        )
        raise ComponentError(tree["name"], message)
    description = replace(description, sha256=tree["sha256"], tolerance=tree["tolerance"])
    return open_component(tree["name"], path, tree["python"], Interface(tree["interface"]), description, _print)


def _print(data: bytes) -> None:
    os.write(1, data)


def _variable(tree: Mapping[str, Any]) -> Variable:
    return Variable(
        name=tree["name"],
        causality=tree["causality"],
        variability=tree["variability"],
        dtype=tree["dtype"],
        shape=tuple(tree["shape"]),
        references=tuple(tree["references"]),
        start=None if tree["start"] is None else tuple(tree["start"]),
        items=tree["items"],
    )


# --- the process ------------------------------------------------------------------------------------------------------
def main(arguments: Sequence[str]) -> NoReturn:
    """Serve until the other end of the socket is closed."""
    descriptor, folder = int(arguments[0]), Path(arguments[1])
    tempfile.tempdir = str(folder)
    end_with_parent(lambda: _remove(folder))
    print_by_lines()
    channel, host = Channel(socket.socket(fileno=descriptor)), Host()
    try:
        while True:
            number, count, body = channel.receive()
            channel.send(number, *_reply(host, count, body))
    except (Closed, ProtocolError):
        _remove(folder)
        end_group(0)


def _reply(host: Host, count: int, body: bytes) -> tuple[int, bytes]:
    import json

    try:
        return host.carry_out(count, body)
    except ComponentError as error:
        tree: dict[str, Any] = {"message": error.message, "log": error.log, "kind": type(error).__name__}
    except ConfigError as error:
        tree = {"message": "; ".join(problem.message for problem in error.problems), "log": host.log, "file": True}
    except (CosimError, Exception) as error:
        tree = {"message": f"{type(error).__name__}: {error}", "log": host.log}
    return FAULT, json.dumps(tree).encode()


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1:])
