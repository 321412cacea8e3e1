"""What is played: a channel, its edges, and for how long; from what a user wrote after `cosim channel`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.errors import ConfigError, Location, Problem, suggest
from cosim.scenario import configs, profiles
from cosim.scenario.profiles import Profile
from cosim.scenario.source import Node, parse
from network.channel import ChannelModel
from network.messages import Links
from network.units import format_duration, parse_duration, parse_size

WRITTEN = "PROFILE"
"""What locations call a channel that is written on the command line."""

TICKS = 10_000
PERIOD = "100 ms"
SIZE = "32 B"
SEED = 1
MOST_MESSAGES = 5_000_000
_NUMBER_BYTES = 8


@dataclass(frozen=True)
class Subject:
    """A channel that can be played.

    Attributes:
        name: for people, and of the folder.
        title, source: what the profile says of itself; empty where it says nothing.
        model: of every edge.
        links: the edges, all of one channel.
        size: of a message, in bytes.
    """

    name: str
    title: str
    source: str
    model: ChannelModel
    links: Links
    period_ns: int
    n_ticks: int
    seed: int
    size: int


@dataclass(frozen=True)
class Wanted:
    """What the command line says; None where it says nothing."""

    ticks: int | None = None
    edges: int | None = None
    period: str | None = None
    seed: int | None = None
    size: str | None = None


def find(text: str, wanted: Wanted) -> Subject:
    """The channel that a text names.

    Args:
        text: a shipped profile, a profile's file, `SCENARIO:CHANNEL`, or a channel as a scenario would have it in
            braces.
        wanted: how to play it.

    Raises:
        ConfigError: everything that is wrong with it.
    """
    scenario, colon, channel = text.rpartition(":")
    if text.lstrip().startswith("{"):
        subject = _alone(_written(text), "channel")
    elif colon and scenario:
        subject = _of_a_scenario(scenario, channel, wanted)
    else:
        subject = _alone(_named(text), Path(text).stem if profiles.is_file_name(text) else text)
    return _as_wanted(subject, wanted)


def _alone(profile: Profile, name: str) -> Subject:
    model = profiles.model_of(profile)
    period, size = parse_duration(PERIOD), parse_size(SIZE)
    return Subject(name, profile.title, profile.source, model, pairs(1), period, TICKS, SEED, size)


def _written(text: str) -> Profile:
    """A channel as it would stand in a scenario, with or without the name of a profile."""
    node = parse(text, WRITTEN)
    whole = Node({"channels": Node({"channel": node}, node.where)}, node.where)
    problems: list[Problem] = []
    channel = profiles.resolve(whole, Path(), WRITTEN, problems).find("channels", "channel")
    if problems or channel is None:
        raise ConfigError(problems)
    return Profile(Path(WRITTEN), "", "", channel)


def _named(text: str) -> Profile:
    try:
        path = profiles.find(text, Path())
    except ValueError as error:
        hint = ""
        if text in configs.names():
            hint = f"; {text} is a scenario: write {text}:CHANNEL, with the name of one of its channels"
        raise ConfigError([Problem(f"{error}{hint}")]) from None
    try:
        return profiles.load(path)
    except ConfigError as error:
        if any("unknown key 'channels'" in problem.message for problem in error.problems):
            said = f"this is a scenario: write {text}:CHANNEL, with the name of one of its channels"
            raise ConfigError([Problem(said, Location(text))]) from None
        raise


def _of_a_scenario(config: str, channel: str, wanted: Wanted) -> Subject:
    """The edges of a run that have this channel: alone, they fare as in the run."""
    from cosim import planning

    settings = {"seed": wanted.seed, "period": wanted.period}
    path = configs.find(config)
    plan = planning.load(config, [f"{key}={value}" for key, value in settings.items() if value is not None]).plan
    if channel not in plan.channels:
        hint = suggest(channel, plan.channels)
        raise ConfigError([Problem(f"no edge has a channel {channel!r}{hint}", Location(str(path)))])
    chosen = np.flatnonzero(np.array(plan.link_channel) == channel)
    links = plan.links
    links = Links(links.agents, links.sender[chosen], links.receiver[chosen], links.slot[chosen])
    model, size = plan.channels[channel], _NUMBER_BYTES * plan.layout.width
    title = f"The channel {channel} of {plan.title or plan.name}"
    name = f"{plan.name}.{channel}"
    return Subject(name, title, "", model, links, plan.period_ns, max(1, plan.ticks), plan.seed, size)


def _as_wanted(subject: Subject, wanted: Wanted) -> Subject:
    """With what the command line says; every mistake at once."""
    problems: list[Problem] = []
    numbers: dict[str, int] = {}
    texts: Mapping[str, str | None] = {"period": wanted.period, "size": wanted.size}
    for name, parser in (("period", parse_duration), ("size", parse_size)):
        text = texts[name]
        if text is not None:
            try:
                numbers[name] = parser(text)
            except ValueError as error:
                problems.append(Problem(f"--{name}: {error}"))
    period = numbers.get("period", subject.period_ns)
    if period <= 0:
        problems.append(Problem(f"--period: {format_duration(period)} is too short; it must be more than 0"))
    size = numbers.get("size", subject.size)
    if size < 0 or size % _NUMBER_BYTES:
        problems.append(Problem(f"--size: a message is numbers of {_NUMBER_BYTES} bytes each, so {size} B cannot be"))
    ticks = subject.n_ticks if wanted.ticks is None else wanted.ticks
    edges = len(subject.links) if wanted.edges is None else wanted.edges
    problems += [
        Problem(f"--{name}: {number} are too few; one at least")
        for name, number in (("ticks", ticks), ("edges", edges))
        if number < 1
    ]
    if ticks * edges > MOST_MESSAGES:
        problems.append(Problem(f"{edges} edges of {ticks} ticks are more than {MOST_MESSAGES} messages; take fewer"))
    if problems:
        raise ConfigError(problems)
    return replace(
        subject,
        links=subject.links if wanted.edges is None else pairs(edges),
        period_ns=period,
        n_ticks=ticks,
        seed=subject.seed if wanted.seed is None else wanted.seed,
        size=size,
    )


def pairs(n: int) -> Links:
    """Edges from a to b, or for several from a1 to b1, from a2 to b2 and so on."""
    numbers = [""] if n == 1 else [str(i + 1) for i in range(n)]
    agents = (*(f"a{number}" for number in numbers), *(f"b{number}" for number in numbers))
    index = np.arange(n)
    return Links(agents, index, n + index, np.zeros(n, np.int64))
