"""The orchestrator's state: who is ready, which ticks are complete, what failed. Pure: envelopes in, messages out.

The master drives the clock over the workers instead of over the agents; observers are told of exactly what the
in-process run tells them, in the same order, so that the digest is the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.distributed.assignment import EMULATOR, Job, Message, Share, batch_ticks, blocks, window_ticks
from cosim.distributed.failure import Failure
from cosim.inline import Observer, Take
from cosim.master import Finish, Master
from cosim.plan import Plan
from network import codec
from network.messages import Exchange, Fates, Floats, Ints, Mail
from network.transport import Envelope, Kind, WireError

# Samples and mail go from the workers to the emulator and back, without passing through here.
_NO_SAMPLES: Floats = np.zeros((0, 0))
_NOTHING: Ints = np.zeros(0, np.int64)
_NO_MAIL = Mail(np.zeros(1, np.int64), _NOTHING, _NOTHING, _NOTHING, _NO_SAMPLES)


@dataclass(frozen=True)
class Blockage:
    """Who holds everybody up.

    Attributes:
        culprits: processes that could go on and do not; all others wait for them.
        tick: at which the culprits are.
    """

    culprits: tuple[str, ...]
    tick: int


class Orchestration:
    """The call order is `begin`, then `handle` until `finished`; `end` gives the messages that send everybody home.

    Args:
        plan: what runs.
        workers: the agents of every worker.
        observers: told of every tick and every fate, in order.
        take: gives the values from outside that are new at a tick, as in `cosim.inline.run`.
        paced: whether ticks wait for `release`.
    """

    def __init__(
        self,
        plan: Plan,
        workers: Mapping[str, Share],
        observers: Sequence[Observer],
        take: Take | None = None,
        *,
        paced: bool = False,
    ) -> None:
        self._plan = plan
        self._workers = dict(workers)
        self._wire = blocks(plan, workers)
        self._index = {name: index for index, name in enumerate(workers)}
        indices = [agent for share in workers.values() for agent in share]
        numbers = np.repeat(indices, [width for block in self._wire.values() for width in block.widths])
        self._order = None if indices == sorted(indices) else np.argsort(numbers, kind="stable")  # of a row as it comes
        self._observers = observers
        self._take = take
        self._external: list[Message] = []  # what was taken since the last grant
        self._master = Master([0] * len(workers), 0, plan.ticks)
        self._unready = {EMULATOR, *workers}
        self._rows: dict[str, deque[Floats]] = {name: deque() for name in workers}
        self._rows_in = dict.fromkeys(workers, 0)  # ticks of which rows have come
        self._samples_in = dict.fromkeys(workers, 0)  # ticks whose samples the emulator says it has
        self._fates: deque[Fates] = deque()
        self._fates_in = 0
        self._exchanged = 0
        self._paced = paced
        self._granted = -1  # before the first grant
        self.released = -1 if paced else plan.ticks
        """The last tick to which everybody may go."""
        self._rows_done = False  # of the master's tick
        self._failures: dict[str, Failure] = {}
        self._over = False
        self.recorded = -1
        """The last tick that the observers have seen."""
        self.finished = False

    @property
    def processes(self) -> tuple[str, ...]:
        """All but the orchestrator."""
        return (EMULATOR, *self._workers)

    @property
    def unready(self) -> tuple[str, ...]:
        """Processes that have neither prepared nor failed yet."""
        return tuple(name for name in self.processes if name in self._unready)

    @property
    def progress(self) -> tuple[int, ...]:
        """It changes whenever a process gets further."""
        return (len(self._unready), self._exchanged, *(self.position(name) for name in self._workers))

    def position(self, name: str) -> int:
        """The tick at which a process is, as far as is known."""
        if name not in self._workers:
            return self._exchanged
        return max(0, self._rows_in[name] - 1, self._samples_in[name] - 1)

    @property
    def failure(self) -> Failure | None:
        """The failure that the in-process run would have met first, among those known."""
        return min(self._failures.values(), key=lambda failure: failure.rank, default=None)

    def begin(self) -> list[Message]:
        """The job for everybody; all must have joined."""
        job = Job.of(self._plan, self._workers, paced=self._paced).encode()
        return [Message(name, Kind.SCENARIO, 0, job) for name in self.processes]

    def end(self) -> list[Message]:
        """Farewell to everybody."""
        return [Message(name, Kind.BYE, 0) for name in self.processes]

    def handle(self, envelope: Envelope) -> list[Message]:
        """Whatever a message brings.

        Raises:
            WireError: it is not this message's turn, or it does not hold what it should.
            CosimError: an agent failed, as in the in-process run; or an observer did.
        """
        match envelope.kind:
            case Kind.READY:
                self._unready.discard(envelope.sender)
            case Kind.FAILURE:
                self._unready.discard(envelope.sender)
                self._failures[envelope.sender] = Failure.decode(envelope)
            case Kind.ROWS:
                self._take_rows(envelope)
            case Kind.FATES:
                self._take_fates(envelope)
            case Kind.PONG:
                self._take_position(envelope)
            case Kind.DONE | Kind.BYE:
                pass
            case _:
                raise WireError(envelope.sender, f"a {envelope.kind.name} is nothing for the orchestrator")
        if self._unready:
            return []
        if self._granted >= 0:
            self._record()
        self._raise_failure()
        return self._grant()

    def release(self, tick: int) -> list[Message]:
        """The wall clock has come to a tick of a paced run; everybody must be ready."""
        self.released = max(self.released, min(tick, self._plan.ticks))
        return self._grant()

    # --- what comes in ----------------------------------------------------------------------------------------------
    def _take_rows(self, envelope: Envelope) -> None:
        name = envelope.sender
        if name not in self._workers:
            raise WireError(name, "it carries no agents, but sent rows")
        envelope.expect(Kind.ROWS, self._rows_in[name])
        rows = codec.decode_rows(self._wire[name], envelope)
        self._rows[name].extend(rows)
        self._rows_in[name] += len(rows)

    def _take_fates(self, envelope: Envelope) -> None:
        if envelope.sender != EMULATOR:
            raise WireError(envelope.sender, "it is no emulator, but sent fates")
        envelope.expect(Kind.FATES, self._fates_in)
        fates = codec.decode_fates(len(self._plan.agents), envelope)
        self._fates.extend(fates)
        self._fates_in += len(fates)
        self._exchanged = max(self._exchanged, min(self._fates_in, self._plan.ticks))

    def _take_position(self, envelope: Envelope) -> None:
        """The emulator's account of who has got how far."""
        tree: dict[str, Any] = codec.decode_object(envelope)
        try:
            self._exchanged = max(self._exchanged, int(tree["exchanged"]))
            for name, count in zip(self._workers, tree["samples"], strict=True):
                self._samples_in[name] = max(self._samples_in[name], int(count))
        except (ValueError, KeyError, TypeError) as error:
            raise WireError(envelope.sender, f"a position that cannot be read: {error!r}") from error

    # --- what comes of it -------------------------------------------------------------------------------------------
    def _record(self) -> None:
        """Tell the observers of all that is complete, in order."""
        while not self.finished:
            if not self._rows_done:
                if not all(self._rows.values()):
                    return
                self._record_rows()
            if not self._fates:
                return
            fates = self._fates.popleft()
            for observer in self._observers:
                observer.fates(fates)
            if self._over:
                self.finished = True
            else:
                self._master.exchanged(Exchange(self._master.tick, _NO_MAIL, fates))
                self._rows_done = False

    def _record_rows(self) -> None:
        tick = self._master.tick
        for index in self._index.values():
            self._over = isinstance(self._master.published(index, tick, _NO_SAMPLES), Finish)
        row = np.concatenate([self._rows[name].popleft() for name in self._index])
        if self._order is not None:
            row = row[self._order]
        for observer in self._observers:
            observer.tick(tick, row)
        self.recorded = tick
        self._rows_done = True
        if self._plan.bridge.subscribe and not self._over:
            taken = self._take(tick) if self._take is not None else {}
            self._external.append(Message(EMULATOR, Kind.EXTERNAL, tick, codec.encode_external(taken)))

    def _raise_failure(self) -> None:
        """Raise the first failure once nobody can come to an earlier one, and all before it is recorded."""
        failure = self.failure
        if failure is None:
            return
        if failure.tick < 0:
            raise failure.error
        all_before = self._master.tick > failure.tick and not self._rows_done
        earlier = (name for name, share in self._workers.items() if share[0] < failure.agent)
        if all_before and all(name in self._failures or self._rows[name] for name in earlier):
            raise failure.error

    def _grant(self) -> list[Message]:
        """Let the emulator go on, and everybody begin."""
        tick = min(self.recorded + 1 + window_ticks(self._plan), self.released)
        if tick < 0:
            return []
        if self._granted < 0:
            self._granted = tick
            return [Message(name, Kind.GRANT, tick) for name in (*self._workers, EMULATOR)]
        enough = 1 if self._paced else batch_ticks(self._plan)
        if tick - self._granted >= enough or (tick == self._plan.ticks > self._granted):
            self._granted = tick
            external, self._external = self._external, []
            return [*external, Message(EMULATOR, Kind.GRANT, tick)]
        return []

    def blockage(self) -> Blockage:
        """Who holds everybody up, as far as is known: whoever has all it needs for its next step."""
        if self._unready:
            tick = 0
            culprits = self.unready
        else:
            computing = {
                name: self.position(name)
                for name in self._workers
                if self.position(name) < min(self._exchanged, self._plan.ticks) or not self._rows_in[name]
            }
            tick = min(computing.values(), default=self._exchanged)
            culprits = tuple(name for name, at in computing.items() if at == tick) or (EMULATOR,)
        return Blockage(culprits, tick)
