"""A whole distributed run in one thread: the state machines over an in-memory network, stepped in any order."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress

from cosim.distributed.assignment import EMULATOR, Job, Share, divide
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.serving import Machine, machine, send
from cosim.inline import Observer
from cosim.plan import Plan
from network.transport import Endpoint, InMemoryNetwork, Kind, Tamper, TransportTimeout


class Loopback:
    """Every process takes a step when its turn comes; an idle one flushes.

    Args:
        plan: what to run.
        workers: how many workers, or the agents of each.
        observers: of the run.
        order: decides whose turn it is; some processes may be slower than others.
        tamper: sees every frame.
        paced: whether ticks are released one by one, whenever the orchestrator finds nothing else to do.
    """

    def __init__(
        self,
        plan: Plan,
        workers: int | Mapping[str, Share],
        observers: Sequence[Observer],
        order: random.Random,
        tamper: Tamper | None = None,
        *,
        paced: bool = False,
    ) -> None:
        if isinstance(workers, int):
            workers = divide(len(plan.agents), workers)
        self._network = InMemoryNetwork("loopback", tamper)
        self._hub = self._network.hub()
        self._endpoints: dict[str, Endpoint] = {name: self._network.connect(name) for name in (EMULATOR, *workers)}
        self._machines: dict[str, Machine] = {}
        self._order = order
        self._ticks = plan.ticks
        self._weights = [order.choice([1, 1, 5, 20]) for _ in (*self._endpoints, "orchestrator")]
        self.orchestration = Orchestration(plan, workers, observers, paced=paced)

    def run(self) -> None:
        with ExitStack() as stack:
            stack.callback(lambda: [served.close() for served in self._machines.values()])
            send(self._hub, self.orchestration.begin())
            names = [*self._endpoints, "orchestrator"]
            idle = 0
            while not self.orchestration.finished:
                (name,) = self._order.choices(names, self._weights)
                idle = 0 if self._step(name) else idle + 1
                assert idle < 5000, f"nobody gets further: {self.orchestration.blockage()}"

    def _step(self, name: str) -> bool:
        """Let a process handle one message, or flush; whether it did anything."""
        if name == "orchestrator":
            with suppress(TransportTimeout):
                send(self._hub, self.orchestration.handle(self._hub.receive(0)))
                return True
            if self.orchestration.unready or self.orchestration.released == self._ticks:
                return False
            send(self._hub, self.orchestration.release(self.orchestration.released + 1))
            return True
        endpoint = self._endpoints[name]
        try:
            envelope = endpoint.receive(0)
        except TransportTimeout:
            messages = self._machines[name].flush() if name in self._machines else []
            send(endpoint, messages)
            return bool(messages)
        if envelope.kind is Kind.SCENARIO:
            self._machines[name] = machine(name, Job.decode(envelope))
            send(endpoint, self._machines[name].prepare())
        else:
            send(endpoint, self._machines[name].handle(envelope))
        return True
