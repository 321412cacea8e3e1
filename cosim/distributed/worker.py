"""A worker: carries some of the agents. Pure given their components: envelopes in, messages out.

It publishes tick 0 when it is granted to begin, advances its agents whenever the mail of a tick comes in, and hands
over what is recorded in batches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.agents import Agents
from cosim.distributed.assignment import EMULATOR, ORCHESTRATOR, Message, Share, batch_ticks, blocks, pick
from cosim.distributed.failure import INITIALISING, OPENING, Failure
from cosim.errors import ConfigError, RunError
from cosim.logs import NO_LOGS, Logs
from cosim.plan import AgentPlan, Plan
from network import codec
from network.messages import Floats, Ints, Mail
from network.transport import Envelope, Kind, WireError


class Worker:
    """The call order is `prepare`, then `handle` and `flush` as they come until `finished`, then `close`.

    Args:
        plan: of the whole run.
        name: of this worker.
        workers: the agents of every worker.
        whereabouts: (2,) kept up to date for whoever looks at it from outside: the tick, and which of its agents is
            being advanced from it, -1 for none. Where the tick is `OPENING` or `INITIALISING`, it is that.
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
        self._rows: list[Floats] = []
        self._tick = 0
        self._whereabouts = np.zeros(2, np.int64) if whereabouts is None else whereabouts
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

    def prepare(self) -> list[Message]:
        """Open the agents and bring them to tick 0."""
        self._whereabouts[:] = OPENING, -1
        try:
            self._agents = Agents(self._plan, self._own, self._whereabouts[1:], self._logs)
        except (RunError, ConfigError) as error:
            return self._fail(Failure(OPENING, self._index_of(error), error))
        self._whereabouts[0] = INITIALISING
        try:
            self._agents.initialise()
        except RunError as error:
            return self._fail(Failure(INITIALISING, self._index_of(error), error))
        self._whereabouts[0] = 0
        return [Message(ORCHESTRATOR, Kind.READY, 0)]

    def handle(self, envelope: Envelope) -> list[Message]:
        """Whatever a message asks for.

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
            return self._publish()
        envelope.expect(Kind.MAIL, self._tick)
        if self._tick == self._plan.ticks:
            raise WireError(envelope.sender, f"mail of tick {self._tick}, at which the run ends")
        taken: Mapping[int, Floats] = {}
        if self._sizes:
            taken, envelope = codec.decode_external(self._sizes, envelope)
        return self._advance(codec.decode_mail(self._wire, envelope), taken)

    def flush(self) -> list[Message]:
        """Hand over the rows that are held back."""
        if not self._rows:
            return []
        rows, self._rows = self._rows, []
        first = self._tick + 1 - len(rows)
        return [Message(ORCHESTRATOR, Kind.ROWS, first, codec.encode_rows(self._wire, rows))]

    def close(self) -> None:
        """End all agents."""
        if self._agents is not None:
            self._agents.terminate()

    def _advance(self, mail: Mail, taken: Mapping[int, Floats]) -> list[Message]:
        try:
            self._opened.advance(self._tick, mail, taken)
        except RunError as error:
            return self._fail(Failure(self._tick, self._index_of(error), error))
        self._tick += 1
        self._whereabouts[0] = self._tick
        return self._publish()

    def _publish(self) -> list[Message]:
        """The sample of the current tick, and the rows if there are enough."""
        agents = self._opened
        self._rows.append(agents.row())
        if self._tick == self._plan.ticks:
            return [*self.flush(), Message(ORCHESTRATOR, Kind.DONE, self._tick)]
        samples = codec.encode_samples(self._wire, agents.samples())
        messages = [Message(EMULATOR, Kind.SAMPLES, self._tick, samples)]
        return messages + self.flush() if len(self._rows) >= self._batch_ticks else messages

    def _position(self, question: int) -> Message:
        """How far it is, for the account of a fault."""
        published = min(self._tick + 1, self._plan.ticks) if self._started else 0
        position = {"tick": self._tick, "samples": published}
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
