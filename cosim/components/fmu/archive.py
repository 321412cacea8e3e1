"""The FMU file as a ZIP archive: what it holds, and unpacking it without ever leaving the folder."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import re
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from cosim.errors import ConfigError, Location, Problem
from cosim.scratch import Scratch

ORIGINAL = "extra/netcosim/original.json"
"""Member of an FMU that holds only the description; says of which file (docs/hosts.md)."""

_LIBRARY_SUFFIXES = {".so", ".dll", ".dylib"}

_MOST_MEMBERS = 100_000
_MOST_BYTES = 16 << 30
_ALWAYS_BYTES, _USUAL_RATIO = 256 << 20, 200
"""Up to so many bytes when unpacked nothing is asked; beyond, so many times the file's own size is too much."""
_DESCRIPTION_BYTES = 256 << 20


@dataclass(frozen=True)
class Original:
    """An FMU of which only the description is here.

    Attributes:
        sha256: of the file.
        name: of the file, without a folder.
        platforms: those it has a binary for.
    """

    sha256: str
    name: str
    platforms: tuple[str, ...]

    @classmethod
    def parse(cls, text: bytes) -> Original:
        """As `ORIGINAL` has it.

        Raises:
            ValueError: it says something else.
        """
        tree = json.loads(text)
        if not isinstance(tree, dict) or not re.fullmatch(r"[0-9a-f]{64}", str(tree.get("sha256"))):
            raise ValueError("it gives no SHA-256")
        platforms = tree.get("platforms")
        name = Path(str(tree.get("name"))).name
        return cls(tree["sha256"], name, tuple(map(str, platforms if isinstance(platforms, list) else ())))


@dataclass(frozen=True)
class Archive:
    """A checked archive.

    Attributes:
        path: of the file.
        sha256: of the file; of the original, where this holds only its description.
        names: of all members; every one lies inside the folder it is unpacked to.
        original: what a file that holds only the description says of the original.
    """

    path: Path
    sha256: str
    names: tuple[str, ...]
    original: Original | None = None

    @property
    def whole(self) -> bool:
        """Whether it can be run: it is more than a description."""
        return self.original is None

    @property
    def original_name(self) -> str:
        """File name of the whole FMU."""
        return self.original.name if self.original else self.path.name

    @property
    def platforms(self) -> tuple[str, ...]:
        """The folders under `binaries/` that hold a library; `linux64` (FMI 2.0), `x86_64-linux` (FMI 3.0)."""
        if self.original is not None:
            return self.original.platforms
        parts = [PurePosixPath(name).parts for name in self.names]
        libraries = [p for p in parts if len(p) == 3 and PurePosixPath(p[2]).suffix in _LIBRARY_SUFFIXES]
        return tuple(sorted({p[1] for p in libraries if p[0] == "binaries"}))


def refuse(path: Path, predicate: str) -> ConfigError:
    """The error that says what is wrong with a file."""
    return ConfigError([Problem(f"{path.name} {predicate}", Location(str(path)))])


def inspect(path: Path) -> Archive:
    """Read an archive's table of contents.

    Raises:
        ConfigError: no such file, no ZIP archive, truncated, with a member that would be unpacked elsewhere, or with
            more than anybody would want unpacked.
    """
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            check_members(path, members)
            said = archive.read(ORIGINAL) if any(member.filename == ORIGINAL for member in members) else None
            original = None if said is None else Original.parse(said)
    except FileNotFoundError:
        raise refuse(path, "does not exist") from None
    except OSError as error:
        raise refuse(path, f"cannot be read: {error.strerror}") from error
    except zipfile.BadZipFile as error:
        raise refuse(path, "is not an FMU: not a ZIP archive, or a truncated one") from error
    except (ValueError, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise refuse(path, f"has a broken {ORIGINAL}: {error}") from error
    names = tuple(member.filename for member in members)
    return Archive(path, original.sha256 if original else sha256, names, original)


def unpack(archive: Archive, wanted: Callable[[str], bool]) -> Path:
    """Unpack members into a new folder that only this user can read, removed when the process ends.

    Args:
        archive: what to unpack.
        wanted: which members, by name.

    Raises:
        ConfigError: a member is damaged, or the disk is full.
    """
    folder = Path(tempfile.mkdtemp(dir=_scratch()))
    try:
        with zipfile.ZipFile(archive.path) as file:
            file.extractall(folder, [name for name in archive.names if wanted(name)])
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise refuse(archive.path, f"cannot be unpacked: {error}") from error
    return folder


def check_members(path: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """Refuse what could write outside the folder, or fill the disk. `zipfile` unpacks no more than a member declares.

    Raises:
        ConfigError: says which member, and why.
    """
    seen: dict[str, tuple[int, int]] = {}
    for member in members:
        reason = _escapes(member) or _unfit(member, seen)
        if reason:
            raise refuse(path, f"is refused: its member {member.filename!r} {reason}")
        seen[member.filename] = member.CRC, member.file_size
    size, packed, unpacked = (
        path.stat().st_size,
        sum(member.compress_size for member in members),
        sum(member.file_size for member in members),
    )
    if len(members) > _MOST_MEMBERS:
        raise refuse(path, f"is refused: it holds {len(members)} files, more than {_MOST_MEMBERS}")
    if packed > size:
        raise refuse(path, "is refused: its members overlap, as those of archives made to fill a disk do")
    if unpacked > _MOST_BYTES or unpacked > max(_ALWAYS_BYTES, _USUAL_RATIO * size):
        raise refuse(
            path, f"is refused: unpacked it would take {unpacked / 1e9:.3g} GB, {unpacked // size} times its own size"
        )


def _escapes(member: zipfile.ZipInfo) -> str:
    """Why unpacking the member could write outside the folder; empty if it cannot."""
    name = member.orig_filename  # before `zipfile` tidied it
    if "\\" in name or ":" in name or "\0" in name:
        return "has a name that is not portable (FMI wants forward slashes and no drive)"
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        return "would be unpacked outside the folder"
    kind = stat.S_IFMT(member.external_attr >> 16)
    if kind == stat.S_IFLNK:
        return "is a symbolic link"
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is neither a file nor a folder"
    return ""


def _unfit(member: zipfile.ZipInfo, seen: Mapping[str, tuple[int, int]]) -> str:
    """Why the member is refused although it stays inside the folder; empty if it is not."""
    if seen.get(member.filename, (member.CRC, member.file_size)) != (member.CRC, member.file_size):
        return "is there twice with different contents, and tools differ in which one they take"
    if member.filename in ("modelDescription.xml", ORIGINAL) and member.file_size > _DESCRIPTION_BYTES:
        return (
            f"takes {member.file_size / 1e6:.0f} MB, more than the {_DESCRIPTION_BYTES >> 20} MiB that are read of it"
        )
    return ""


_scratches: dict[int, Scratch] = {}


def _scratch() -> Path:
    """The folder of this process; a forked child gets its own."""
    process = os.getpid()
    if process not in _scratches:
        _scratches[process] = Scratch()
        atexit.register(_remove, process)
    return _scratches[process].path


def _remove(process: int) -> None:
    if process == os.getpid():
        _scratches[process].remove()
