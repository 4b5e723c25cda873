"""Edits of an OSM file as a file of their own (osmChange, `.osc`): what to create, modify and delete, and applying it.

Format: wiki.openstreetmap.org/wiki/OsmChange. Elements are written as the edited file has them. Order: nodes before
ways before relations where something comes, the other way round where it goes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gnd.tile_store.feature_io.errors import BadElement, DuplicateId, MissingReference, UnknownFormat
from gnd.tile_store.feature_io.osm_document import OsmDocument, OsmElement, number, read_osm
from gnd.tile_store.feature_io.osm_edit import Edits, line_of
from gnd.tile_store.feature_io.xml_spans import Element, read_root

_KINDS: Final = ("node", "way", "relation")
_BLOCKS: Final = ("create", "modify", "delete")


@dataclass(frozen=True, slots=True)
class OsmChange:
    """The bytes of an osmChange file, and how many elements of each kind it touches.

    Attributes:
        data: the file.
        counts: by block ("create", "modify", "delete") and kind ("node", ...).
    """

    data: bytes
    counts: Mapping[str, Mapping[str, int]]


def osm_change(before: bytes, after: bytes, where: str = "map") -> OsmChange:
    """What turns one OSM file into another.

    Raises:
        FeatureFileError: one of the two is no OSM file.
    """
    old, new = read_osm(before, where), read_osm(after, f"{where} as edited")
    blocks: dict[str, list[bytes]] = {name: [] for name in _BLOCKS}
    counts = {name: dict.fromkeys(_KINDS, 0) for name in _BLOCKS}
    for kind in _KINDS:
        was, now = _table(old, kind), _table(new, kind)
        put = {
            "create": [_raw(new, now[id_]) for id_ in now if id_ not in was],
            "modify": [_raw(new, now[id_]) for id_ in now if id_ in was and _raw(new, now[id_]) != _raw(old, was[id_])],
        }
        gone = [_raw(old, was[id_]) for id_ in was if id_ not in now]
        for name, some in put.items():
            blocks[name] += some
            counts[name][kind] = len(some)
        blocks["delete"] = gone + blocks["delete"]
        counts["delete"][kind] = len(gone)
    inside = b"".join(
        b"\n <%s>" % name.encode() + b"".join(b"\n  " + one for one in some) + b"\n </%s>" % name.encode()
        for name, some in blocks.items()
        if some
    )
    data = b'<?xml version="1.0" encoding="UTF-8"?>\n<osmChange version="0.6" generator="gnd">' + inside
    return OsmChange(data + b"\n</osmChange>\n", counts)


def apply_osm_change(data: bytes, change: bytes, where: str = "map") -> bytes:
    """An OSM file after the edits of an osmChange file; all of them, or an error.

    Raises:
        UnknownFormat: the edits are no osmChange file.
        MissingReference: an element to modify or delete is not in the file, or what is left refers to what has gone.
        DuplicateId: an element to create is in the file.
    """
    document, edits = read_osm(data, where), Edits()
    root = read_root(change, "edits")
    if root.name != "osmChange":
        raise UnknownFormat(f"edits: root element <{root.name[:40]}>, an osmChange file has <osmChange>")
    new: dict[str, list[bytes]] = {kind: [] for kind in _KINDS}
    touched: set[tuple[str, int]] = set()
    for block in root.children:
        if block.name not in _BLOCKS:
            raise UnknownFormat(f"edits, line {block.line}: <{block.name[:40]}> is none of {', '.join(_BLOCKS)}")
        for element in block.children:
            key = _key(element)
            if key in touched:
                raise DuplicateId(f"edits, line {element.line}: {key[0]} {key[1]} is edited twice")
            touched.add(key)
            _apply(document, edits, new, block.name, element, change[element.start : element.end])
    if new["node"]:
        edits.replace(document.end_of_nodes, document.end_of_nodes, b"".join(new["node"]))
    if new["way"] or new["relation"]:
        edits.replace(document.end_of_ways, document.end_of_ways, b"".join([*new["way"], *new["relation"]]))
    edited = edits.applied(data)
    read_osm(edited, f"{where} as edited")
    return edited


def _apply(
    document: OsmDocument, edits: Edits, new: dict[str, list[bytes]], block: str, element: Element, raw: bytes
) -> None:
    kind, id_ = _key(element)
    there = _table(document, kind).get(id_)
    if block == "create":
        if there is not None:
            raise DuplicateId(f"edits, line {element.line}: {kind} {id_} is to be created and is in the map")
        new[kind].append(b"\n  " + raw)
        return
    if there is None:
        raise MissingReference(f"edits, line {element.line}: {kind} {id_} is to be edited ({block}) and not in the map")
    if block == "delete":
        edits.replace(*line_of(document.data, there), b"")
    else:
        edits.replace(there.start, there.end, raw)


def _key(element: Element) -> tuple[str, int]:
    if element.name not in _KINDS:
        raise BadElement(f"edits, line {element.line}: <{element.name[:40]}> is none of {', '.join(_KINDS)}")
    return element.name, number(f"edits, line {element.line}", element, "id")


def _table(document: OsmDocument, kind: str) -> Mapping[int, OsmElement]:
    tables: dict[str, Mapping[int, OsmElement]] = {
        "node": document.nodes, "way": document.ways, "relation": document.relations
    }  # fmt: skip
    return tables[kind]


def _raw(document: OsmDocument, element: OsmElement) -> bytes:
    return document.data[element.start : element.end]
