"""Splices in OSM files: what is asked for changes, every other byte stays, whatever the file looks like."""

import xml.etree.ElementTree as ET

from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.tile_store.feature_io.lanelet2_export import write_lanelet2
from gnd.tile_store.feature_io.lanelet2_import import read_lanelet2
from gnd.tile_store.feature_io.osm_document import OsmDocument, read_osm
from gnd.tile_store.feature_io.osm_edit import Edits, line_of, with_nodes, with_values, without_members
from gnd.tile_store.feature_io.values import ImportOptions
from gnd.tile_store.feature_io.xml_spans import escaped, read_root, tag_of, with_attributes

TEXT = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"], exclude_characters="\ufffe\uffff"), max_size=12
)
KEYS = st.text("abcdefgh:_", min_size=1, max_size=8)
SPACE = st.text(" \n\t", max_size=3)
QUOTE = st.sampled_from(["'", '"'])


@st.composite
def attribute(draw: st.DrawFn, name: str, value: str) -> str:
    quote = draw(QUOTE)
    told = escaped(value).decode().replace("'", "&apos;")
    return f" {draw(SPACE)}{name}{draw(SPACE)}={draw(SPACE)}{quote}{told}{quote}"


@st.composite
def tags(draw: st.DrawFn, values: dict[str, str]) -> str:
    told = []
    for key, value in values.items():
        inside = draw(attribute("k", key)) + draw(attribute("v", value))
        end = draw(st.sampled_from(["/>", "></tag>"]))
        told.append(f"{draw(SPACE)}<tag{inside}{draw(SPACE)}{end}")
    return "".join(told)


@st.composite
def documents(draw: st.DrawFn) -> bytes:
    """Two nodes and a border between them, dressed in any white space, quotes and tags, with strangers in between."""
    strangers = st.sampled_from(["", "<!-- a > b -->", "<other x='>'/>", "<?pi ?>", "<note>&lt;</note>"])
    parts = ["<osm>"]
    for id_ in (1, 2):
        said = draw(st.dictionaries(KEYS, TEXT, max_size=2)) | {"ele": "1.5"}
        head = draw(attribute("id", str(id_))) + draw(attribute("lat", f"48.000{id_}")) + draw(attribute("lon", "11"))
        parts += [
            draw(SPACE),
            f"<node{head}{draw(SPACE)}>",
            draw(tags(said)),
            draw(strangers),
            "</node>",
            draw(strangers),
        ]
    said = draw(st.dictionaries(KEYS, TEXT, max_size=3)) | {"type": "line_thin"}
    nodes = "".join(f"{draw(SPACE)}<nd{draw(attribute('ref', str(id_)))}/>" for id_ in (1, 2))
    parts += [f"<way{draw(attribute('id', '3'))}>", nodes, draw(strangers), draw(tags(said)), "</way>", draw(strangers)]
    return ("".join(parts) + "</osm>").encode()


@settings(max_examples=60, deadline=None)
@given(documents())
def test_any_file_comes_back_as_it_was(data: bytes) -> None:
    file = read_lanelet2(data, "x", "x", ImportOptions())
    assert write_lanelet2(file.features, data, "x", ImportOptions())[0] == data
    assert len(file.features) == 1


@settings(max_examples=60, deadline=None)
@given(documents(), st.dictionaries(KEYS, TEXT, min_size=1, max_size=3))
def test_other_values_are_read_back_and_nothing_else_has_changed(data: bytes, values: dict[str, str]) -> None:
    document = read_osm(data, "x")
    way, before = document.ways[3], ET.fromstring(data)
    raw = with_values(data, way, {"id": "5"}, {**values, "type": None})
    after = ET.fromstring(data[: way.start] + raw + data[way.end :])
    assert [ET.tostring(one) for one in before if one.tag != "way"] == [
        ET.tostring(one) for one in after if one.tag != "way"
    ]
    old, new = before.find("way"), after.find("way")
    assert old is not None
    assert new is not None
    assert new.attrib == {"id": "5"}
    said = {tag.attrib["k"]: tag.attrib["v"] for tag in old.iter("tag")} | values
    del said["type"]
    assert {tag.attrib["k"]: tag.attrib["v"] for tag in new.iter("tag")} == said
    assert [nd.attrib for nd in new.iter("nd")] == [nd.attrib for nd in old.iter("nd")]


def document(text: str) -> OsmDocument:
    return read_osm(text.encode(), "x")


def test_an_empty_element_is_opened_for_tags() -> None:
    read = document('<osm><node id="1" lat="1" lon="2" /></osm>')
    raw = with_values(read.data, read.nodes[1], {"lat": "3"}, {"type": "pole"})
    assert raw == b'<node id="1" lat="3" lon="2">\n    <tag k="type" v="pole"/>\n  </node>'


def test_an_attribute_that_is_not_there_is_added() -> None:
    assert with_attributes(b"<a/>", {"b": '1"<'}) == b'<a b="1&quot;&lt;"/>'
    assert with_attributes(b"<a c='x>'>", {"b": "1"}) == b"<a c='x>' b=\"1\">"
    assert with_attributes(b"<a xb='0' b='0'>", {"b": "1"}) == b"<a xb='0' b=\"1\">"


NODES = '<node id="1" lat="1" lon="1"/><node id="2" lat="1" lon="2"/>'
WAY = f'<osm>{NODES}<way id="3">\n <nd ref="1"/>\n <nd ref="2"/>\n</way></osm>'


def test_a_way_gets_other_nodes() -> None:
    read = document(WAY)
    assert with_nodes(read.data, read.ways[3], [2]) == b'<way id="3">\n <nd ref="2"/>\n</way>'
    longer = b'<way id="3">\n <nd ref="1"/>\n <nd ref="9"/>\n    <nd ref="2"/>\n</way>'
    assert with_nodes(read.data, read.ways[3], [1, 9, 2]) == longer


def test_a_relation_loses_members() -> None:
    text = '<relation id="4"> <member type="way" ref="3" role="a"/> <member type="node" ref="3" role="b"/></relation>'
    read = document(WAY.replace("</osm>", text + "</osm>"))
    left = without_members(read.data, read.relations[4], [("way", 3)])
    assert left == b'<relation id="4"> <member type="node" ref="3" role="b"/></relation>'


def test_edits_are_applied_in_order_of_place() -> None:
    edits = Edits()
    edits.replace(4, 6, b"")
    edits.replace(6, 6, b"new")
    edits.replace(0, 1, b"A")
    assert (edits.applied(b"abcdefgh"), len(edits)) == (b"Abcdnewgh", 3)


def test_places_are_those_of_the_bytes() -> None:
    data = "<osm>ü <a b='>'>é<c/></a>  <node id='1' lat='0' lon='0'/></osm>".encode()
    root = read_root(data, "x")
    a, node = root.children
    assert data[a.start : a.end].decode() == "<a b='>'>é<c/></a>"
    assert tag_of(data, a) == b"<a b='>'>"
    assert data[a.children[0].start : a.children[0].end] == b"<c/>"
    assert data[slice(*line_of(data, read_osm(data, "x").nodes[1]))] == b"  <node id='1' lat='0' lon='0'/>"
    assert data[node.start : node.end] == b"<node id='1' lat='0' lon='0'/>"
