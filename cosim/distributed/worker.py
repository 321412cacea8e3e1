"""A worker: carries some of the agents. Pure given their components: envelopes in, messages out.

It publishes tick 0 when it is granted to begin, advances its agents over the ticks whose mail has come in, and hands
over what is recorded in batches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cosim.agents.group import NOTHING, Agents
from cosim.agents.step_control import manifest
from cosim.attention import TICK, idle
from cosim.distributed.assignment import EMULATOR, ORCHESTRATOR, Message, Share, batch_ticks, blocks, pick
from cosim.distributed.failure import INITIALISING, OPENING, Failure
from cosim.errors import ConfigError, RunError
from cosim.logs import NO_LOGS, Logs
from cosim.plan import AgentPlan, Plan
from network import codec
from network.messages import Floats, Ints, Mail
from network.transport import Envelope, Kind, WireError


@dataclass(frozen=True)
class _Mail:
    """Mail of some ticks.

    Attributes:
        taken: values from outside that are new at the first of them.
    """

    tick: int
    n_ticks: int
    mail: Mail
    taken: Mapping[int, Floats]

    def split(self, n: int, n_agents: int) -> tuple[_Mail, _Mail]:
        """That of the first `n` ticks, and the rest."""
        begin, end = n * n_agents, self.n_ticks * n_agents
        first = _Mail(self.tick, n, self.mail.of(range(begin)), self.taken)
        return first, _Mail(self.tick + n, self.n_ticks - n, self.mail.of(range(begin, end)), NOTHING)


class Worker:
    """See `cosim.distributed.serving.Machine`.

    Args:
        plan: of the whole run.
        name: of this worker.
        workers: the agents of every worker.
        whereabouts: kept up to date; see `cosim.attention`. Where the tick is `OPENING` or `INITIALISING`, it is that.
        logs: where what the components log goes.
    """

    def __init__(
        self, plan: Plan, name: str, workers: Mapping[str, Share], whereabouts: Ints | None = None, logs: Logs = NO_LOGS
    ) -> None:
        self._plan = plan
        self._share = workers[name]
        self._batch_ticks = batch_ticks(plan)
        self._agents: Agents | None = None
        self._wire = blocks(plan, workers)[name]
        self._sizes = [subscription.size for subscription in plan.bridge.subscribe]
        self._rows: list[Floats] = []  # (n_ticks, row_width) pieces that are held back
        self._mail: deque[_Mail] = deque()  # that has come
        self._mail_in = 0  # ticks whose mail has come
        self.tick = 0
        self._whereabouts = idle() if whereabouts is None else whereabouts
        self._logs = logs
        self._started = self._failed = False
        self.finished = False

    @property
    def _own(self) -> Sequence[AgentPlan]:
        return pick(self._plan.agents, self._share)

    @property
    def holds_back(self) -> bool:
        """Whether `flush` would send something."""
        return bool(self._rows)

    @property
    def busy(self) -> bool:
        """Whether `act` would do something."""
        return bool(self._mail) and not self._failed

    def prepare(self) -> list[Message]:
        """Open the agents and bring them to tick 0."""
        self._whereabouts[TICK] = OPENING
        try:
            self._agents = Agents(self._plan, self._own, self._whereabouts, self._logs)
        except (RunError, ConfigError) as error:
            return self._fail(Failure(OPENING, self._index_of(error), error))
        self._whereabouts[TICK] = INITIALISING
        try:
            self._agents.initialise()
        except RunError as error:
            return self._fail(Failure(INITIALISING, self._index_of(error), error))
        self._whereabouts[TICK] = 0
        return [Message(ORCHESTRATOR, Kind.READY, 0)]

    def take(self, envelope: Envelope) -> list[Message]:
        """Whatever a message asks for; mail is kept for `act`.

        Raises:
            WireError: it is not this message's turn, or it does not hold what it should.
        """
        if envelope.kind is Kind.BYE and envelope.sender == ORCHESTRATOR:
            self.finished = True
            return []
        if envelope.kind is Kind.PING:
            return [*self.flush(), self._position(envelope.tick)]
        if self._failed:  # what was under way when it failed
            return []
        if not self._started:
            envelope.expect(Kind.GRANT)
            self._started = True
            return self._publish([self._opened.samples()[None]], [self._opened.row()[None]])
        self._take_mail(envelope.expect(Kind.MAIL, self._mail_in))
        return []

    def act(self, most: int) -> list[Message]:
        """Advance over ticks whose mail has come, `most` at most."""
        samples: list[Floats] = []
        rows: list[Floats] = []
        error: RunError | None = None
        while self._mail and error is None and most > 0:
            mail = self._mail.popleft()
            if mail.n_ticks > most:
                mail, rest = mail.split(most, len(self._share))
                self._mail.appendleft(rest)
            most -= mail.n_ticks
            course = self._opened.advance_several(mail.tick, mail.n_ticks, mail.mail, mail.taken)
            self.tick += len(course)
            samples.append(course.samples)
            rows.append(course.rows)
            error = course.error
        self._whereabouts[TICK] = self.tick
        messages = self._publish(samples, rows)
        return messages if error is None else messages + self._fail(Failure(self.tick, self._index_of(error), error))

    def flush(self) -> list[Message]:
        """Hand over the rows that are held back."""
        if not self._rows:
            return []
        rows, self._rows = self._rows, []
        first = self.tick + 1 - sum(map(len, rows))
        return [Message(ORCHESTRATOR, Kind.ROWS, first, codec.encode_rows(self._wire, rows))]

    def close(self) -> None:
        """End all agents."""
        if self._agents is not None:
            self._agents.terminate()

    def _take_mail(self, envelope: Envelope) -> None:
        tick, taken = self._mail_in, NOTHING
        if self._sizes:
            taken, envelope = codec.decode_external(self._sizes, envelope)
        n_ticks, mail = codec.decode_mail(self._wire, envelope)
        if tick + n_ticks > self._plan.ticks:
            raise WireError(envelope.sender, f"mail of tick {self._plan.ticks}, at which the run ends")
        self._mail.append(_Mail(tick, n_ticks, mail, taken))
        self._mail_in += n_ticks

    def _publish(self, samples: list[Floats], rows: list[Floats]) -> list[Message]:
        """The samples of the ticks up to the current one, and the rows if there are enough."""
        n_ticks = sum(map(len, rows))
        if not n_ticks:
            return []
        self._rows += rows
        first, over = self.tick - n_ticks + 1, self.tick == self._plan.ticks
        if over:  # nobody hears the last ones
            samples[-1] = samples[-1][:-1]
        messages = []
        if n_ticks > over:
            messages.append(Message(EMULATOR, Kind.SAMPLES, first, codec.encode_samples(self._wire, samples)))
        if over or sum(map(len, self._rows)) >= self._batch_ticks:
            messages += self.flush()
        return [*messages, self._done()] if over else messages

    def _done(self) -> Message:
        """The last tick is behind it; what became of its agents' steps, where they are controlled."""
        accounts = manifest(self._opened.accounts())
        return Message(ORCHESTRATOR, Kind.DONE, self.tick, codec.encode_object({"steps": accounts}) if accounts else ())

    def _position(self, question: int) -> Message:
        """How far it is, for the account of a fault; all that it has published is sent."""
        published = min(self.tick + 1, self._plan.ticks) if self._started else 0
        position = {"tick": self.tick, "mail": self._mail_in, "samples": published}
        return Message(ORCHESTRATOR, Kind.PONG, question, codec.encode_object(position))

    def _fail(self, failure: Failure) -> list[Message]:
        self._failed = True
        return [*self.flush(), Message(ORCHESTRATOR, Kind.FAILURE, max(0, failure.tick), failure.encode())]

    @property
    def _opened(self) -> Agents:
        """The agents, once they are prepared."""
        assert self._agents is not None
        return self._agents

    def _index_of(self, error: RunError | ConfigError) -> int:
        """The agent that an error is about; the first, if it does not say."""
        return next(
            (agent.index for agent in self._own if isinstance(error, RunError) and agent.name == error.agent),
            self._share[0],
        )
