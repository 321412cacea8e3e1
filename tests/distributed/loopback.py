"""A whole distributed run in one thread: the state machines over an in-memory network, stepped in any order."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from itertools import count

from cosim.distributed.assignment import EMULATOR, Job, Share, divide, renamed
from cosim.distributed.orchestration import Orchestration
from cosim.distributed.replacement import Moment
from cosim.distributed.serving import Machine, machine, send
from cosim.plan import Plan
from cosim.running.inline import Observer, Take
from network.transport import InMemoryEndpoint, InMemoryNetwork, Kind, PeerLost, Tamper, TransportTimeout


class Loopback:
    """Every process takes a step when its turn comes; an idle one flushes. Some messages wait for others.

    Args:
        plan: what to run.
        workers: how many workers, or the agents of each.
        observers: of the run.
        order: decides whose turn it is; some processes may be slower than others.
        tamper: sees every frame.
        paced: whether ticks are released one by one, whenever the orchestrator finds nothing else to do.
        losses: how many times a worker, the last one to join among them, is killed.
        take: gives values from outside.
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
        losses: int = 0,
        take: Take | None = None,
    ) -> None:
        if isinstance(workers, int):
            workers = divide(len(plan.agents), workers)
        self._network = InMemoryNetwork("loopback", tamper)
        self._hub = self._network.hub()
        self._endpoints: dict[str, InMemoryEndpoint] = {
            name: self._network.connect(name) for name in (EMULATOR, *workers)
        }
        self._machines: dict[str, Machine] = {}
        self._dead: set[str] = set()
        self._order = order
        self._ticks = plan.ticks
        self._weights = [order.choice([1, 1, 5, 20]) for _ in (*self._endpoints, "orchestrator")]
        self._kills = sorted(order.sample(range(60 * plan.ticks * len(workers)), losses), reverse=True)
        self.caught_up: list[str] = []
        self.orchestration = Orchestration(plan, workers, observers, take, paced=paced)

    def run(self) -> None:
        with ExitStack() as stack:
            stack.callback(lambda: [served.close() for served in self._machines.values()])
            send(self._hub, self.orchestration.begin())
            idle = 0
            for step in count():
                if self.orchestration.finished:
                    break
                if self._kills and step >= self._kills[-1]:
                    self._kills.pop()
                    self._kill(self._order.choice(self.orchestration.processes[1:]))
                (name,) = self._order.choices([*self._endpoints, "orchestrator"], self._weights)
                idle = 0 if self._step(name) else idle + 1
                assert idle < 5000, f"nobody gets further: {self.orchestration.standing()}"

    def ask(self) -> None:
        """Ask everybody how far they are, until all have answered that can."""
        send(self._hub, self.orchestration.ask())
        names = [*self._endpoints, "orchestrator"]
        while sum(self._step(name) for name in names):
            pass

    def _kill(self, name: str) -> None:
        """End a worker without a word."""
        if name in self._machines:
            self._machines.pop(name).close()
        self._endpoints[name].kill()
        self._dead.add(name)

    def _replace(self, name: str) -> None:
        """Another process for a worker that is gone; in its place, so that it is as slow."""
        moment = Moment(self.orchestration.position(name), known=True)
        assert self.orchestration.why_not_replaced(name, moment) is None
        new, messages = self.orchestration.replace(name, moment)
        self._endpoints = renamed(self._endpoints, name, new)
        self._endpoints[new] = self._network.connect(new)
        send(self._hub, messages + self.orchestration.employ([new]))

    def _step(self, name: str) -> bool:
        """Let a process take one message, act or flush; whether it did anything."""
        if name == "orchestrator":
            try:
                send(self._hub, self.orchestration.handle(self._hub.receive(0)))
            except PeerLost as lost:
                self._replace(lost.name)
            except TransportTimeout:
                if self.orchestration.unready or self.orchestration.released == self._ticks:
                    return False
                send(self._hub, self.orchestration.release(self.orchestration.released + 1))
            self.caught_up += [name for name, _ in self.orchestration.caught_up()]
            return True
        if name in self._dead:
            return False
        endpoint = self._endpoints[name]
        served = self._machines.get(name)
        if served is not None and served.busy and self._order.random() < 0.5:
            send(endpoint, served.act(self._order.choice([1, 2, 64])))
            return True
        try:
            envelope = endpoint.receive(0)
        except TransportTimeout:
            if served is None:
                return False
            messages = served.act(64) if served.busy else served.flush()
            send(endpoint, messages)
            return bool(messages)
        if envelope.kind is Kind.SCENARIO:
            self._machines[name] = machine(name, Job.decode(envelope))
            send(endpoint, self._machines[name].prepare())
        elif served is not None:
            send(endpoint, served.take(envelope))
        return True
