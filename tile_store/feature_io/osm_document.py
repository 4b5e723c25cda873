"""An OSM XML file: its nodes, ways and relations, each with its place in the bytes.

Format: wiki.openstreetmap.org/wiki/OSM_XML (version 0.6), with the additions of Lanelet2 and its editors (MetaInfo, no
version in the root). Only what features need is read; the bytes keep the rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite, nan
from typing import Final, TypeVar

from gnd.tile_store.feature_io.errors import BadElement, DuplicateId, FileTooLarge, MissingReference, UnknownFormat
from gnd.tile_store.feature_io.xml_spans import Element, read_root

MAX_FILE_BYTES: Final = 1_000_000_000
MAX_NODES: Final = 1_000_000
MAX_ID: Final = 2**63 - 1
VERSIONS: Final = ("0.6",)
_EVERY: Final = 10_000

Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much in all."""


@dataclass(frozen=True, slots=True)
class OsmElement:
    """A node, way or relation; its bytes are [start, end)."""

    id: int
    start: int
    end: int
    line: int
    tags: dict[str, str]


_T = TypeVar("_T", bound=OsmElement)


@dataclass(frozen=True, slots=True)
class OsmNode(OsmElement):
    """A node: degrees; NaN where only local coordinates are given."""

    lat_deg: float
    lon_deg: float


@dataclass(frozen=True, slots=True)
class OsmWay(OsmElement):
    """A way: ids of its nodes."""

    nodes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OsmRelation(OsmElement):
    """A relation: type, id and role of its members."""

    members: tuple[tuple[str, int, str], ...]

    def member(self, kind: str, role: str) -> list[int]:
        """Ids of the members of a type with a role."""
        return [ref for kind_, ref, role_ in self.members if (kind_, role_) == (kind, role)]


@dataclass(slots=True)
class OsmDocument:
    """The elements of a file by id; those that an editor has marked as deleted are not among them."""

    data: bytes = field(repr=False)
    where: str
    nodes: dict[int, OsmNode] = field(default_factory=dict)
    ways: dict[int, OsmWay] = field(default_factory=dict)
    relations: dict[int, OsmRelation] = field(default_factory=dict)
    end_of_nodes: int = 0
    """Where a new node can be written; likewise a new way."""
    end_of_ways: int = 0

    def nodes_of(self, way: OsmWay) -> list[OsmNode]:
        """The nodes of a way in order."""
        return [self.nodes[ref] for ref in way.nodes]

    @property
    def highest_id(self) -> int:
        """The largest id in use."""
        return max((abs(id_) for table in (self.nodes, self.ways, self.relations) for id_ in table), default=0)


def read_osm(data: bytes, where: str, *, max_nodes: int = MAX_NODES, progress: Progress | None = None) -> OsmDocument:
    """The document in the bytes of an OSM file.

    Raises:
        FeatureFileError: not well-formed, a document type, another format or version, an element without id or
            position, ids that come twice, references to what is not there, more than `max_nodes` nodes.
    """
    document = OsmDocument(data, where)
    reading = _OsmReading(document, max_nodes, progress)
    root = read_root(data, where, reading.child)
    _check_root(root, where)
    document.end_of_nodes = document.end_of_nodes or _inside(data, root)
    document.end_of_ways = max(document.end_of_ways, document.end_of_nodes)
    _check_references(document)
    return document


def _check_root(root: Element, where: str) -> None:
    if root.name != "osm":
        raise UnknownFormat(f"{where}: root element <{root.name[:40]}>, an OSM file has <osm>")
    version = root.attributes.get("version")
    if version is not None and version not in VERSIONS:
        raise UnknownFormat(f"{where}: OSM version {version!r:.20}, known is {', '.join(VERSIONS)}")


def _inside(data: bytes, root: Element) -> int:
    """Just after the start tag of a root that has no nodes."""
    return data.index(b">", root.start) + 1


