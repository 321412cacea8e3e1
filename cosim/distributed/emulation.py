"""The emulator's process: collects the samples of a tick, answers with every worker's mail. Pure.

Where the channels leave slack, it answers a tick before its samples are in; results do not depend on it. Where lost
workers are replaced, it keeps all mail: a replacement begins at tick 0, is given what its predecessor got, and repeats
what that one said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosim.distributed.assignment import (
    ORCHESTRATOR,
    Message,
    Share,
    batch_ticks,
    blocks,
    renamed,
    rows_of,
)
from cosim.distributed.replay import Replay, Spill
from cosim.plan import Plan
from network import codec
from network.codec import Block
from network.emulator import Emulator
from network.messages import Fates, Floats, Mail
from network.transport import Envelope, Kind, Part, WireError

_AHEAD_TICKS = 64
_AHEAD_BYTES = 8 << 20


@dataclass
class _Station:
    """A worker, as the emulator sees it.

    Attributes:
        agents: that it carries.
        block: what both ends know of them.
        samples: ticks whose samples are in, from it or from whom it replaces.
        said: ticks whose samples this very process has sent.
        sent: ticks whose mail it has been sent.
        replay: all of its mail, where lost workers are replaced.
    """

    agents: Share
    block: Block
    replay: Replay | None
    samples: int = 0
    said: int = 0
    sent: int = 0


class Emulation:
    """See `cosim.distributed.serving.Machine`.

    Args:
        plan: of the whole run.
        workers: the agents of every worker.
        spill: opens the files that mail is kept in, where lost workers are replaced.
    """

    def __init__(self, plan: Plan, workers: Mapping[str, Share], spill: Spill) -> None:
        self._plan = plan
        wire = blocks(plan, workers)
        keeps = plan.on_worker_loss == "restart"
        self._stations = {
            name: _Station(agents, wire[name], Replay(spill()) if keeps else None) for name, agents in workers.items()
        }
        self._replaced: set[str] = set()
        self._behind: set[str] = set()  # replacements that have not caught up
        self._batch_ticks = batch_ticks(plan)
        self._emulator = Emulator(
            plan.links,
            plan.channels,
            plan.link_channel,
            plan.layout,
            plan.seed,
            plan.period_ns,
            list(workers.values()),
        )
        self.tick = 0
        """Ticks answered."""
        self._granted = 0
        self._external: dict[int, list[Part]] = {}  # of ticks that are not answered
        self._next_external = 0
        self._fates: list[Fates] = []  # that are held back
        self._fate_counts: list[int] = []  # by tick
        self.finished = False

    @property
    def holds_back(self) -> bool:
        """Whether `flush` would send something."""
        return bool(self._fate_counts)

    @property
    def busy(self) -> bool:
        """Whether `act` would do something."""
        return self.tick < self._answerable

    def prepare(self) -> list[Message]:
        """Say that all is well."""
        return [Message(ORCHESTRATOR, Kind.READY, 0)]

    def take(self, envelope: Envelope) -> list[Message]:
        """Whatever a message asks for; samples are kept for `act`.

        Raises:
            WireError: it is not this message's turn, or it does not hold what it should.
            ClusterError: there is no room for the mail that must be kept, or a replacement says something else.
        """
        if envelope.sender in self._replaced:  # what was under way when it was lost
            return []
        match envelope.kind:
            case Kind.SAMPLES:
                self._collect(envelope)
            case Kind.GRANT:
                self._granted = max(self._granted, min(envelope.tick, self._plan.ticks))
                if self._plan.bridge.subscribe and self._granted > self._next_external:
                    raise WireError(envelope.sender, f"no values from outside came for tick {self._next_external}")
            case Kind.EXTERNAL:
                self._take_external(envelope)
            case Kind.REPLACE:
                return [self._replace(envelope)]
            case Kind.PING:
                return [*self.flush(), self._position(envelope.tick)]
            case Kind.BYE if envelope.sender == ORCHESTRATOR:
                self.finished = True
                return []
            case _:
                raise WireError(envelope.sender, f"a {envelope.kind.name} is nothing for an emulator")
        return self._repeat() if self._behind else []

    def act(self, most: int) -> list[Message]:
        """The mail of ticks that can be answered, `most` at most."""
        messages: list[Message] = []
        over, stop = self.tick == self._plan.ticks, min(self._answerable, self.tick + most)
        while self.tick < stop:
            messages += self._answer(stop)
        if self.tick == self._plan.ticks and not over:
            messages += self._finish()
        elif len(self._fate_counts) >= self._batch_ticks:
            messages += self.flush()
        return messages + self._repeat() if self._behind else messages

    def flush(self) -> list[Message]:
        """Hand over the fates that are held back."""
        if not self._fate_counts:
            return []
        counts, self._fate_counts = self._fate_counts, []
        fates, self._fates = self._fates, []
        return [Message(ORCHESTRATOR, Kind.FATES, self.tick - len(counts), codec.encode_fates(counts, fates))]

    def close(self) -> None:
        """Give back the files."""
        for station in self._stations.values():
            if station.replay is not None:
                station.replay.close()

    def _collect(self, envelope: Envelope) -> None:
        """Put a worker's samples where they belong; publish the ticks that become complete."""
        station = self._stations.get(envelope.sender)
        if station is None:
            raise WireError(envelope.sender, "it carries no agents, but sent samples")
        first = envelope.expect(Kind.SAMPLES, station.said).tick
        samples = codec.decode_samples(station.block, envelope)
        if station.replay is not None:
            self._compare(envelope.sender, station.replay, first, samples)
        station.said += len(samples)
        new = samples[max(0, station.samples - first) :]
        station.samples = max(station.samples, station.said)
        if len(new) and self.tick < self._plan.ticks:  # with slack, the last samples are of no consequence
            self._emulator.place(station.said - len(new), rows_of(station.agents), new)
            self._emulator.publish_placed(min(other.samples for other in self._stations.values()))

    @staticmethod
    def _compare(sender: str, replay: Replay, first: int, samples: Floats) -> None:
        """What a worker says must be what whom it replaces has said."""
        for tick, of_tick in enumerate(samples, first):
            if not replay.says(tick, of_tick.data):
                raise WireError(
                    sender,
                    f"the samples of tick {tick} are not those of the worker that it replaces: a component gives "
                    "another result when it is run again; run with 'on_worker_loss: abort'",
                )

    def _take_external(self, envelope: Envelope) -> None:
        """Keep what was taken from outside at a tick until its mail is sent."""
        sizes = [subscription.size for subscription in self._plan.bridge.subscribe]
        taken, rest = codec.decode_external(sizes, envelope.expect(Kind.EXTERNAL, self._next_external))
        if envelope.sender != ORCHESTRATOR or len(rest.body):
            raise WireError(envelope.sender, "it sent values from outside that nobody awaits")
        self._external[self._next_external] = codec.encode_external(taken)
        self._next_external += 1

    @property
    def _answerable(self) -> int:
        """Ticks that can be answered, or have been."""
        return min(self._granted, self._emulator.published + self._emulator.slack)

    def _answer(self, stop: int) -> list[Message]:
        """The mail of one tick at least, up to before `stop`."""
        tick = self.tick
        stretch = self._emulator.exchange_several(tick, min(stop, tick + 1) if self._external else stop)
        external = self._external.pop(tick, [])
        self.tick += stretch.n_ticks
        self._fates.append(stretch.fates)
        self._fate_counts += stretch.fate_counts
        messages: list[Message] = []
        for (name, station), mail in zip(self._stations.items(), stretch.mail, strict=True):
            if station.replay is not None:
                self._keep_mail(station.replay, external, mail, stretch.n_ticks)
            if name not in self._behind:
                station.sent += stretch.n_ticks
                body = [*external, *codec.encode_mail(mail, stretch.n_ticks)]
                messages.append(Message(name, Kind.MAIL, tick, body))
        return messages

    @staticmethod
    def _keep_mail(replay: Replay, external: list[Part], mail: Mail, n_ticks: int) -> None:
        """Keep what a replacement may ask for, tick by tick."""
        n = len(mail) // n_ticks
        for i in range(n_ticks):
            replay.keep([*external, *codec.encode_mail(mail.of(range(i * n, i * n + n)), 1)])

    def _finish(self) -> list[Message]:
        """The last fates, and those of what is still in flight, which go under the last tick."""
        messages = self.flush()
        in_flight = self._emulator.finish()
        fates = codec.encode_fates([len(in_flight)], [in_flight])
        messages.append(Message(ORCHESTRATOR, Kind.FATES, self._plan.ticks, fates))
        return [*messages, Message(ORCHESTRATOR, Kind.DONE, self._plan.ticks)]

    # --- replacements -----------------------------------------------------------------------------------------------
    def _replace(self, envelope: Envelope) -> Message:
        """From now on, a new process stands for a worker; it begins at tick 0. Says that it is expected."""
        tree: dict[str, Any] = codec.decode_object(envelope)
        old, new = str(tree.get("old")), str(tree.get("new"))
        station = self._stations.get(old)
        if station is None or station.replay is None or new in self._stations:
            raise WireError(envelope.sender, f"{new} cannot replace {old}")
        station.said = station.sent = 0
        self._stations = renamed(self._stations, old, new)
        self._replaced.add(old)
        self._behind.discard(old)
        self._behind.add(new)
        return Message(ORCHESTRATOR, Kind.REPLACE, self.tick, list(codec.encode_object({"old": old, "new": new})))

    def _repeat(self) -> list[Message]:
        """The next mail for replacements: never more than they can take, as their samples show."""
        messages = []
        for name in sorted(self._behind):
            station = self._stations[name]
            replay, stop = station.replay, min(self.tick, station.said + _AHEAD_TICKS)
            if replay is None or not station.said:  # it has not begun
                continue
            while station.sent < stop and replay.size(min(station.said, station.sent), station.sent) < _AHEAD_BYTES:
                messages.append(Message(name, Kind.MAIL, station.sent, [replay.mail(station.sent)]))
                station.sent += 1
            if station.sent == self.tick:
                self._behind.discard(name)
        return messages

    # --- accounts ---------------------------------------------------------------------------------------------------
    def _position(self, question: int) -> Message:
        """Who has got how far, for the account of a fault."""
        position = {
            "exchanged": self.tick,
            "granted": self._granted,
            "samples": {name: station.said for name, station in self._stations.items()},
            "mail": {name: station.sent for name, station in self._stations.items()},
        }
        return Message(ORCHESTRATOR, Kind.PONG, question, codec.encode_object(position))
