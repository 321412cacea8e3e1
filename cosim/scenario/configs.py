"""Scenario files: those that users name, and those that are shipped and run by their bare name."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import ConfigError, Location, Problem, suggest

_SUFFIXES = (".yaml", ".yml")


def folder() -> Path:
    """Where the shipped scenarios are: in the package once installed, at the root of the source tree before."""
    here = Path(__file__).parents[1]
    installed = here / "configs"
    return installed if installed.is_dir() else here.parent / "configs"


def names() -> list[str]:
    """The shipped scenarios."""
    return sorted(path.stem for path in folder().glob("*.yaml"))


def shipped(name: str) -> Path:
    """The file of a shipped scenario.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in names():
        raise ConfigError([Problem(f"no shipped scenario {name!r}{suggest(name, names())}")])
    return folder() / f"{name}.yaml"


def companions(name: str) -> list[Path]:
    """The files that a shipped scenario names, relative to its folder."""
    from cosim.scenario.source import read

    waiting, found = [read(shipped(name)).plain()], []
    while waiting:
        item = waiting.pop()
        if isinstance(item, dict):
            waiting += item.values()
        elif isinstance(item, list):
            waiting += item
        elif isinstance(item, str) and "/" in item and (folder() / item).is_file():
            found.append(Path(item))
    return found


def find(config: str) -> Path:
    """A scenario by file name, with or without its suffix, or a shipped one by its bare name; a file comes first.

    Raises:
        ConfigError: neither.
    """
    path = Path(config)
    for candidate in (path, *(Path(f"{config}{suffix}") for suffix in _SUFFIXES)):
        if candidate.is_file():
            return candidate
    if path.is_dir() and path.name != config:
        raise ConfigError([Problem("this is a folder; name a YAML file", Location(config))])
    if path.suffix in _SUFFIXES or path.name != config:
        hint = ""
        if path.stem in names():
            hint = f"; the shipped scenario goes by its bare name, {path.stem!r}"
        elif path.parent.is_dir():
            hint = suggest(path.name, sorted(p.name for p in path.parent.iterdir() if p.suffix in _SUFFIXES))
        raise ConfigError([Problem(f"no such file{hint}", Location(config))])
    return shipped(config)
