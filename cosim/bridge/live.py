"""A bridge to whoever is there."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Self

from cosim.bridge import Taken
from cosim.bridge.checking import fitting
from cosim.components.component import Floats
from cosim.errors import ConfigError, Problem
from cosim.plan import Plan, Subscription
from network.messages import Fates
from network.payload import PayloadError, attachment, decode, encode, largest
from network.plain import Arrival, PlainKeys
from network.transport import TransportError


class Live:
    """Publishes and takes; see `cosim.bridge.Bridge`.

    Args:
        plan: what runs.
        warn: told of the first message that is refused on each key.

    Raises:
        ConfigError: an endpoint cannot be opened.
    """

    def __init__(self, plan: Plan, warn: Callable[[str], None]) -> None:
        self._plan = plan
        self._publish, self._subscribe = plan.bridge.publish, plan.bridge.subscribe
        self._warn = warn
        listen, connect = plan.bridge.listen, plan.bridge.connect
        keys = [(publication.key, publication.encoding.mime) for publication in self._publish]
        try:
            self._keys = PlainKeys(listen, connect, keys, [subscription.key for subscription in self._subscribe])
        except TransportError as error:
            raise ConfigError(
                [Problem(f"the bridge {error}; 'listen' and 'connect' under 'bridge' say where")]
            ) from error
        widths = [sum(port.variable.size for _, port in agent.record) for agent in plan.agents]
        first = list(itertools.accumulate(widths, initial=0))
        self._parts = [slice(first[p.agent] + p.part.start, first[p.agent] + p.part.stop) for p in self._publish]
        self._published = 0
        self._taken = [0] * len(self._subscribe)
        self._refused = [0] * len(self._subscribe)
        self.where = plan.bridge.where

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._keys.close()

    def take(self, tick: int) -> Taken:  # noqa: ARG002
        taken: dict[int, Floats] = {}
        for index, subscription in enumerate(self._subscribe):
            for arrival in self._keys.arrived(index, largest(subscription.size)):
                try:
                    taken[index] = checked(subscription, arrival)
                except PayloadError as error:
                    self._refuse(index, str(error))
            self._taken[index] += index in taken
        return taken

    def _refuse(self, index: int, why: str) -> None:
        self._refused[index] += 1
        if self._refused[index] == 1:
            self._warn(f"a message at {self._subscribe[index].key!r} is refused: {why}")

    def tick(self, tick: int, row: Floats) -> None:
        time_ns = tick * self._plan.period_ns
        for index, (publication, part) in enumerate(zip(self._publish, self._parts, strict=True)):
            payload = encode(publication.encoding, tick, time_ns, row[part])
            self._keys.put(index, payload, attachment(publication.encoding, tick, time_ns))
        self._published += len(self._publish)

    def fates(self, fates: Fates) -> None:
        """Not needed."""

    def account(self) -> list[str]:
        lines = [f"{self._published} messages published"] if self._publish else []
        for subscription, taken, refused in zip(self._subscribe, self._taken, self._refused, strict=True):
            said = f"{subscription.key}: a new value at {taken} tick{'' if taken == 1 else 's'}"
            lines.append(said + (f", {refused} message{'' if refused == 1 else 's'} refused" if refused else ""))
        return lines


def checked(subscription: Subscription, arrival: Arrival) -> Floats:
    """The value in a message.

    Raises:
        PayloadError: it must not be used.
    """
    if arrival.payload is None:
        raise PayloadError(f"it has {arrival.size} bytes, or deletes the key")
    values = decode(subscription.encoding, arrival.encoding, arrival.payload, subscription.size)
    fitting(subscription, values)
    return values