class _OsmReading:
    """Takes the root's children one by one."""

    def __init__(self, document: OsmDocument, max_nodes: int, progress: Progress | None) -> None:
        self._to, self._max_nodes, self._progress, self._count = document, max_nodes, progress, 0

    def child(self, element: Element) -> None:
        self._count += 1
        if self._progress and self._count % _EVERY == 0:
            self._progress("reading", element.end, len(self._to.data))
        if element.name in ("node", "way", "relation"):
            if element.name == "node":
                self._to.end_of_nodes = element.end
            elif element.name == "way":
                self._to.end_of_ways = element.end
            if element.attributes.get("action") != "delete" and element.attributes.get("visible") != "false":
                self._keep(element)

    def _keep(self, element: Element) -> None:
        where = f"{self._to.where}, line {element.line}"
        common = (number(where, element, "id"), element.start, element.end, element.line, _tags(where, element))
        if element.name == "node":
            _put(where, self._to.nodes, OsmNode(*common, *(_degrees(where, element, k) for k in ("lat", "lon"))))
            if len(self._to.nodes) > self._max_nodes:
                raise FileTooLarge(f"{where}: more than {self._max_nodes} nodes; cut the map into several files")
        elif element.name == "way":
            refs = tuple(number(where, nd, "ref") for nd in element.all("nd"))
            _put(where, self._to.ways, OsmWay(*common, refs))
        else:
            _put(where, self._to.relations, OsmRelation(*common, _members(where, element)))


def _put(where: str, table: dict[int, _T], element: _T) -> None:
    if element.id in table:
        raise DuplicateId(f"{where}: id {element.id} comes twice, first in line {table[element.id].line}")
    table[element.id] = element


def number(where: str, element: Element, name: str) -> int:
    """An attribute that is a whole number; BadElement otherwise."""
    text = element.attributes.get(name)
    if text is None:
        raise BadElement(f"{where}: <{element.name}> without {name}")
    try:
        value = int(text)
    except ValueError:
        raise BadElement(f"{where}: {name}={text!r:.40} of <{element.name}> is no whole number") from None
    if abs(value) > MAX_ID:
        raise BadElement(f"{where}: {name}={text:.40} of <{element.name}> exceeds 2^63 - 1")
    return value


def _degrees(where: str, element: Element, name: str) -> float:
    text = element.attributes.get(name)
    if not text and {"local_x", "local_y"} <= {tag.attributes.get("k") for tag in element.all("tag")}:
        return nan  # editors of local maps leave the attribute empty
    if text is None:
        raise BadElement(f"{where}: node {element.attributes.get('id')} has no {name}, so no position")
    return real(where, f"{name} of node {element.attributes.get('id')}", text)


def real(where: str, what: str, text: str) -> float:
    """A finite number; BadElement otherwise."""
    try:
        value = float(text)
    except ValueError:
        raise BadElement(f"{where}: {what} is {text!r:.40}, no number") from None
    if not isfinite(value):
        raise BadElement(f"{where}: {what} is {text!r:.40}, not finite")
    return value


def _tags(where: str, element: Element) -> dict[str, str]:
    tags: dict[str, str] = {}
    for tag in element.all("tag"):
        key, value = tag.attributes.get("k"), tag.attributes.get("v")
        if key is None or value is None:
            raise BadElement(f"{where}: a tag of {element.name} {element.attributes.get('id')} lacks k or v")
        tags[key] = value
    return tags


def _members(where: str, element: Element) -> tuple[tuple[str, int, str], ...]:
    return tuple(
        (member.attributes.get("type", ""), number(where, member, "ref"), member.attributes.get("role", ""))
        for member in element.all("member")
    )


def _check_references(document: OsmDocument) -> None:
    """Every node of a way is there; so is every border of a lanelet. Members of other relations may be elsewhere."""
    for way in document.ways.values():
        absent = [ref for ref in way.nodes if ref not in document.nodes]
        if absent:
            raise MissingReference(
                f"{document.where}, line {way.line}: way {way.id} has {len(absent)} of {len(way.nodes)} nodes that are "
                f"not in the file, first {absent[0]}"
            )
    for relation in document.relations.values():
        if relation.tags.get("type") == "lanelet":
            _check_borders(document, relation)


def _check_borders(document: OsmDocument, relation: OsmRelation) -> None:
    for role in ("left", "right"):
        ways = relation.member("way", role)
        absent = [ref for ref in ways if ref not in document.ways]
        if not ways or absent:
            what = f"way {absent[0]} is not in the file" if absent else "none is given"
            raise MissingReference(
                f"{document.where}, line {relation.line}: the {role} border of lanelet {relation.id}: {what}"
            )
