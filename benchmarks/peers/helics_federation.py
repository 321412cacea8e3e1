"""The exchange in HELICS: every worker, and the delaying component, is a message federate in a process of its own.

python -m benchmarks.peers.helics_federation --agents 10 --workers 10 --setting ipc-targeted

The broker has a process of its own too. HELICS's own delay filters are not used: with four and more federates over zmq
the federation hangs. Settings: the core (`ipc`, `zmq`, `tcp`), and whether endpoints are `targeted`, so that HELICS
knows which federates wait for which, or `free`. A message sent in step k carries time k + 1/2 and so is there in step
k + 1, whoever is granted first. (`zmq_ss` hung with 10 workers; `udp`, `tcp_ss` and global timing were slower.)
"""

from __future__ import annotations

import secrets
import socket
from contextlib import ExitStack
from pathlib import Path

import helics as h  # type: ignore[import-not-found,unused-ignore]

from benchmarks.peers.exchange import AGE, SENDERS, WIDTH, Agents, Delayer, Shape, Spawned, Stopwatch, arguments

CORES = ("ipc", "zmq", "tcp")
KINDS = ("targeted", "free")
LATER = 0.5
WAY = 2
"""How many steps the way to and from the delaying component takes."""


def options(shape: Shape) -> str:
    """For broker and cores: room for the largest message."""
    largest = shape.agents * len(SENDERS) * WIDTH * 8
    return f"--loglevel=no_print --maxsize={max(4096, 2 * largest)} --maxcount={64 * (shape.workers + 2)}"


def port_of_broker() -> int:
    """A port that is free now, and the next ones likely."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def federate(name: str, shape: Shape, setting: str, broker: str, port: int) -> h.HelicsMessageFederate:
    """A message federate with a core of its own and steps of 1 s."""
    core = setting.partition("-")[0]
    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, core)
    h.helicsFederateInfoSetCoreName(info, f"{broker}-{name}")
    where = f"--broker_address={broker}" if core == "ipc" else f"--broker_address=127.0.0.1 --brokerport={port}"
    h.helicsFederateInfoSetCoreInitString(info, f"--federates=1 {where} {options(shape)}")
    h.helicsFederateInfoSetTimeProperty(info, h.helics_property_time_period, 1.0)
    h.helicsFederateInfoSetFlagOption(info, h.helics_flag_uninterruptible, True)
    return h.helicsCreateMessageFederate(name, info)


def endpoint(fed: h.HelicsMessageFederate, name: str, setting: str, other: str) -> h.HelicsEndpoint:
    """One end of a line to `other`."""
    if setting.endswith("free"):
        made = h.helicsFederateRegisterGlobalEndpoint(fed, name)
        h.helicsEndpointSetDefaultDestination(made, other)
    else:
        made = h.helicsFederateRegisterGlobalTargetedEndpoint(fed, name)
        h.helicsEndpointAddDestinationTarget(made, other)
    return made


def send(end: h.HelicsEndpoint, other: str, data: bytes, time: float) -> None:
    """Send a message that is there at `time`."""
    h.helicsEndpointSendBytesToAt(end, data, other, time)


def received(end: h.HelicsEndpoint) -> bytes:
    """The one message there, or nothing."""
    if not h.helicsEndpointHasMessage(end):
        return b""
    return bytes(h.helicsMessageGetBytes(h.helicsEndpointGetMessage(end)))


def worker(shape: Shape, index: int, setting: str, broker: str, port: int) -> None:
    """One worker."""
    agents = Agents(shape, index)
    nothing = Delayer(shape, 0).nothing()[index]
    fed = federate(f"w{index}", shape, setting, broker, port)
    end = endpoint(fed, f"worker{index}", setting, f"line{index}")
    h.helicsFederateEnterExecutingMode(fed)
    for step in range(shape.total):
        agents.hear(step, received(end) or nothing)
        send(end, f"line{index}", agents.samples(step), step + LATER)
        h.helicsFederateRequestTime(fed, step + 1)
    leave(fed)


def delay(shape: Shape, setting: str, broker: str, port: int) -> None:
    """The delaying component."""
    delayer, stopwatch = Delayer(shape, AGE - WAY), Stopwatch(shape)
    fed = federate("d", shape, setting, broker, port)
    others = [f"worker{index}" for index in range(shape.workers)]
    ends = [endpoint(fed, f"line{index}", setting, other) for index, other in enumerate(others)]
    h.helicsFederateEnterExecutingMode(fed)
    for step in range(shape.total):
        samples = [received(end) for end in ends]
        mail = delayer.exchange(samples if samples[0] else [])
        for end, other, data in zip(ends, others, mail, strict=True):
            send(end, other, data, step + LATER)
        stopwatch.step()
        h.helicsFederateRequestTime(fed, step + 1)
    leave(fed)


def leave(fed: h.HelicsMessageFederate) -> None:
    """Let go of the federation."""
    h.helicsFederateDisconnect(fed)
    h.helicsFederateFree(fed)
    h.helicsCloseLibrary()


def main() -> None:
    """Measure."""
    shape, setting = arguments(__doc__, [f"{core}-{kind}" for core in CORES for kind in KINDS])
    core = setting.partition("-")[0]
    name, port = f"netcosim_{secrets.token_hex(4)}", port_of_broker()
    where = f"--local_interface={name}" if core == "ipc" else f"--local --port={port}"
    try:
        with ExitStack() as stack:
            broker = h.helicsCreateBroker(core, name, f"--federates={shape.workers + 1} {where} {options(shape)}")
            stack.enter_context(Spawned(delay, shape, setting, name, port))
            for index in range(shape.workers):
                stack.enter_context(Spawned(worker, shape, index, setting, name, port))
        h.helicsBrokerWaitForDisconnect(broker, 5000)
        h.helicsCloseLibrary()
    finally:
        for left in Path("/dev/shm").glob(f"*{name}*"):
            left.unlink()


if __name__ == "__main__":
    main()
