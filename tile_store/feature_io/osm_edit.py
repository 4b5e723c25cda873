"""Changes to the bytes of an OSM file that touch nothing else: values, nodes of ways, elements that go or come."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan
from typing import Final

from gnd.tile_store.feature_io.osm_document import OsmElement
from gnd.tile_store.feature_io.xml_spans import Element, escaped, read_root, tag_of, with_attributes

INDENT: Final = b"  "


@dataclass(slots=True)
class Edits:
    """What replaces which bytes; each place at most once."""

    _cuts: list[tuple[int, int, bytes]] = field(default_factory=list)

    def replace(self, start: int, end: int, new: bytes) -> None:
        """Put `new` in place of [start, end)."""
        self._cuts.append((start, end, new))

    def __len__(self) -> int:
        return len(self._cuts)

    def applied(self, data: bytes) -> bytes:
        """The bytes after all changes."""
        parts, at = [], 0
        for start, end, new in sorted(self._cuts, key=lambda cut: cut[:2]):  # at one place: as they came
            parts += [data[at:start], new]
            at = end
        return b"".join((*parts, data[at:]))


def with_values(
    data: bytes, element: OsmElement, attributes: Mapping[str, str], tags: Mapping[str, str | None]
) -> bytes:
    """The bytes of an element with other attributes and tags (None: without the tag)."""
    raw = data[element.start : element.end]
    root, edits = read_root(raw, f"element {element.id}"), Edits()
    start_tag = tag_of(raw, root)
    new_start = with_attributes(start_tag, attributes)
    there = {tag.attributes["k"]: tag for tag in root.all("tag")}
    for key, value in tags.items():
        if key not in there:
            continue
        old = there[key]
        if value is None:
            edits.replace(*_line(raw, old), b"")
        else:
            edits.replace(old.start, old.end, with_attributes(raw[old.start : old.end], {"v": value}))
    added = {key: value for key, value in tags.items() if key not in there and value is not None}
    if added:
        new_start = _insert_tags(root, start_tag, new_start, added, edits)
    edits.replace(0, len(start_tag), new_start)
    return edits.applied(raw)


def _insert_tags(root: Element, start_tag: bytes, new_start: bytes, added: Mapping[str, str], edits: Edits) -> bytes:
    """Tags after the last child; an empty-element tag is opened for them."""
    lines = b"".join(b"\n" + 2 * INDENT + tag_line(key, value) for key, value in added.items())
    if start_tag.endswith(b"/>"):
        name = b"</" + root.name.encode() + b">"
        return new_start[:-2].rstrip() + b">" + lines + b"\n" + INDENT + name
    at = root.children[-1].end if root.children else len(start_tag)
    edits.replace(at, at, lines)
    return new_start


def with_nodes(data: bytes, element: OsmElement, refs: Sequence[int]) -> bytes:
    """The bytes of a way with other nodes."""
    raw = data[element.start : element.end]
    root, edits = read_root(raw, f"way {element.id}"), Edits()
    old = root.all("nd")
    for nd, ref in zip(old, refs, strict=False):
        edits.replace(nd.start, nd.end, with_attributes(raw[nd.start : nd.end], {"ref": str(ref)}))
    for nd in old[len(refs) :]:
        edits.replace(*_line(raw, nd), b"")
    lines = b"".join(b'\n    <nd ref="%d"/>' % ref for ref in refs[len(old) :])
    edits.replace(old[-1].end, old[-1].end, lines)
    return edits.applied(raw)


def without_members(data: bytes, relation: OsmElement, gone: Iterable[tuple[str, int]]) -> bytes:
    """The bytes of a relation without some of its members (type and id)."""
    raw, names = data[relation.start : relation.end], set(gone)
    root, edits = read_root(raw, f"relation {relation.id}"), Edits()
    for member in root.all("member"):
        if (member.attributes.get("type"), int(member.attributes["ref"])) in names:
            edits.replace(*_line(raw, member), b"")
    return edits.applied(raw)


def _line(raw: bytes, element: Element) -> tuple[int, int]:
    """An element with the white space before it."""
    start = element.start
    while start > 0 and raw[start - 1 : start].isspace():
        start -= 1
    return start, element.end


def line_of(data: bytes, element: OsmElement) -> tuple[int, int]:
    """The bytes of an element with the white space before it."""
    return _line(data, Element("", {}, element.start, element.end))


def tag_line(key: str, value: str) -> bytes:
    """<tag k="..." v="..."/>."""
    return b'<tag k="%s" v="%s"/>' % (escaped(key), escaped(value))


def node_lines(node_id: int, lat_deg: float, lon_deg: float, tags: Mapping[str, str]) -> bytes:
    """A node that begins on a new line."""
    head = b'\n  <node id="%d" lat="%s" lon="%s"' % (node_id, _degrees(lat_deg), _degrees(lon_deg))
    return _closed(head, b"node", [tag_line(*item) for item in tags.items()])


def way_lines(way_id: int, refs: Iterable[int], tags: Mapping[str, str]) -> bytes:
    """A way that begins on a new line."""
    inside = [*(b'<nd ref="%d"/>' % ref for ref in refs), *(tag_line(*item) for item in tags.items())]
    return _closed(b'\n  <way id="%d"' % way_id, b"way", inside)


def relation_lines(relation_id: int, members: Iterable[tuple[str, int, str]], tags: Mapping[str, str]) -> bytes:
    """A relation that begins on a new line; members are type, id and role."""
    inside = [b'<member type="%s" ref="%d" role="%s"/>' % (escaped(t), ref, escaped(role)) for t, ref, role in members]
    inside += [tag_line(*item) for item in tags.items()]
    return _closed(b'\n  <relation id="%d"' % relation_id, b"relation", inside)


def _closed(head: bytes, name: bytes, inside: list[bytes]) -> bytes:
    if not inside:
        return head + b"/>"
    return head + b">" + b"".join(b"\n    " + line for line in inside) + b"\n  </" + name + b">"


def _degrees(value: float) -> bytes:
    return b"" if isnan(value) else degrees(value).encode()


def degrees(value: float) -> str:
    """Degrees to a micrometre."""
    return f"{value:.11f}"


def metres(value: float) -> str:
    """Metres to a tenth of a millimetre."""
    return f"{value:.4f}"
