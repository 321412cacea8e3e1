"""The FMU files of a run whose processes are on several hosts: offered by the orchestrator, found or fetched by others.

A file that only its owner has never travels: for planning its description is enough, and whoever carries an agent that
needs it has it already. Names of files are compared, never used as paths to write to; what counts is the SHA-256.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cosim.distributed.assignment import ORCHESTRATOR, Job, Message, Share
from cosim.errors import CosimError
from cosim.plan import Plan
from network.codec import decode_object, encode_object
from network.transport import Envelope, Kind, WireError

CHUNK_BYTES = 1 << 18
_LARGEST_FILE = 1 << 30


@dataclass(frozen=True)
class Content:
    """Some bytes that can be fetched."""

    sha256: str
    size: int


@dataclass(frozen=True)
class Item:
    """One FMU.

    Attributes:
        names: what the resolved scenario calls it.
        file: its name, without a folder.
        sha256: of the whole file.
        run: whether whoever is told of it runs it.
        whole: the file; None where the orchestrator has the description only.
        description: a file that holds only that.
    """

    names: tuple[str, ...]
    file: str
    sha256: str
    run: bool
    whole: Content | None
    description: Content

    @classmethod
    def of(cls, tree: Mapping[str, Any]) -> Item:
        """As it was written by `asdict`."""
        whole = tree["whole"]
        return cls(
            names=tuple(map(str, tree["names"])),
            file=str(tree["file"]),
            sha256=str(tree["sha256"]),
            run=bool(tree["run"]),
            whole=None if whole is None else Content(str(whole["sha256"]), int(whole["size"])),
            description=Content(str(tree["description"]["sha256"]), int(tree["description"]["size"])),
        )


@dataclass(frozen=True)
class Offer:
    """What will be run, before it is known who carries what.

    Attributes:
        job: without workers.
        items: its FMUs.
    """

    job: Job
    items: tuple[Item, ...]

    def message(self, receiver: str) -> Message:
        """For a process."""
        tree = {
            "scenario": self.job.scenario,
            "sha256": list(self.job.sha256),
            "files": [asdict(item) for item in self.items],
        }
        return Message(receiver, Kind.OFFER, 0, encode_object(tree))

    @classmethod
    def decode(cls, envelope: Envelope) -> Offer:
        """The offer in a message.

        Raises:
            WireError: there is none.
        """
        tree: dict[str, Any] = decode_object(envelope.expect(Kind.OFFER))
        try:
            job = Job(str(tree["scenario"]), tuple(map(str, tree["sha256"])), {})
            return cls(job, tuple(Item.of(item) for item in tree["files"]))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise WireError(envelope.sender, f"the message holds no offer: {error!r}") from error


class Stock:
    """What the orchestrator has to offer.

    Args:
        plan: whose FMUs are offered.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._job = Job.of(plan, {})
        self._carriers: dict[Path, set[int]] = {}
        for agent in plan.agents:
            for component in agent.components:
                if component.path is not None:
                    self._carriers.setdefault(component.path, set()).add(agent.index)
        self._sources: dict[str, Path | bytes] = {}
        self._items = {path: self._item(path) for path in self._carriers}

    def offer(self, share: Share) -> Offer:
        """For a process that carries these agents."""
        carried = set(share)
        items = [
            Item(item.names, item.file, item.sha256, bool(carried & self._carriers[path]), item.whole, item.description)
            for path, item in self._items.items()
        ]
        return Offer(self._job, tuple(items))

    def chunk(self, envelope: Envelope) -> Message:
        """The part of a file that a message asks for.

        Raises:
            WireError: there is no such file or part.
            CosimError: the file is gone.
        """
        source = self._sources.get(str(decode_object(envelope.expect(Kind.FETCH)).get("sha256")))
        if source is None or envelope.tick < 0:
            raise WireError(envelope.sender, "it asks for a file that was not offered")
        begin = envelope.tick * CHUNK_BYTES
        if isinstance(source, bytes):
            part = source[begin : begin + CHUNK_BYTES]
        else:
            try:
                with source.open("rb") as file:
                    file.seek(begin)
                    part = file.read(CHUNK_BYTES)
            except OSError as error:
                raise CosimError(f"{source} cannot be read any more: {error.strerror}") from error
        return Message(envelope.sender, Kind.CHUNK, envelope.tick, [part])

    def _item(self, path: Path) -> Item:
        from cosim.components.fmu.library import read
        from cosim.components.fmu.stripping import strip

        archive = read(path).archive
        stripped = strip(path)
        description = Content(hashlib.sha256(stripped).hexdigest(), len(stripped))
        self._sources[description.sha256] = stripped
        whole = None
        if archive.whole:
            whole = Content(archive.sha256, path.stat().st_size)
            self._sources[whole.sha256] = path
        return Item(_names(path), archive.original_name, archive.sha256, False, whole, description)


