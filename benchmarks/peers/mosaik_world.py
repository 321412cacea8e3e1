"""The exchange in mosaik: every worker, and the delaying component, is a simulator in a process of its own.

python -m benchmarks.peers.mosaik_world --agents 10 --workers 10 --setting parallel

Samples and mail travel as base64, since mosaik's messages are JSON and a string is what it encodes fastest. Settings:
`parallel` shifts the connections of both directions by a step, so that all simulators step at once; `sequential` shifts
only the way back. mosaik's cache is off, its progress bar too.
"""

from __future__ import annotations

import asyncio
import base64
import sys
from typing import Any

import mosaik  # type: ignore[import-not-found,unused-ignore]
import mosaik_api_v3  # type: ignore[import-not-found,unused-ignore]

from benchmarks.peers.exchange import AGE, Agents, Delayer, Shape, Stopwatch, arguments

SETTINGS = {"parallel": 2, "sequential": 1}
"""How many steps the way to and from the delaying component takes."""
MODEL = {"public": True, "params": [], "attrs": ["samples", "mail"]}
META = {"api_version": "3.0", "type": "time-based", "models": {"Worker": MODEL}}


def decoded(inputs: dict[str, Any]) -> bytes:
    """The one value among a simulator's inputs."""
    (value,) = inputs.values()
    return base64.b64decode(value)


def encoded(values: bytes) -> str:
    """As a simulator sends it."""
    return base64.b64encode(values).decode("ascii")


class WorkerSimulator(mosaik_api_v3.Simulator):  # type: ignore[misc]
    """A block of agents: one entity, `Worker`."""

    def __init__(self, shape: Shape, worker: int) -> None:
        super().__init__(META)
        self._agents = Agents(shape, worker)
        self._samples = b""

    def create(self, num: int, model: str, **_: Any) -> list[dict[str, str]]:
        return [{"eid": f"{i}", "type": model} for i in range(num)]

    def step(self, time: int, inputs: dict[str, Any], max_advance: int) -> int:  # noqa: ARG002
        self._agents.hear(time, decoded(inputs["0"]["mail"]))
        self._samples = self._agents.samples(time)
        return time + 1

    def get_data(self, outputs: dict[str, list[str]]) -> dict[str, dict[str, str]]:
        return {entity: {"samples": encoded(self._samples)} for entity in outputs}


class DelayingSimulator(mosaik_api_v3.Simulator):  # type: ignore[misc]
    """The delaying component: an entity for every worker."""

    def __init__(self, shape: Shape, way: int) -> None:
        super().__init__(META)
        self._delayer = Delayer(shape, AGE - way)
        self._stopwatch = Stopwatch(shape)
        self._entities = [f"{worker}" for worker in range(shape.workers)]
        self._mail: dict[str, bytes] = {}

    def create(self, num: int, model: str, **_: Any) -> list[dict[str, str]]:
        return [{"eid": f"{i}", "type": model} for i in range(num)]

    def step(self, time: int, inputs: dict[str, Any], max_advance: int) -> int:  # noqa: ARG002
        samples = [decoded(inputs[entity]["samples"]) for entity in self._entities]
        mail = self._delayer.exchange(samples if samples[0] else [])
        self._mail = dict(zip(self._entities, mail, strict=True))
        self._stopwatch.step()
        return time + 1

    def get_data(self, outputs: dict[str, list[str]]) -> dict[str, dict[str, str]]:
        return {entity: {"mail": encoded(self._mail[entity])} for entity in outputs}


def simulate(address: str, shape: Shape, setting: str, role: int) -> None:
    """A simulator's process; role -1 is the delaying component."""
    host, port = address.rsplit(":", 1)
    delaying = role < 0
    simulator = DelayingSimulator(shape, SETTINGS[setting]) if delaying else WorkerSimulator(shape, role)
    asyncio.run(mosaik_api_v3.run_as_client(simulator, host, int(port)))


def command(shape: Shape, setting: str, role: int) -> dict[str, str]:
    """How mosaik starts a simulator."""
    numbers = f"{shape.agents} {shape.workers} {shape.steps} {shape.warm_up} {role}"
    return {"cmd": f"%(python)s -m benchmarks.peers.mosaik_world simulator %(addr)s {setting} {numbers}"}


def main() -> None:
    """Measure; with `simulator` as the first argument, be a simulator."""
    if sys.argv[1:2] == ["simulator"]:
        address, setting, *numbers = sys.argv[2:]
        *sizes, role = map(int, numbers)
        simulate(address, Shape(*sizes), setting, role)
        return
    shape, setting = arguments(__doc__, list(SETTINGS))
    config = {f"W{role}" if role >= 0 else "D": command(shape, setting, role) for role in range(-1, shape.workers)}
    world = mosaik.World(
        config,
        {"start_timeout": 60, "addr": ("127.0.0.1", None)},
        cache=False,
        skip_greetings=True,
        configure_logging=False,
    )
    shifted = SETTINGS[setting] > 1
    nothing = Delayer(shape, 0).nothing()
    with world:
        lines = world.start("D").Worker.create(shape.workers)
        for index, line in enumerate(lines):
            worker = world.start(f"W{index}").Worker()
            initial = {"initial_data": {"samples": ""}} if shifted else {}
            world.connect(worker, line, "samples", time_shifted=shifted, **initial)
            world.connect(line, worker, "mail", time_shifted=True, initial_data={"mail": encoded(nothing[index])})
        world.run(until=shape.total, print_progress=False)


if __name__ == "__main__":
    main()
