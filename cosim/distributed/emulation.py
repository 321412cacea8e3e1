"""The emulator's process: collects the samples of a tick, answers with every worker's mail. Pure.

Where the channels leave slack, it answers a tick before its samples are in; results do not depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cosim.distributed.assignment import ORCHESTRATOR, Message, Share, batch_ticks, blocks, rows_of
from cosim.plan import Plan
from network import codec
from network.emulator import Emulator
from network.messages import Exchange, Fates, Floats
from network.transport import Envelope, Kind, Part, WireError


class Emulation:
    """The call order is `prepare`, then `handle` and `flush` as they come until `finished`.

    Args:
        plan: of the whole run.
        workers: the agents of every worker.
    """

    def __init__(self, plan: Plan, workers: Mapping[str, Share]) -> None:
        self._plan = plan
        self._workers = workers
        self._wire = blocks(plan, workers)
        self._batch_ticks = batch_ticks(plan)
        self._emulator = Emulator(plan.links, plan.channels, plan.link_channel, plan.layout, plan.seed, plan.period_ns)
        self._samples: dict[int, Floats] = {}  # of ticks that are not complete
        self._next_samples = dict.fromkeys(workers, 0)
        self._published = 0  # ticks of which all samples are in
        self._exchanged = 0  # ticks answered
        self._granted = 0
        self._external: dict[int, list[Part]] = {}  # of ticks that are not answered
        self._next_external = 0
        self._fates: list[Fates] = []
        self.finished = False

    @property
    def holds_back(self) -> bool:
        """Whether `flush` would send something."""
        return bool(self._fates)

    def prepare(self) -> list[Message]:
        """Say that all is well."""
        return [Message(ORCHESTRATOR, Kind.READY, 0)]

    def handle(self, envelope: Envelope) -> list[Message]:
        """Whatever a message asks for.

        Raises:
            WireError: it is not this message's turn, or it does not hold what it should.
        """
        match envelope.kind:
            case Kind.SAMPLES:
                self._collect(envelope)
            case Kind.GRANT:
                self._granted = max(self._granted, min(envelope.tick, self._plan.ticks))
                if self._plan.bridge.subscribe and self._granted > self._next_external:
                    raise WireError(envelope.sender, f"no values from outside came for tick {self._next_external}")
            case Kind.EXTERNAL:
                self._take_external(envelope)
            case Kind.PING:
                return [*self.flush(), self._position()]
            case Kind.BYE if envelope.sender == ORCHESTRATOR:
                self.finished = True
                return []
            case _:
                raise WireError(envelope.sender, f"a {envelope.kind.name} is nothing for an emulator")
        return self._answer()

    def flush(self) -> list[Message]:
        """Hand over the fates that are held back."""
        if not self._fates:
            return []
        fates, self._fates = self._fates, []
        return [Message(ORCHESTRATOR, Kind.FATES, self._exchanged - len(fates), codec.encode_fates(fates))]

    def close(self) -> None:
        """Nothing is left open."""

    def _collect(self, envelope: Envelope) -> None:
        """Put a worker's samples where they belong; publish the ticks that become complete."""
        share = self._workers.get(envelope.sender)
        if share is None:
            raise WireError(envelope.sender, "it carries no agents, but sent samples")
        tick = envelope.expect(Kind.SAMPLES, self._next_samples[envelope.sender]).tick
        if tick not in self._samples:
            self._samples[tick] = np.empty((len(self._plan.agents), self._plan.layout.width))
        self._samples[tick][rows_of(share)] = codec.decode_samples(self._wire[envelope.sender], envelope)
        self._next_samples[envelope.sender] = tick + 1
        if self._exchanged == self._plan.ticks:  # with slack, the last samples are of no consequence
            self._samples.clear()
        elif tick == self._published and min(self._next_samples.values()) > tick:
            self._emulator.publish(tick, self._samples.pop(tick))
            self._published += 1

    def _take_external(self, envelope: Envelope) -> None:
        """Keep what was taken from outside at a tick until its mail is sent."""
        sizes = [subscription.size for subscription in self._plan.bridge.subscribe]
        taken, rest = codec.decode_external(sizes, envelope.expect(Kind.EXTERNAL, self._next_external))
        if envelope.sender != ORCHESTRATOR or len(rest.body):
            raise WireError(envelope.sender, "it sent values from outside that nobody awaits")
        self._external[self._next_external] = codec.encode_external(taken)
        self._next_external += 1

    def _answer(self) -> list[Message]:
        """The mail of every tick that can be answered."""
        messages: list[Message] = []
        while self._exchanged < self._granted and self._exchanged < self._published + self._emulator.slack:
            tick = self._exchanged
            exchange = self._emulator.exchange(tick)
            self._exchanged += 1
            self._fates.append(exchange.fates)
            messages += [Message(name, Kind.MAIL, tick, self._mail(name, exchange)) for name in self._workers]
            self._external.pop(tick, None)
            if self._exchanged == self._plan.ticks:
                messages += self._finish()
        return messages + self.flush() if len(self._fates) >= self._batch_ticks else messages

    def _mail(self, name: str, exchange: Exchange) -> list[Part]:
        return [*self._external.get(exchange.tick, ()), *codec.encode_mail(exchange.mail.of(self._workers[name]))]

    def _finish(self) -> list[Message]:
        """The last fates, and those of what is still in flight, which go under the last tick."""
        messages = self.flush()
        in_flight = codec.encode_fates([self._emulator.finish()])
        messages.append(Message(ORCHESTRATOR, Kind.FATES, self._plan.ticks, in_flight))
        return [*messages, Message(ORCHESTRATOR, Kind.DONE, self._plan.ticks)]

    def _position(self) -> Message:
        """Who has got how far, for the account of a fault."""
        position = {"exchanged": self._exchanged, "samples": list(self._next_samples.values())}
        return Message(ORCHESTRATOR, Kind.PONG, self._exchanged, codec.encode_object(position))