def _names(path: Path) -> tuple[str, ...]:
    """What a resolved scenario calls a file: by its path, or where it is shipped, by its name."""
    import fmus

    return tuple(name for name in fmus.names() if fmus.path(name) == path) or (str(path),)


class Procurement:
    """Gets hold of every file of an offer: finds it here, or fetches it part by part.

    Args:
        offer: of the orchestrator.
        folders: where this process's user keeps files.
        store: a folder for what is fetched.

    Raises:
        CosimError: files are missing that the orchestrator does not have either.
    """

    def __init__(self, offer: Offer, folders: Sequence[Path], store: Path) -> None:
        self.located: dict[str, Path] = {}
        """Files by what the resolved scenario calls them."""
        self._store = store
        self._wanted: list[tuple[Item, Content]] = []
        problems = []
        for item in offer.items:
            path = _find(item, folders)
            content = item.whole if item.run else item.description
            if path is not None:
                self._locate(item, path)
            elif content is not None and content.size <= _LARGEST_FILE:
                self._wanted.append((item, content))
            else:
                problems.append(_missing(item, folders))
        if problems:
            raise CosimError("\n".join(problems))

    @property
    def done(self) -> bool:
        """Whether all files are here."""
        return not self._wanted

    def ask(self) -> list[Message]:
        """For the next part."""
        if self.done:
            return []
        _, content = self._wanted[0]
        return [Message(ORCHESTRATOR, Kind.FETCH, self._parts, encode_object({"sha256": content.sha256}))]

    @property
    def _target(self) -> Path:
        return self._store / f"{len(self._wanted)}.fmu"

    @property
    def _parts(self) -> int:
        """How many parts of the current file are here."""
        return -(-self._target.stat().st_size // CHUNK_BYTES) if self._target.exists() else 0

    def take(self, envelope: Envelope) -> list[Message]:
        """A part that was asked for; asks for the next.

        Raises:
            WireError: it is another part, or the whole is not what was offered.
            CosimError: there is no room for it.
        """
        if self.done:
            raise WireError(envelope.sender, "it sends part of a file that nobody asked for")
        item, content = self._wanted[0]
        part = envelope.expect(Kind.CHUNK, self._parts).body
        if len(part) != min(CHUNK_BYTES, content.size - self._parts * CHUNK_BYTES):
            raise WireError(envelope.sender, f"part {self._parts} of {item.file} has {len(part)} bytes")
        try:
            with self._target.open("ab") as file:
                file.write(part)
        except OSError as error:
            raise CosimError(f"{item.file} cannot be stored: {error.strerror}") from error
        if self._target.stat().st_size == content.size:
            if _sha256(self._target) != content.sha256:
                raise WireError(envelope.sender, f"{item.file} came with another SHA-256 than was announced")
            self._locate(item, self._target)
            self._wanted.pop(0)
        return self.ask()

    def _locate(self, item: Item, path: Path) -> None:
        self.located.update(dict.fromkeys(item.names, path.absolute()))  # FMUs may change the current folder


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _find(item: Item, folders: Sequence[Path]) -> Path | None:
    """The whole file, if it is here."""
    for path in _candidates(item, folders):
        with suppress(OSError):
            if _sha256(path) == item.sha256:
                return path
    return None


def _candidates(item: Item, folders: Sequence[Path]) -> Iterator[Path]:
    import fmus

    yield from _of_that_name(item, folders)
    for folder in folders:
        yield from sorted(folder.glob("*.fmu"))
    yield from (fmus.path(name) for name in item.names if name in fmus.names())


def _of_that_name(item: Item, folders: Sequence[Path]) -> list[Path]:
    if item.file != Path(item.file).name:
        return []
    return [path for folder in folders if (path := folder / item.file).is_file()]


def _missing(item: Item, folders: Sequence[Path]) -> str:
    """What to say of a file that cannot be had."""
    why = "only its owner has it" if item.whole is None else "it is too large to be sent"
    text = f"{item.file} (SHA-256 {item.sha256}) is needed here, and {why}: put it into the folder of --files"
    others = [f"{path} is another file (SHA-256 {_sha256(path)})" for path in _of_that_name(item, folders)]
    return "\n  ".join([text, *others])
