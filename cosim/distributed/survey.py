"""How far everybody is, and who waits for whom. Pure.

The orchestrator asks in rounds (PING, PONG). All messages between two processes keep their order, and all pass through
the hub: so what was sent before an answer to one round was given has arrived before the question of the next.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.distributed.assignment import EMULATOR, Message
from network import codec
from network.transport import Envelope, Kind, WireError


@dataclass(frozen=True)
class Position:
    """What a process says of itself.

    Attributes:
        tick: a worker's; for the emulator, the ticks answered.
        samples: ticks whose samples are published; for the emulator, that have come, by worker.
        mail: ticks whose mail has come; for the emulator, that has been sent, by worker.
    """

    tick: int
    samples: Mapping[str, int]
    mail: Mapping[str, int]

    @classmethod
    def decode(cls, envelope: Envelope) -> Position:
        """The position in a PONG.

        Raises:
            WireError: there is none.
        """
        tree: dict[str, Any] = codec.decode_object(envelope)
        try:
            if envelope.sender == EMULATOR:
                counts = ({str(k): int(v) for k, v in tree[key].items()} for key in ("samples", "mail"))
                return cls(int(tree["exchanged"]), *counts)
            return cls(int(tree["tick"]), *({envelope.sender: int(tree[key])} for key in ("samples", "mail")))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise WireError(envelope.sender, f"a position that cannot be read: {error!r}") from error


@dataclass(frozen=True)
class Lost:
    """A message that was sent and did not arrive."""

    kind: Kind
    tick: int
    sender: str
    receiver: str


class Survey:
    """The answers to the last two rounds."""

    def __init__(self) -> None:
        self._round = 0
        self._before: dict[str, Position] = {}  # in hand when this round began
        self._answers: dict[str, Position] = {}

    @property
    def answered(self) -> frozenset[str]:
        """Who has answered this round: none of them is at work."""
        return frozenset(self._answers)

    def settled(self, names: Iterable[str]) -> bool:
        """Whether all of these have said the same in both rounds."""
        return self._answers == self._before and self._answers.keys() >= set(names)

    def ask(self, names: Iterable[str]) -> list[Message]:
        """Begin a round."""
        self._round += 1
        self._before, self._answers = self._answers, {}
        return [Message(name, Kind.PING, self._round) for name in names]

    def take(self, envelope: Envelope) -> Position:
        """An answer; a late one counts for no round.

        Raises:
            WireError: it cannot be read.
        """
        position = Position.decode(envelope)
        if envelope.tick == self._round:
            self._answers[envelope.sender] = position
        return position

    def lost(self, workers: Sequence[str]) -> Lost | None:
        """A message that cannot be under way any more, and has not arrived."""
        for name in workers:
            emulator, worker = self._before.get(EMULATOR), self._answers.get(name)
            if emulator is not None and worker is not None and emulator.mail.get(name, 0) > worker.mail[name]:
                return Lost(Kind.MAIL, worker.mail[name], EMULATOR, name)
            emulator, worker = self._answers.get(EMULATOR), self._before.get(name)
            if emulator is not None and worker is not None:
                arrived = emulator.samples.get(name, worker.samples[name])
                if worker.samples[name] > arrived:
                    return Lost(Kind.SAMPLES, arrived, name, EMULATOR)
        return None
