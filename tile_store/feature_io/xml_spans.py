"""XML read with the place of every element in the file's bytes, so that an edited file keeps all else byte by byte.

Document types are refused before anything of them is read, and with them every entity but XML's own five: no entity can
be expanded, none can name a file or an address.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat  # S405 does not hold: expat is what the safe wrappers use, and document types are refused

from gnd.tile_store.feature_io.errors import FileTooLarge, NotWellFormed, UnknownFormat, UnsafeFile

MAX_DEPTH: Final = 64
_TAG: Final = re.compile(rb"""<[^>"']*(?:"[^"]*"[^>"']*|'[^']*'[^>"']*)*>""")
_ENTITIES: Final = (
    ("&", "&amp;"),
    ("<", "&lt;"),
    (">", "&gt;"),
    ('"', "&quot;"),
    ("\n", "&#10;"),
    ("\t", "&#9;"),
    ("\r", "&#13;"),
)
_UTF_16_MARKS: Final = (b"\xff\xfe", b"\xfe\xff")
_ENCODINGS: Final = (None, "utf-8", "us-ascii")


@dataclass(slots=True)
class Element:
    """One element: its name, attributes, children, and its bytes [start, end) in the file."""

    name: str
    attributes: dict[str, str]
    start: int
    end: int = -1
    line: int = 0
    children: "list[Element]" = field(default_factory=list)
    text: str = ""

    def find(self, name: str) -> "Element | None":
        """The first child of this name."""
        return next((child for child in self.children if child.name == name), None)

    def all(self, name: str) -> "list[Element]":
        """The children of this name."""
        return [child for child in self.children if child.name == name]


Handler = Callable[[Element], None]


def read_root(data: bytes, where: str, on_child: Handler | None = None) -> Element:
    """The root element of a document.

    Args:
        data: UTF-8 (or ASCII) XML.
        where: what to call it in messages.
        on_child: called with every complete child of the root, which is then not kept: for files of any size.

    Raises:
        NotWellFormed: says in which line.
        UnsafeFile: there is a document type.
        UnknownFormat: another encoding.
        FileTooLarge: elements lie too deep.
    """
    reading = _XmlReading(data, where, on_child)
    if data[:2] in _UTF_16_MARKS or b"\0" in data[:4]:  # expat would read it, and places would not be those of tags
        raise UnknownFormat(f"{where}: UTF-16 or UTF-32; maps are UTF-8")
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.XmlDeclHandler = reading.declaration
    parser.StartDoctypeDeclHandler = reading.doctype
    parser.StartElementHandler = lambda name, attributes: reading.start(parser, name, attributes)
    parser.EndElementHandler = lambda _name: reading.finish(parser)
    parser.CharacterDataHandler = reading.said
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise NotWellFormed(f"{where}: not well-formed XML: {error}") from None
    assert reading.root is not None
    return reading.root


class _XmlReading:
    def __init__(self, data: bytes, where: str, on_child: Handler | None) -> None:
        self.root: Element | None = None
        self._data, self._where, self._on_child = data, where, on_child
        self._open: list[Element] = []

    def declaration(self, _version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and encoding.lower() not in _ENCODINGS:
            raise UnknownFormat(f"{self._where}: encoding {encoding!r:.40}; maps are UTF-8")

    def doctype(self, name: str, _system: str | None, _public: str | None, _internal: int) -> None:
        raise UnsafeFile(f"{self._where}: declares the document type {name!r:.40}, which no map needs; remove it")

    def start(self, parser: expat.XMLParserType, name: str, attributes: dict[str, str]) -> None:
        element = Element(name, attributes, parser.CurrentByteIndex, line=parser.CurrentLineNumber)
        if len(self._open) >= MAX_DEPTH:
            raise FileTooLarge(f"{self._where}, line {element.line}: more than {MAX_DEPTH} elements inside each other")
        if self._open and not (self._on_child and len(self._open) == 1):
            self._open[-1].children.append(element)
        self._open.append(element)

    def finish(self, parser: expat.XMLParserType) -> None:
        element = self._open.pop()
        element.end = _tag_end(self._data, element.start)
        if self._data[element.end - 2] != ord("/"):  # not an empty-element tag: there is an end tag
            element.end = _tag_end(self._data, parser.CurrentByteIndex)
        if not self._open:
            self.root = element
        elif self._on_child and len(self._open) == 1:
            self._on_child(element)

    def said(self, text: str) -> None:
        if self._open:
            self._open[-1].text += text


def _tag_end(data: bytes, start: int) -> int:
    """One past the tag that begins at `start`."""
    found = _TAG.match(data, start)
    assert found is not None  # expat has seen this tag
    return found.end()


def tag_of(data: bytes, element: Element) -> bytes:
    """The start tag of an element as it is written."""
    return data[element.start : _tag_end(data, element.start)]


def with_attributes(tag: bytes, values: Mapping[str, str]) -> bytes:
    """A start tag whose attributes have other values; one that it has not is added, all else stays as it is."""
    for name, value in values.items():
        told = escaped(value)
        pattern = re.compile(rb"""(\s%s\s*=\s*)("[^"]*"|'[^']*')""" % re.escape(name.encode()))
        tag, n = pattern.subn(lambda found, told=told: found[1] + b'"' + told + b'"', tag, count=1)  # type: ignore[misc]
        if not n:
            end = len(tag) - (2 if tag.endswith(b"/>") else 1)
            tag = tag[:end].rstrip() + b' %s="%s"' % (name.encode(), told) + tag[end:]
    return tag


def escaped(text: str) -> bytes:
    """Text as it stands between double quotes."""
    for character, entity in _ENTITIES:
        text = text.replace(character, entity)
    return text.encode()


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """A file's bytes.

    Raises:
        NotWellFormed: it cannot be read.
        FileTooLarge: it is larger than `max_bytes`.
    """
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise FileTooLarge(f"{path}: {size / 1e6:.1f} MB, the limit is {max_bytes / 1e6:.1f} MB")
        return path.read_bytes()
    except OSError as error:
        raise NotWellFormed(f"{path}: cannot be read: {error.strerror}") from None
