"""osmChange files: what turns one map into another turns it into that, and nothing else is taken."""

import pytest

from gnd.tile_store.feature_io.errors import (
    BadElement,
    DuplicateId,
    FeatureFileError,
    MissingReference,
    UnknownFormat,
)
from gnd.tile_store.feature_io.osm_change import apply_osm_change, osm_change
from gnd.tile_store.feature_io.osm_document import read_osm

HEAD = b'<?xml version="1.0"?>\n<osm version="0.6">\n'
BEFORE = (
    HEAD
    + b"""  <node id="1" lat="49.0" lon="8.0"/>
  <node id="2" lat="49.1" lon="8.0"/>
  <node id="3" lat="49.2" lon="8.0"/>
  <way id="10">
    <nd ref="1"/>
    <nd ref="2"/>
    <tag k="type" v="line_thin"/>
  </way>
</osm>
"""
)
AFTER = (
    HEAD
    + b"""  <node id="1" lat="49.05" lon="8.0"/>
  <node id="2" lat="49.1" lon="8.0"/>
  <node id="4" lat="49.3" lon="8.0"/>
  <way id="10">
    <nd ref="1"/>
    <nd ref="2"/>
    <nd ref="4"/>
    <tag k="type" v="virtual"/>
  </way>
  <way id="11">
    <nd ref="2"/>
    <nd ref="4"/>
  </way>
</osm>
"""
)


def _content(data):
    read = read_osm(data, "map")
    nodes = {(one.id, one.lat_deg, one.lon_deg, tuple(one.tags.items())) for one in read.nodes.values()}
    return nodes, {(one.id, one.nodes, tuple(one.tags.items())) for one in read.ways.values()}


def test_what_is_told_makes_the_other_map():
    change = osm_change(BEFORE, AFTER)
    assert change.counts == {
        "create": {"node": 1, "way": 1, "relation": 0},
        "modify": {"node": 1, "way": 1, "relation": 0},
        "delete": {"node": 1, "way": 0, "relation": 0},
    }
    assert _content(apply_osm_change(BEFORE, change.data)) == _content(AFTER)


def test_a_map_that_is_the_same_stays_byte_by_byte():
    assert apply_osm_change(BEFORE, osm_change(BEFORE, BEFORE).data) == BEFORE


@pytest.mark.parametrize(
    ("inside", "error"),
    [
        (b'<modify><node id="77" lat="1" lon="1"/></modify>', MissingReference),
        (b'<delete><node id="1"/></delete>', MissingReference),
        (b'<create><node id="1" lat="1" lon="1"/></create>', DuplicateId),
        (b'<modify><node id="1" lat="1" lon="1"/><node id="1" lat="2" lon="1"/></modify>', DuplicateId),
        (b'<modify><node lat="1" lon="1"/></modify>', BadElement),
        (b'<modify><node id="1" lat="nan" lon="1"/></modify>', BadElement),
        (b'<modify><area id="1"/></modify>', BadElement),
        (b'<burn><node id="1"/></burn>', UnknownFormat),
    ],
)
def test_what_does_not_fit_is_refused(inside, error):
    with pytest.raises(error):
        apply_osm_change(BEFORE, b'<osmChange version="0.6">' + inside + b"</osmChange>")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf_16_is_refused_whether_it_says_so_or_not(encoding):
    """The places of its elements are not those of its bytes."""
    change = osm_change(BEFORE, AFTER).data
    for text in ("\ufeff" + change.decode().split("\n", 1)[1], change.decode()):
        with pytest.raises(FeatureFileError):
            apply_osm_change(BEFORE, text.encode(encoding))
        with pytest.raises(FeatureFileError):
            read_osm(text.replace("osmChange", "osm").encode(encoding), "map")


def test_other_files_and_torn_ones_are_refused():
    with pytest.raises(UnknownFormat, match="osmChange"):
        apply_osm_change(BEFORE, BEFORE)
    change = osm_change(BEFORE, AFTER).data
    for end in range(60, len(change) - 14, 37):
        with pytest.raises(FeatureFileError):
            apply_osm_change(BEFORE, change[:end])
