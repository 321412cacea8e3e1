"""What `cosim fmu` does: look at an FMU, write an agent around one, try one out, make one."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import ConfigError, Location, Problem, suggest


def find(text: str) -> Path:
    """The FMU file of that name, or a shipped FMU.

    Raises:
        ConfigError: there is none.
    """
    import fmus
    from cosim.planning.describing import files_beside, is_file, no_file

    path = Path(text)
    if path.is_file():
        return path
    if text in fmus.names():
        return fmus.path(text)
    if reason := no_file(path):
        raise ConfigError([Problem(reason, Location(text))])
    if not is_file(text):
        raise ConfigError([Problem(f"no file and no shipped FMU is called {text!r}{suggest(text, fmus.names())}")])
    raise ConfigError([Problem(f"no such file{suggest(path.name, files_beside(path))}", Location(text))])
