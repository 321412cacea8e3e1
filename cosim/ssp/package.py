"""An .ssp archive, or its folder: its XML documents with the places of their elements, and its FMUs."""

from __future__ import annotations

import posixpath
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from cosim.components.fmu.archive import check_members, refuse
from cosim.errors import ConfigError, Location, Problem

ROOT = "SystemStructure.ssd"
_XML_BYTES = 64 << 20


@dataclass(frozen=True)
class Node:
    """An element of an XML document.

    Attributes:
        member: the document, by its name in the package.
    """

    package: Path
    member: str
    xml: Any

    @property
    def kind(self) -> str:
        """Its name, without the namespace; empty for a comment."""
        tag = self.xml.tag
        return tag.rpartition("}")[2] if isinstance(tag, str) else ""

    @property
    def where(self) -> Location:
        """Its place."""
        return Location(f"{self.package}/{self.member}", self.xml.sourceline or 0, 1)

    def get(self, name: str, otherwise: str | None = None) -> str | None:
        """An attribute."""
        found: str | None = self.xml.get(name, otherwise)
        return found

    def required(self, name: str) -> str:
        """An attribute that must be there.

        Raises:
            ConfigError: it is not.
        """
        found = self.get(name)
        if found is None:
            raise self.error(f"{self.kind} without the attribute {name!r}")
        return found

    def number(self, name: str, otherwise: float) -> float:
        """An attribute that is a number.

        Raises:
            ConfigError: it is none.
        """
        text = self.get(name)
        try:
            return otherwise if text is None else float(text)
        except ValueError:
            raise self.error(f"{name}={text!r} is no number") from None

    def flag(self, name: str) -> bool:
        """An attribute that is true or, by default, false."""
        return self.get(name) in ("true", "1")

    def all(self, *path: str) -> list[Node]:
        """Descendants by the names of the elements that lead to them."""
        nodes = [self]
        for name in path:
            nodes = [child for node in nodes for child in node.children() if child.kind == name]
        return nodes

    def children(self) -> list[Node]:
        """What is in it."""
        return [Node(self.package, self.member, xml) for xml in self.xml]

    def descendants(self) -> Iterator[Node]:
        """What is in it and in that, in the document's order."""
        return (Node(self.package, self.member, xml) for xml in self.xml.iterdescendants())

    def error(self, message: str) -> ConfigError:
        """Something that is wrong with it."""
        return ConfigError([Problem(message, self.where)])


class Package:
    """An .ssp archive, checked as those of FMUs are; or its folder, unpacked, which may refer to files outside.

    Args:
        path: of the archive, of the folder, or of a description (.ssd) in it.

    Attributes:
        path: of the archive or folder.
        root: the description of the whole, a member.

    Raises:
        ConfigError: it is missing or no such archive, or what it holds would be unpacked elsewhere or without measure.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.root = (path.parent, path.name) if path.suffix == ".ssd" else (path, ROOT)
        self._sizes = None if self.path.is_dir() else self._members()
        if not self._holds(self.root):
            missing = "does not exist" if path.suffix == ".ssd" else f"is no SSP package: it holds no {self.root}"
            raise refuse(path, missing)

    def _members(self) -> dict[str, int]:
        """The size of each."""
        path = self.path
        try:
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
        except FileNotFoundError:
            raise refuse(path, "does not exist") from None
        except OSError as error:
            raise refuse(path, f"cannot be read: {error.strerror}") from error
        except zipfile.BadZipFile as error:
            raise refuse(path, "is no SSP package: not a ZIP archive, or a truncated one") from error
        check_members(path, members)
        return {member.filename: member.file_size for member in members}

    def _holds(self, member: str) -> bool:
        return (self.path / member).is_file() if self._sizes is None else member in self._sizes

    def document(self, member: str, root: str) -> Node:
        """The root element of an XML document.

        Raises:
            ConfigError: it is missing, broken, or another kind of document.
        """
        from lxml import etree

        size = self._sizes.get(member, 0) if self._sizes is not None else (self.path / member).stat().st_size
        if size > _XML_BYTES:
            raise refuse(self.path, f"is refused: its {member} takes {size / 1e6:.0f} MB")
        parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
        try:
            node = Node(self.path, member, etree.fromstring(self.read(member), parser))
        except etree.XMLSyntaxError as error:
            where = Location(f"{self.path}/{member}", error.lineno or 0, error.offset or 1)
            raise ConfigError([Problem(f"broken XML: {error.msg}", where)]) from error
        if node.kind != root:
            raise node.error(f"expected {root}, found {node.kind}")
        if (node.get("version") or "1.0").split(".")[0] not in ("1", "2"):
            raise node.error(f"SSP {node.get('version')} is not known; 1.0 and 2.0 are")
        return node

    def read(self, member: str) -> bytes:
        """The content of a member.

        Raises:
            ConfigError: it is missing or damaged.
        """
        try:
            if self._sizes is None:
                return (self.path / member).read_bytes()
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(member)
        except KeyError:
            raise refuse(self.path, f"holds no {member}") from None
        except (OSError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
            raise refuse(self.path, f"cannot be unpacked: {member}: {error}") from error

    def resolve(self, node: Node, source: str) -> str:
        """The member that an attribute `source` of an element names.

        Raises:
            ConfigError: it lies outside of the package, or is not there.
        """
        uri = urlsplit(source)
        if uri.scheme or uri.netloc or uri.path.startswith("/"):
            raise node.error(f"source={source!r} lies outside of the package, which is not supported")
        member = posixpath.normpath(posixpath.join(posixpath.dirname(node.member), unquote(uri.path)))
        if not self._holds(member):
            raise node.error(f"the package holds no {member!r}")
        return member
