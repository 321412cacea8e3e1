"""Profiles of channels in files of their own: those that are shipped, and those that users keep beside their scenarios.

A file is a mapping of `channel`, as it would stand in a scenario, and if wanted `title` and `source`. A scenario names
it: `air: wifi_busy` or `air: {profile: mine.yaml, delay: 80 ms}`, where every key beside `profile` replaces the
profile's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from cosim.errors import ConfigError, Problem, suggest
from cosim.scenario import configs
from cosim.scenario.source import Node, read
from network.channel import ChannelModel
from network.models import AnyChannelModel

_SUFFIXES = (".yaml", ".yml")
_KEYS = ("title", "source", "channel")
_FILES = ("file", "table", "recorded", "mahimahi")
"""Keys of channels whose text names a file, relative to the file in which it is written."""

_FORM: TypeAdapter[ChannelModel] = TypeAdapter(AnyChannelModel)


@dataclass(frozen=True)
class Profile:
    """A file's content.

    Attributes:
        path: the file.
        title, source: what it says of itself; empty where it says nothing.
        channel: as a scenario would have it.
    """

    path: Path
    title: str
    source: str
    channel: Node


def names() -> list[str]:
    """The shipped profiles."""
    return sorted(path.stem for path in (configs.folder() / "channels").glob("*.yaml"))


def is_file_name(text: str) -> bool:
    """Whether a text names a file; else it is the name of a shipped profile."""
    return text.endswith(_SUFFIXES)


def find(name: str, folder: Path) -> Path:
    """The file of a shipped profile, or one by its name with its suffix, relative to `folder`.

    Raises:
        ValueError: neither; the nearest name is in the message.
    """
    if not is_file_name(name):
        if name not in names():
            hint = suggest(name, names()) or f"; cosim channel --list shows them, {', '.join(names()[:3])} and others"
            raise ValueError(f"no shipped profile {name!r}{hint}; a file has its suffix, such as {name}.yaml")
        return configs.folder() / "channels" / f"{name}.yaml"
    path = folder / name
    if not path.is_file():
        near = sorted(p.name for p in path.parent.glob("*") if p.suffix in _SUFFIXES) if path.parent.is_dir() else []
        hint = suggest(path.name, near) if near else ""
        if path.stem in names():
            hint = f"; the shipped profile goes by its bare name, {path.stem!r}"
        raise ValueError(f"no such file: {path}{hint}")
    return path


def load(path: Path) -> Profile:
    """The profile in a file, its channel not yet validated.

    Raises:
        ConfigError: it is no YAML, or no profile.
    """
    problems: list[Problem] = []
    root = read(path, problems=problems)
    if not isinstance(root.value, dict):
        raise ConfigError([*problems, Problem("a profile is a mapping with the key 'channel'", root.where)])
    problems += [
        Problem(f"unknown key {name!r}{suggest(name, _KEYS)}", node.key or node.where)
        for name, node in root.mapping.items()
        if name not in _KEYS
    ]
    texts = {name: root.child(name) for name in _KEYS[:2]}
    for name, node in texts.items():
        if node is not None and not isinstance(node.value, str):
            problems.append(Problem(f"{name}: must be text", node.where))
    channel = root.child("channel")
    if channel is None:
        problems.append(Problem("'channel' is missing, such as {model: netem, delay: 20 ms}", root.where))
    elif not isinstance(channel.value, dict):
        problems.append(Problem("channel: must be a mapping, such as {model: netem, delay: 20 ms}", channel.where))
    if problems or channel is None:
        raise ConfigError(problems)
    title, source = (" ".join(str(node.value).split()) if node is not None else "" for node in texts.values())
    return Profile(path, title, source, _absolute(channel, path.parent))


def model_of(profile: Profile) -> ChannelModel:
    """The model of a profile.

    Raises:
        ConfigError: everything that is wrong with it.
    """
    from cosim.scenario.reading import problems_of

    model, problems = problems_of(_FORM, profile.channel, {"folder": profile.path.parent})
    if model is None:
        raise ConfigError(problems)
    return model


def resolve(root: Node, folder: Path, label: str, problems: list[Problem] | None = None) -> Node:
    """A scenario's tree with every profile that its `channels` name in the place of the name.

    Args:
        root: the tree.
        folder: of the scenario's file.
        label: what locations call that file; what is written elsewhere, on the command line, is relative to where
            we are.
        problems: takes what is wrong, one of them at the value that then stands for the channel; without it, names that
            mean nothing stay.
    """
    channels = root.child("channels")
    if channels is None or not isinstance(channels.value, dict):
        return root
    found = {}
    for name, node in channels.value.items():
        named = node if isinstance(node.value, str) else node.child("profile")
        found[name] = node
        if named is None:
            continue
        try:
            found[name] = _resolved(node, named, folder if named.where.file == label else Path())
        except ConfigError as error:
            if problems is not None:
                problems += error.problems
                found[name] = Node(None, named.where, node.key)
    return Node({**root.mapping, "channels": Node(found, channels.where, channels.key)}, root.where, root.key)


def _resolved(node: Node, named: Node, folder: Path) -> Node:
    if not isinstance(named.value, str):
        raise ConfigError([Problem("profile: must be the name of a shipped profile, or of a file", named.where)])
    try:
        profile = load(find(named.value, folder))
    except ValueError as error:
        raise ConfigError([Problem(str(error), named.where)]) from None
    except ConfigError as error:
        mine = Problem(f"the profile {named.value!r} has mistakes", named.where)
        raise ConfigError([*error.problems, mine]) from None
    own = {name: value for name, value in node.mapping.items() if name != "profile"}
    return Node({**dict(_without_rivals(profile.channel.mapping, own)), **own}, profile.channel.where, node.key)


def _without_rivals(channel: Mapping[str, Node], own: Mapping[str, Node]) -> Iterator[tuple[str, Node]]:
    """A profile's entries, but for a capacity of the other kind than the one that is given."""
    for name, node in channel.items():
        if not (name in ("rate", "mahimahi") and {"rate", "mahimahi"} & own.keys()):
            yield name, node


def _absolute(node: Node, folder: Path) -> Node:
    """The same tree, the files that it names found from anywhere."""
    if not isinstance(node.value, dict):
        return node
    entries = {}
    for name, child in node.value.items():
        if name in _FILES and isinstance(child.value, str):
            entries[name] = Node(str((folder / child.value).absolute()), child.where, child.key)
        else:
            entries[name] = _absolute(child, folder)
    return Node(entries, node.where, node.key)
