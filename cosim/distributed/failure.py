"""A failure in another process: how it travels, and which of several is the one that the in-process run would meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cosim.errors import ClusterError, ConfigError, CosimError, Location, Problem, RunEndedError, RunError, Severity
from network.codec import decode_object, encode_object
from network.transport import Envelope, Part, WireError

OPENING, INITIALISING = -2, -1
"""Instead of a tick, before the first one."""


@dataclass(frozen=True)
class Failure:
    """An agent failed.

    Attributes:
        tick: the one from which the agents were advancing; `OPENING` or `INITIALISING` before.
        agent: index of the agent.
        error: as the agent raised it.
        about: the process whose message could not be used, if that is what failed.
    """

    tick: int
    agent: int
    error: CosimError
    about: str = ""

    @property
    def rank(self) -> tuple[int, int]:
        """The in-process run fails with the lowest."""
        return self.tick, self.agent

    def encode(self) -> list[Part]:
        """As the body of a message."""
        tree = {"tick": self.tick, "agent": self.agent, "error": _tree(self.error), "about": self.about}
        return encode_object(tree)

    @classmethod
    def decode(cls, envelope: Envelope) -> Failure:
        """The failure in a message.

        Raises:
            WireError: there is none.
        """
        tree: dict[str, Any] = decode_object(envelope)
        try:
            error = _error(tree["error"], envelope.sender)
            return cls(int(tree["tick"]), int(tree["agent"]), error, str(tree["about"]))
        except (ValueError, KeyError, TypeError) as error:
            raise WireError(envelope.sender, f"a failure that cannot be read: {error!r}") from error


def _tree(error: CosimError) -> dict[str, Any]:
    if isinstance(error, RunError):
        return {
            "kind": "end" if isinstance(error, RunEndedError) else "run",
            "agent": error.agent,
            "component": error.component,
            "time": error.time,
            "message": error.message,
            "log": error.log,
        }
    if isinstance(error, ConfigError):
        problems = [
            {
                "message": problem.message,
                "severity": problem.severity,
                "where": [problem.where.file, problem.where.line, problem.where.column] if problem.where else None,
            }
            for problem in error.problems
        ]
        return {"kind": "config", "problems": problems}
    return {"kind": "other", "message": str(error)}


def _error(tree: dict[str, Any], sender: str) -> CosimError:
    if tree["kind"] in ("run", "end"):
        kind = RunEndedError if tree["kind"] == "end" else RunError
        return kind(tree["agent"], tree["component"], float(tree["time"]), tree["message"], tree["log"])
    if tree["kind"] == "config":
        return ConfigError(
            Problem(
                problem["message"],
                Location(*problem["where"]) if problem["where"] else None,
                Severity(problem["severity"]),
            )
            for problem in tree["problems"]
        )
    return ClusterError(f"{sender} failed: {tree['message']}")
