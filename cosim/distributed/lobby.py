"""Who has come to a run that people start by hand, process by process. Pure: envelopes in, messages out.

A process claims its part and is offered what will be run; it gets hold of the files, plans, and says that it is
prepared. The run can begin when the emulator and the workers of all agents are. Until then anybody may leave again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from cosim.distributed.assignment import EMULATOR, ORCHESTRATOR, Message, Share, share_of
from cosim.distributed.failure import Failure
from cosim.distributed.files import Stock
from cosim.errors import CosimError, suggest
from cosim.plan import Plan
from cosim.scenario.names import agent_names, in_short
from network.codec import decode_object, encode_object
from network.transport import Envelope, Kind, WireError

_DASHED = re.compile(r"(\D*)(\d+)-(\d+)")


@dataclass
class _Guest:
    share: Share
    where: str
    prepared: bool = False


class Refusal(Exception):  # noqa: N818 - it is one
    """Why a process cannot have what it claims."""


@dataclass(frozen=True)
class Claim:
    """What a process says of itself.

    Attributes:
        version: of netcosim.
        where: it runs.
        agents: that it wants to carry, as a user writes them; None for those that the scenario gives it.
    """

    version: str
    where: str
    agents: str | None

    def message(self) -> Message:
        """For the orchestrator."""
        tree = {"netcosim": self.version, "where": self.where, "agents": self.agents}
        return Message(ORCHESTRATOR, Kind.CLAIM, 0, encode_object(tree))

    @classmethod
    def decode(cls, envelope: Envelope) -> Claim:
        """The claim in a message."""
        tree = decode_object(envelope.expect(Kind.CLAIM))
        agents = tree.get("agents")
        return cls(str(tree.get("netcosim")), str(tree.get("where")), None if agents is None else str(agents))


class Lobby:
    """The call order is `handle` and `leave` as things happen, until `complete`.

    Args:
        plan: what will be run.
        division: the agents of every worker, where that is settled; None where the claims decide.
        version: of netcosim.
    """

    def __init__(self, plan: Plan, division: Mapping[str, Share] | None, version: str) -> None:
        self._plan = plan
        self._division = division
        self._version = version
        self._stock = Stock(plan)
        self._index = {agent.name: agent.index for agent in plan.agents}
        self._guests: dict[str, _Guest] = {}
        self.news: list[str] = []
        """What people want to be told of, in order; whoever tells them takes it away."""

    @property
    def workers(self) -> dict[str, Share]:
        """The agents of every worker that is there, in the order of their first agents."""
        shares = {name: guest.share for name, guest in self._guests.items() if name != EMULATOR}
        return dict(sorted(shares.items(), key=lambda worker: worker[1][0]))

    @property
    def complete(self) -> bool:
        """Whether the run can begin."""
        return not self.missing and all(guest.prepared for guest in self._guests.values())

    @property
    def missing(self) -> list[str]:
        """Who has not come yet."""
        missing = [] if EMULATOR in self._guests else ["the emulator"]
        if self._division is not None:
            return missing + [
                self._called(name, share) for name, share in self._division.items() if name not in self._guests
            ]
        carried = {index for share in self.workers.values() for index in share}
        rest = [agent.name for agent in self._plan.agents if agent.index not in carried]
        return missing + ([_agents(rest)] if rest else [])

    def handle(self, envelope: Envelope) -> list[Message]:
        """Whatever a message brings.

        Raises:
            WireError: it does not hold what it should, or it is not its turn.
        """
        name = envelope.sender
        guest = self._guests.get(name)
        match envelope.kind:
            case Kind.CLAIM if guest is None:
                return [self._receive(name, Claim.decode(envelope))]
            case Kind.FETCH if guest is not None:
                try:
                    return [self._stock.chunk(envelope)]
                except CosimError as error:
                    return [self._send_away(name, str(error))]
            case Kind.PREPARED if guest is not None:
                guest.prepared = True
                self.news.append(f"{self._called(name, guest.share)} is ready")
            case Kind.FAILURE:
                self.leave(name, str(Failure.decode(envelope).error))
            case Kind.BYE:
                self.leave(name, "left")
            case _:
                raise WireError(name, f"a {envelope.kind.name} is nothing for an orchestrator that waits")
        return []

    def leave(self, name: str, why: str) -> None:
        """A process is gone, or of no use: its agents can be claimed anew."""
        guest = self._guests.pop(name, None)
        if guest is not None:
            self.news.append(f"{self._called(name, guest.share)}: {why}")

    def _receive(self, name: str, claim: Claim) -> Message:
        try:
            share = self._grant(name, claim)
        except Refusal as refusal:
            self.news.append(f"{name} ({claim.where}) was sent away: {refusal}")
            return Message(name, Kind.FAILURE, 0, encode_object({"message": str(refusal)}))
        self._guests[name] = _Guest(share, claim.where)
        self.news.append(f"{self._called(name, share)} is there: {claim.where}")
        return self._stock.offer(share).message(name)

    def _send_away(self, name: str, why: str) -> Message:
        self.leave(name, why)
        return Message(name, Kind.FAILURE, 0, encode_object({"message": why}))

    # --- claims -----------------------------------------------------------------------------------------------------
    def _grant(self, name: str, claim: Claim) -> Share:
        """The agents of a process."""
        if claim.version != self._version:
            raise Refusal(
                f"it is netcosim {claim.version}, the orchestrator netcosim {self._version}; "
                "install the same on all hosts"
            )
        if name == EMULATOR:
            return range(0)
        if self._division is None:
            return self._free_share(name, claim)
        return self._settled_share(name, claim, self._division)

    def _settled_share(self, name: str, claim: Claim, division: Mapping[str, Share]) -> Share:
        """What the scenario gives to a worker of that name."""
        if name not in division:
            workers = ", ".join(self._called(worker, share) for worker, share in division.items())
            raise Refusal(f"no worker is called {name!r}{suggest(name, division)}; say which with --name: {workers}")
        share = division[name]
        if claim.agents is not None and self._parse(claim.agents) != share:
            raise Refusal(f"the scenario gives {self._called(name, share)}; leave out --agents")
        return share

    def _free_share(self, name: str, claim: Claim) -> Share:
        """What a worker asks for, if nobody else has it."""
        free = next((text for text in self.missing if text != "the emulator"), "none")
        if claim.agents is None:
            raise Refusal(f"say which agents {name} carries, with --agents; without a worker: {free}")
        share = self._parse(claim.agents)
        for other, guest in self._guests.items():
            taken = [self._plan.agents[index].name for index in share if index in guest.share]
            if taken:
                verb = "is" if len(taken) == 1 else "are"
                raise Refusal(
                    f"{_agents(taken)} {verb} carried by {other} ({guest.where}) already; without a worker: {free}"
                )
        return share

    def _parse(self, text: str) -> Share:
        """The agents that a user means; `1-5` is `1..5` unless it is an agent's name."""
        parts = [part.strip() for part in text.split(",")]
        try:
            names = [name for part in parts for name in agent_names(self._ranged(part))]
        except ValueError as error:
            raise Refusal(str(error)) from None
        unknown = [name for name in names if name not in self._index]
        if unknown:
            raise Refusal(
                f"there is no agent {', '.join(unknown[:5])}{' and more' if len(unknown) > 5 else ''}"
                f"; the agents are {in_short(self._index)}"
            )
        return share_of({self._index[name] for name in names})

    def _ranged(self, part: str) -> str:
        match = _DASHED.fullmatch(part)
        return f"{match[1]}{match[2]}..{match[3]}" if match and part not in self._index else part

    # --- words ------------------------------------------------------------------------------------------------------
    def _called(self, name: str, share: Share) -> str:
        if name == EMULATOR:
            return "the emulator"
        return f"{name} ({_agents([self._plan.agents[index].name for index in share])})"


def _agents(names: list[str]) -> str:
    return f"agent{'' if len(names) == 1 else 's'} {in_short(names)}"
