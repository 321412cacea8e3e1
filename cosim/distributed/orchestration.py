"""The orchestrator's state: who is ready, which ticks are complete, what failed. Pure: envelopes in, messages out.

The master drives the clock over the workers instead of over the agents; observers are told of exactly what the
in-process run tells them, in the same order, so that the digest is the same.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cosim.agents.step_control import StepAccount
from cosim.distributed.assignment import EMULATOR, Job, Message, Share, batch_ticks, blocks, renamed, window_ticks
from cosim.distributed.failure import Failure
from cosim.distributed.incoming import FateLog, Rows
from cosim.distributed.replacement import History, Moment
from cosim.distributed.standing import Standing, carried
from cosim.distributed.survey import Lost, Survey
from cosim.errors import ClusterError, CosimError, RunEndedError
from cosim.master import Finish, Master
from cosim.plan import Plan
from cosim.running.inline import Observer, Take, tell, tell_of_steps
from network import codec
from network.codec import Block, encode_object
from network.emulator import Emulator
from network.messages import Exchange, Fates, Floats, Ints, Mail
from network.transport import Envelope, Kind, WireError

# Samples and mail go from the workers to the emulator and back, without passing through here.
_NO_SAMPLES: Floats = np.zeros((0, 0))
_NOTHING: Ints = np.zeros(0, np.int64)
_NO_MAIL = Mail(np.zeros(1, np.int64), _NOTHING, _NOTHING, _NOTHING, _NO_SAMPLES)


@dataclass
class _Carrier:
    """A worker, as the orchestrator sees it.

    Attributes:
        agents: that it carries.
        block: what both ends know of them.
        history: of it and of those whom it replaces.
        rows: that are not recorded yet, tick by tick.
        rows_in: ticks whose rows have come, from it or from whom it replaces.
        said: ticks whose rows this very process has sent.
        tick: that this process is at, as far as is known.
        samples: ticks whose samples the emulator has from this process, as far as is known.
        behind: for a replacement, the tick at which it has caught up; None while that is not known.
    """

    agents: Share
    block: Block
    history: History
    rows: Rows = field(default_factory=Rows)
    rows_in: int = 0
    said: int = 0
    tick: int = 0
    samples: int = 0
    behind: int | None = None
    failure: Failure | None = None

    def begin_again(self) -> None:
        """Another process stands for this worker; it begins at tick 0."""
        self.said = self.tick = self.samples = 0
        self.behind = self.failure = None


class Orchestration:
    """The call order is `begin`, then `handle` until `finished`; `end` gives the messages that send everybody home.

    Args:
        plan: what runs.
        workers: the agents of every worker.
        observers: told of every tick and every fate, in order.
        take: gives the values from outside that are new at a tick, as in `cosim.running.inline.run`.
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
        wire = blocks(plan, workers)
        self._carriers = {name: _Carrier(agents, wire[name], History(name)) for name, agents in workers.items()}
        indices = [agent for share in workers.values() for agent in share]
        numbers = np.repeat(indices, [width for block in wire.values() for width in block.widths])
        self._order = None if indices == sorted(indices) else np.argsort(numbers, kind="stable")  # of a row as it comes
        self._observers = observers
        self._take = take
        self._external: list[Message] = []  # what was taken since the last grant
        self._master = Master([0], 0, plan.ticks)
        self._unready = {EMULATOR, *workers}
        self._unexpected: set[str] = set()  # replacements of which the emulator does not know yet
        self._hired: list[str] = []  # replacements that have not begun
        self._employed: list[str] = []  # processes that have their job
        self._replaced: set[str] = set()
        self._caught_up: list[tuple[str, int]] = []
        self._survey = Survey()
        self._fates = FateLog()
        self._fates_in = 0
        self._exchanged = 0
        self._paced = paced
        self._granted = -1  # before the first grant
        self.released = -1 if paced else plan.ticks
        """The last tick to which everybody may go."""
        self._rows_done = False  # of the master's tick
        self._over = False
        self.recorded = -1
        """The last tick that the observers have seen."""
        self._recorded_all = False
        self._controlled = {agent.name for agent in plan.agents if agent.coupling.control is not None}
        self._accounts: dict[str, StepAccount] = {}
        self.finished = False

    @property
    def workers(self) -> dict[str, Share]:
        """The agents of every worker, by the name of the process that carries them now."""
        return {name: carrier.agents for name, carrier in self._carriers.items()}

    @property
    def processes(self) -> tuple[str, ...]:
        """All but the orchestrator."""
        return (EMULATOR, *self._carriers)

    @property
    def unready(self) -> tuple[str, ...]:
        """Processes that have neither prepared nor failed yet."""
        return tuple(name for name in self.processes if name in self._unready)

    @property
    def progress(self) -> tuple[object, ...]:
        """It changes whenever a process gets further."""
        positions = [(name, self.position(name)) for name in self._carriers]
        return (len(self._unready), len(self._unexpected), self._exchanged, self.recorded, positions)

    def position(self, name: str) -> int:
        """The tick at which a process is, as far as is known."""
        carrier = self._carriers.get(name)
        return self._exchanged if carrier is None else max(carrier.said - 1, carrier.samples - 1, carrier.tick)

    @property
    def failure(self) -> Failure | None:
        """The failure that the in-process run would have met first, among those known."""
        known = (carrier.failure for carrier in self._carriers.values() if carrier.failure is not None)
        return min(known, key=lambda failure: failure.rank, default=self._other_failure)

    _other_failure: Failure | None = None  # of the emulator

    def begin(self) -> list[Message]:
        """The job for everybody; all must have joined."""
        return self.employ(self.processes)

    def employ(self, names: Iterable[str]) -> list[Message]:
        """The job for processes that have joined."""
        names, job = list(names), Job.of(self._plan, self.workers, paced=self._paced).encode()
        self._employed += names
        return [Message(name, Kind.SCENARIO, 0, job) for name in names]

    def end(self, why: str = "", *, regular: bool = False) -> list[Message]:
        """Farewell to everybody; `why` the run ends before its end, and whether an agent asked for that."""
        body = encode_object({"message": why, "regular": regular}) if why else ()
        return [Message(name, Kind.BYE, 0, body) for name in self.processes]

    def handle(self, envelope: Envelope) -> list[Message]:
        """Whatever a message brings.

        Raises:
            WireError: it is not this message's turn, or it does not hold what it should.
            CosimError: an agent failed, as in the in-process run; or an observer did.
        """
        if envelope.sender in self._replaced:  # what was under way when it was lost
            return []
        match envelope.kind:
            case Kind.READY:
                self._unready.discard(envelope.sender)
            case Kind.FAILURE:
                self._take_failure(envelope)
            case Kind.ROWS:
                self._take_rows(envelope)
            case Kind.FATES:
                self._take_fates(envelope)
            case Kind.PONG:
                self._take_position(envelope)
            case Kind.REPLACE:
                self._take_expectation(envelope)
            case Kind.DONE:
                self._take_account(envelope)
            case Kind.BYE:
                pass
            case _:
                raise WireError(envelope.sender, f"a {envelope.kind.name} is nothing for the orchestrator")
        if self._granted < 0 and (self._unready or self._unexpected):
            return []
        if self._granted >= 0:
            self._record()
        self._finish()
        self._raise_failure()
        return self._grant()

    def release(self, tick: int) -> list[Message]:
        """The wall clock has come to a tick of a paced run; everybody must be ready."""
        self.released = max(self.released, min(tick, self._plan.ticks))
        return [] if self._unready or self._unexpected else self._grant()

    # --- what comes in ----------------------------------------------------------------------------------------------
    def _take_failure(self, envelope: Envelope) -> None:
        name, failure = envelope.sender, Failure.decode(envelope)
        self._unready.discard(name)
        carrier = self._carriers.get(name)
        if carrier is None:
            self._other_failure = failure
        elif name in self._hired and self._granted >= 0:
            raise ClusterError(f"{name} cannot replace a lost worker: {failure.error}")
        else:
            carrier.failure = failure

    def _take_rows(self, envelope: Envelope) -> None:
        carrier = self._carriers.get(envelope.sender)
        if carrier is None:
            raise WireError(envelope.sender, "it carries no agents, but sent rows")
        first = envelope.expect(Kind.ROWS, carrier.said).tick
        rows = codec.decode_rows(carrier.block, envelope)
        carrier.said += len(rows)
        carrier.rows.extend(rows[max(0, carrier.rows_in - first) :])
        carrier.rows_in = max(carrier.rows_in, carrier.said)
        self._look_whether_caught_up(envelope.sender, carrier)

    def _take_fates(self, envelope: Envelope) -> None:
        if envelope.sender != EMULATOR:
            raise WireError(envelope.sender, "it is no emulator, but sent fates")
        envelope.expect(Kind.FATES, self._fates_in)
        counts, fates = codec.decode_fates(len(self._plan.agents), envelope)
        self._fates.extend(counts, fates)
        self._fates_in += len(counts)
        self._exchanged = max(self._exchanged, min(self._fates_in, self._plan.ticks))

    def _take_position(self, envelope: Envelope) -> None:
        position = self._survey.take(envelope)
        if envelope.sender == EMULATOR:
            self._exchanged = max(self._exchanged, position.tick)
            for name, count in position.samples.items():
                if name in self._carriers:
                    self._carriers[name].samples = max(self._carriers[name].samples, count)
        elif envelope.sender in self._carriers:
            self._carriers[envelope.sender].tick = position.tick

    def _take_account(self, envelope: Envelope) -> None:
        """A process has done its part; a worker says what became of steps that are controlled."""
        if envelope.sender not in self._carriers or not len(envelope.body):
            return
        try:
            told = codec.decode_object(envelope).get("steps")
            accounts = [StepAccount.of(one) for one in told if isinstance(one, dict)] if isinstance(told, list) else []
        except ValueError as error:
            raise WireError(envelope.sender, f"what it says of its steps cannot be read: {error}") from None
        self._accounts |= {account.agent: account for account in accounts}

    def _take_expectation(self, envelope: Envelope) -> None:
        """The emulator expects a replacement."""
        name = str(codec.decode_object(envelope).get("new"))
        if envelope.sender != EMULATOR:
            raise WireError(envelope.sender, "it is no emulator, but expects a replacement")
        self._unexpected.discard(name)
        if name in self._carriers:
            self._carriers[name].behind = envelope.tick

    # --- what comes of it -------------------------------------------------------------------------------------------
    def _record(self) -> None:
        """Tell the observers of all that is complete, in order."""
        while not self._recorded_all:
            if not self._rows_done:
                if not all(carrier.rows for carrier in self._carriers.values()):
                    return
                if self._record_course():
                    continue
                self._record_rows()
            if not self._fates:
                return
            _, fates = self._fates.take(1)
            for observer in self._observers:
                observer.fates(fates)
            if self._over:
                self._recorded_all = True
            else:
                self._master.exchanged(Exchange(self._master.tick, _NO_MAIL, fates))
                self._rows_done = False

    def _finish(self) -> None:
        """All is recorded, and all accounts of steps are there."""
        if self.finished or not self._recorded_all or not self._controlled <= self._accounts.keys():
            return
        names = [agent.name for agent in self._plan.agents]
        tell_of_steps(self._observers, [self._accounts[name] for name in names if name in self._accounts])
        self.finished = True

    def _record_course(self) -> bool:
        """Tell them of all ticks of which rows and fates are there, if there are several before the last."""
        if self._plan.bridge.subscribe:  # values are taken at every tick
            return False
        first = self._master.tick
        there = min(len(self._fates), *(len(carrier.rows) for carrier in self._carriers.values()))
        n_ticks = min(there, self._plan.ticks - first)
        if n_ticks < 2:
            return False
        rows = self._rows(n_ticks)
        counts, fates = self._fates.take(n_ticks)
        for tick in range(first, first + n_ticks):
            self._master.published(0, tick, _NO_SAMPLES)
            self._master.exchanged(Exchange(tick, _NO_MAIL, fates))
        tell(self._observers, first, rows, fates, counts)
        self.recorded = first + n_ticks - 1
        return True

    def _rows(self, n_ticks: int) -> Floats:
        """(n_ticks, width) the next rows of all agents, in the order of the file."""
        rows = np.concatenate([carrier.rows.take(n_ticks) for carrier in self._carriers.values()], axis=1)
        return rows if self._order is None else rows[:, self._order]

    def _record_rows(self) -> None:
        tick = self._master.tick
        self._over = isinstance(self._master.published(0, tick, _NO_SAMPLES), Finish)
        (row,) = self._rows(1)
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
            raise failure.error if self._granted < 0 else self._with_tick(failure)
        all_before = self._master.tick > failure.tick and not self._rows_done
        earlier = (carrier for carrier in self._carriers.values() if carrier.agents[0] < failure.agent)
        if all_before and all(carrier.failure or carrier.rows for carrier in earlier):
            if isinstance(failure.error, RunEndedError):
                in_flight = _in_flight(self._plan, self._master.tick)
                for observer in self._observers:
                    observer.fates(in_flight)
            raise failure.error

    def _with_tick(self, failure: Failure) -> CosimError:
        """The failure of a process, rather than of an agent, in the midst of a run."""
        text = f"{failure.error}; tick {self.recorded} is the last one recorded"
        if failure.about in self._carriers:
            text = f"{text}\n  {carried(self._plan, failure.about, self.workers)} sent it"
        return ClusterError(text)

    def _grant(self) -> list[Message]:
        """Let the emulator go on, and whoever is ready begin."""
        tick = min(self.recorded + 1 + window_ticks(self._plan), self.released)
        if tick < 0:
            return []
        if self._granted < 0:
            self._granted = tick
            self._hired.clear()
            return [Message(name, Kind.GRANT, tick) for name in (*self._carriers, EMULATOR)]
        begin = [name for name in self._hired if name not in self._unready | self._unexpected]
        self._hired = [name for name in self._hired if name not in begin]
        messages = [Message(name, Kind.GRANT, tick) for name in begin]
        enough = 1 if self._paced else batch_ticks(self._plan)
        if tick - self._granted >= enough or (tick == self._plan.ticks > self._granted):
            self._granted = tick
            external, self._external = self._external, []
            messages += [*external, Message(EMULATOR, Kind.GRANT, tick)]
        return messages

    # --- replacements -----------------------------------------------------------------------------------------------
    def why_not_replaced(self, name: str, moment: Moment) -> str | None:
        """Why a worker that is lost cannot be replaced, to follow its name; None if it can."""
        histories = [carrier.history for carrier in self._carriers.values()]
        return self._carriers[name].history.objection(moment, histories)

    def replace(self, name: str, moment: Moment) -> tuple[str, list[Message]]:
        """Another process shall stand for a lost worker.

        Args:
            name: of the worker.
            moment: at which it was lost.

        Returns:
            The name of the process to start, and what to send. When it has joined, it is to be employed.
        """
        new = self._carriers[name].history.lost(moment, self._replaced.union(self._carriers))
        self._carriers = renamed(self._carriers, name, new)
        self._carriers[new].begin_again()
        self._replaced.add(name)
        self._unready.discard(name)
        self._unexpected.discard(name)
        self._hired = [other for other in self._hired if other != name]
        self._unready.add(new)
        self._hired.append(new)
        if EMULATOR not in self._employed:  # it will be told with its job
            return new, []
        self._unexpected.add(new)
        return new, [Message(EMULATOR, Kind.REPLACE, 0, encode_object({"old": name, "new": new}))]

    @property
    def unemployed(self) -> tuple[str, ...]:
        """Processes that have no job yet."""
        return tuple(name for name in self.processes if name not in self._employed)

    def behind(self) -> list[tuple[str, int, int]]:
        """Replacements that are catching up: name, tick, and the tick that they must get to."""
        return [
            (name, self.position(name), carrier.behind)
            for name, carrier in self._carriers.items()
            if carrier.behind is not None
        ]

    def caught_up(self) -> list[tuple[str, int]]:
        """Replacements that have caught up since the last call, and at which tick."""
        caught_up, self._caught_up = self._caught_up, []
        return caught_up

    def _look_whether_caught_up(self, name: str, carrier: _Carrier) -> None:
        if carrier.behind is not None and self.position(name) >= carrier.behind:
            self._caught_up.append((name, carrier.behind))
            carrier.behind = None

    # --- accounts ---------------------------------------------------------------------------------------------------
    def ask(self) -> list[Message]:
        """Ask everybody how far they are."""
        return self._survey.ask(name for name in self.processes if name in self._employed)

    def all_answered(self, but: Collection[str]) -> bool:
        """Whether everybody else has answered the last question."""
        return self._survey.answered >= set(self._employed).intersection(self.processes).difference(but)

    def settled(self, but: Collection[str]) -> bool:
        """Whether nobody else has got any further between the last two questions."""
        return self._survey.settled(set(self._employed).intersection(self.processes).difference(but))

    def lost_message(self) -> Lost | None:
        """A message that was sent and did not arrive, as the last answers show."""
        at_work = [name for name, carrier in self._carriers.items() if carrier.failure is None]
        return self._survey.lost(at_work)

    def standing(self) -> Standing:
        """How far everybody is."""
        return Standing(
            ready=self._granted >= 0,
            released=self._granted,
            exchanged=self._exchanged,
            ticks={name: self.position(name) for name in self._carriers},
            samples={name: carrier.samples for name, carrier in self._carriers.items()},
            idle=self._survey.answered,
        )


def _in_flight(plan: Plan, stop: int) -> Fates:
    """The messages under way at a tick that the emulator may have passed: all are routed once more."""
    emulator = Emulator(plan.links, plan.channels, plan.link_channel, plan.layout, plan.seed, plan.period_ns)
    nothing = np.zeros((len(plan.agents), plan.layout.width))
    for tick in range(stop):
        emulator.emulate(tick, nothing)
    return emulator.finish()
