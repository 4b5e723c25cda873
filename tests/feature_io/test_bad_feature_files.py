"""What is wrong with a file is said with numbers and the place, and nothing of it is imported."""

import json
from pathlib import Path

import numpy as np
import pytest
from small_maps import STREET, exported, put, write

from gnd.gnd_map.errors import GndError
from gnd.tile_store.feature_io import errors
from gnd.tile_store.feature_io.formats import format_of, read_features
from gnd.tile_store.feature_io.json_file import read_json
from gnd.tile_store.feature_io.lane_crossing import crossing_of
from gnd.tile_store.feature_io.osm_document import read_osm
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.values import ImportOptions
from gnd.tile_store.feature_io.xml_spans import read_bytes, read_root
from gnd.tile_store.sqlite_store import SqliteStore

NODES = '<node id="1" lat="49" lon="8"/><node id="2" lat="49.0001" lon="8.0001"/>'
BOMB = """<?xml version="1.0"?>
<!DOCTYPE lolz [<!ENTITY a "lol"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>
<osm><node id="1" lat="49" lon="8"><tag k="type" v="&c;"/></node></osm>"""
OUTSIDE = '<!DOCTYPE osm SYSTEM "file:///etc/hostname"><osm/>'


def osm(inside: str, attributes: str = 'version="0.6"') -> str:
    return f"<osm {attributes}>{inside}</osm>"


def line(id_: int, *refs: int, tags: str = '<tag k="type" v="line_thin"/>') -> str:
    return f'<way id="{id_}">{"".join(f"<nd ref={chr(34)}{ref}{chr(34)}/>" for ref in refs)}{tags}</way>'


def lanelet(left: int, right: int) -> str:
    return (
        f'<relation id="9"><member type="way" ref="{left}" role="left"/><member type="way" ref="{right}" role="right"/>'
        '<tag k="type" v="lanelet"/></relation>'
    )


def nodes(*places: tuple[float, float]) -> str:
    return "".join(f'<node id="{i}" lat="{lat}" lon="{lon}"/>' for i, (lat, lon) in enumerate(places, 1))


CROSSED = nodes((49, 8), (49.0001, 8.0001), (49.0001, 8), (49, 8.0001))
OSM = [
    ("<osm><node", errors.NotWellFormed, "line 1"),
    ("", errors.NotWellFormed, "no element found"),
    (osm(NODES).replace("</osm>", "</oms>"), errors.NotWellFormed, "mismatched tag"),
    (BOMB, errors.UnsafeFile, "document type 'lolz'"),
    (OUTSIDE, errors.UnsafeFile, "document type 'osm'"),
    ('<?xml version="1.0" encoding="ISO-8859-1"?>' + osm(NODES), errors.UnknownFormat, "encoding 'ISO-8859-1'"),
    ("<gpx/>", errors.UnknownFormat, "root element <gpx>"),
    (osm(NODES, 'version="0.5"'), errors.UnknownFormat, "OSM version '0.5', known is 0.6"),
    (osm('<node id="1" lat="49"/>'), errors.BadElement, "node 1 has no lon, so no position"),
    (osm('<node lat="49" lon="8"/>'), errors.BadElement, "<node> without id"),
    (osm('<node id="x" lat="49" lon="8"/>'), errors.BadElement, "id='x' of <node> is no whole number"),
    (osm('<node id="1" lat="far" lon="8"/>'), errors.BadElement, "lat of node 1 is 'far', no number"),
    (osm('<node id="1" lat="nan" lon="8"/>'), errors.BadElement, "lat of node 1 is 'nan', not finite"),
    (osm(f'<node id="{2**63}" lat="49" lon="8"/>'), errors.BadElement, "exceeds 2^63 - 1"),
    (osm('<node id="1" lat="49" lon="8"><tag k="type"/></node>'), errors.BadElement, "a tag of node 1 lacks k or v"),
    (osm('<node id="1" lat="91" lon="8"/>'), errors.BadGeometry, "node 1: latitude 91.000000 degrees is beyond 90"),
    (osm('<node id="1" lat="9" lon="-181"/>'), errors.BadGeometry, "longitude -181.000000 degrees is beyond 180"),
    (
        osm('<node id="1" lat="49" lon="8"><tag k="ele" v="20000"/></node>'),
        errors.BadGeometry,
        "height 20000.0 m is not in -1000 … 10000 m",
    ),
    (
        osm('<node id="1" lat="49" lon="8"><tag k="ele" v="high"/></node>'),
        errors.BadElement,
        "ele of node 1 is 'high', no number",
    ),
    (osm(NODES + NODES), errors.DuplicateId, "id 1 comes twice, first in line 1"),
    (osm(NODES + line(5, 1, 2) + line(5, 2, 1)), errors.DuplicateId, "id 5 comes twice"),
    (
        osm(NODES + line(5, 1, 7, 8)),
        errors.MissingReference,
        "way 5 has 2 of 3 nodes that are not in the file, first 7",
    ),
    (osm(NODES + lanelet(5, 6)), errors.MissingReference, "the left border of lanelet 9: way 5 is not in the file"),
    (
        osm(NODES + line(5, 1, 2) + lanelet(5, 5).replace("right", "centre")),
        errors.MissingReference,
        "the right border of lanelet 9: none is given",
    ),
    (
        osm('<node id="1" lat="0" lon="0"><tag k="local_x" v="5"/><tag k="local_y" v="6"/></node>'),
        errors.NeedsGeoreference,
        "1 of 1 nodes have local_x and local_y",
    ),
    (osm(NODES + line(5, 1, 2, tags='<tag k="type" v="river"/>')), errors.FeatureFileError, "1 of kind river"),
    (osm(NODES), errors.FeatureFileError, "no features to import"),
]


@pytest.mark.parametrize(("body", "kind", "told"), OSM, ids=[told for _, _, told in OSM])
def test_a_lanelet2_file_with_a_fault_is_refused_whole(
    body: str, kind: type[Exception], told: str, store: SqliteStore, tmp_path: Path
) -> None:
    with pytest.raises(kind) as caught:
        put(store, write(tmp_path, "bad.osm", body))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "bad.osm" in str(caught.value)
    assert store.layers() == []


CROSSINGS = [
    (osm(NODES + line(6, 1, 2) + line(5, 1)), "way 5 (lane_boundary) has 1 nodes; a line needs 2"),
    (osm(NODES + line(6, 1, 2) + line(5)), "way 5 (lane_boundary) has 0 nodes; a line needs 2"),
    (osm(CROSSED + line(5, 1, 2, 3, 4)), "way 5 crosses itself: segments 0 and 2 of 3"),
    (
        osm(CROSSED + line(5, 1, 2) + line(6, 3, 4) + lanelet(5, 6)),
        "the borders of lanelet 9 cross each other (segment 1 of 1 on the left, 1 of 1 on the right)",
    ),
]


@pytest.mark.parametrize(("body", "told"), CROSSINGS, ids=["one node", "no node", "a line", "borders"])
def test_odd_lines_are_reported_and_kept_and_strictly_refused(
    body: str, told: str, store: SqliteStore, tmp_path: Path
) -> None:
    file = write(tmp_path, "odd.osm", body)
    with pytest.raises(errors.BadGeometry, match=r"cross|needs 2"):
        put(store, file, ImportOptions(strict=True))
    assert store.layers() == []
    result = put(store, file)
    assert told in result.notes[0]
    assert exported(store, tmp_path / "back.osm") == body.encode()


def test_of_many_findings_the_first_are_written_out(store: SqliteStore, tmp_path: Path) -> None:
    notes = put(
        store, write(tmp_path, "odd.osm", osm(CROSSED + "".join(line(n, 1, 2, 3, 4) for n in range(5, 35))))
    ).notes
    assert len(notes) == 21
    assert notes[-1] == "and 10 more findings (--strict refuses the file)"


def test_too_many_nodes_are_counted() -> None:
    with pytest.raises(errors.FileTooLarge, match="more than 1 nodes"):
        read_osm(osm(NODES).encode(), "big", max_nodes=1)


def test_a_line_has_an_end(store: SqliteStore, tmp_path: Path) -> None:
    body = osm(NODES + line(5, *[1, 2] * 10_001))
    with pytest.raises(errors.FileTooLarge, match="way 5: 20002 vertices, a line has at most 20000"):
        put(store, write(tmp_path, "long.osm", body))
    long = osm(NODES + line(5, *[1, 2] * 10_001) + line(6, 1, 2) + lanelet(6, 5))
    left_out = ImportOptions({"lane_boundary": "-"})
    with pytest.raises(errors.FileTooLarge, match="right border of lanelet 9: 20002 vertices"):
        put(store, write(tmp_path, "long.osm", long), left_out)


def test_lines_are_held_against_each_other_in_blocks() -> None:
    x = np.arange(5000.0)
    a, b = np.column_stack([x, np.zeros(5000)]), np.column_stack([x, np.full(5000, 2.0)])
    assert crossing_of(a, b) is None
    b[4321:, 1] = -2.0
    assert crossing_of(a, b) == (4320, 4320)
    assert crossing_of(b, a) == (4320, 4320)


def test_too_many_bytes_are_not_even_read(tmp_path: Path) -> None:
    with pytest.raises(errors.FileTooLarge, match=r"0\.0 MB, the limit is 0\.0 MB"):
        read_bytes(write(tmp_path, "a.osm", "12345"), 4)
    with pytest.raises(errors.NotWellFormed, match="cannot be read: No such file"):
        read_bytes(tmp_path / "none.osm", 4)


def test_too_deep_is_refused() -> None:
    with pytest.raises(errors.FileTooLarge, match="more than 64 elements inside each other"):
        read_root(b"<a>" * 100 + b"</a>" * 100, "deep")
    with pytest.raises(errors.NotWellFormed):
        read_json(b"[" * 100_000 + b"]" * 100_000, "deep")


def test_elements_that_an_editor_has_deleted_do_not_count() -> None:
    body = osm(NODES + '<node id="3" action="delete" lat="x" lon="y"/><way id="3" visible="false"><nd ref="77"/></way>')
    assert sorted(read_osm(body.encode(), "josm").nodes) == [1, 2]


def geojson(*features: object, **members: object) -> str:
    return json.dumps({"type": "FeatureCollection", "features": features} | members)


def point(position: object, **properties: object) -> dict[str, object]:
    return {"type": "Feature", "geometry": {"type": "Point", "coordinates": position}, "properties": properties}


OURS = {
    "feature_id": "5", "layer": "poles", "kind": "pole", "state": "exist", "exist": 0.9, "absent": 0.0, "unknown": 0.1,
    "conflict": 0.0, "hits": 0, "vehicles": 0, "sigma_m": 1.0, "cov_m2": [1.0, 0, 0, 1.0, 0, 1.0], "attributes": {},
}  # fmt: skip
GND = {"gnd": {"format": 1}}
CRS = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
ZIGZAG = [[8, 49], [8.0001, 49.0001], [8, 49.0001], [8.0001, 49]]
GEOJSON = [
    ('{"type": "Feat', errors.NotWellFormed, "not well-formed JSON"),
    ('{"type": "FeatureCollection", "features": [NaN]}', errors.NotWellFormed, "NaN is no JSON number"),
    ("[]", errors.BadElement, "expected an object, got list"),
    ("{}", errors.BadElement, "has no type"),
    ('{"type": "Topology"}', errors.UnknownFormat, "type 'Topology'"),
    (geojson(crs=CRS), errors.UnknownFormat, "EPSG::25832"),
    (geojson(gnd={"format": 9}), errors.UnknownFormat, "format {'format': 9} of gnd; known is 1"),
    (geojson(point([8, 49], kind="pole") | {"geometry": None}), errors.BadGeometry, "feature 0: has no position"),
    (geojson(point([], kind="pole")), errors.BadGeometry, "position [] is not [longitude, latitude]"),
    (geojson(point([8, "x"], kind="pole")), errors.BadElement, "'x' is no number"),
    (geojson(point([8, 91], kind="pole")), errors.BadGeometry, "latitude 91.000000 degrees is beyond 90"),
    (geojson(point([8, 49], kind="pole"), {"type": "Point"}), errors.BadElement, "feature 1: type 'Point'"),
    (
        geojson({"type": "Feature", "geometry": {"type": "GeometryCollection", "geometries": []}}),
        errors.BadGeometry,
        "geometry 'GeometryCollection'",
    ),
    (geojson(*[point([8, 49], kind="pole") | {"id": "a"}] * 2), errors.DuplicateId, "same id"),
    (geojson(point([8, 49], kind="pole"), **GND), errors.BadElement, "lacks the properties absent, conflict"),
    (geojson(point([8, 49], **OURS | {"feature_id": "x"})), errors.BadElement, "invalid literal for int()"),
    (geojson(point([8, 49], **OURS | {"attributes": "["})), errors.NotWellFormed, "not well-formed JSON"),
    (geojson(point([8, 49], **OURS | {"attributes": [1]})), errors.BadElement, "attributes"),
    (geojson(point([8, 49], **OURS | {"exist": 0.3}) | {"id": "5"}, **GND), errors.BadElement, "sum to"),
    (geojson(point([8, 49], **OURS | {"cov_m2": [1]}) | {"id": "5"}, **GND), errors.BadGeometry, "covariance of"),
]  # fmt: skip


def test_a_geojson_line_that_crosses_itself_is_reported(store: SqliteStore, tmp_path: Path) -> None:
    line = {"type": "LineString", "coordinates": ZIGZAG}
    file = write(
        tmp_path, "odd.geojson", geojson({"type": "Feature", "geometry": line, "properties": {"kind": "stop_line"}})
    )
    assert "crosses itself" in put(store, file).notes[0]
    with pytest.raises(errors.BadGeometry, match="crosses itself"):
        put(store, file, ImportOptions(strict=True))


@pytest.mark.parametrize(("body", "kind", "told"), GEOJSON, ids=[told for _, _, told in GEOJSON])
def test_a_geojson_file_with_a_fault_is_refused_whole(
    body: str, kind: type[Exception], told: str, store: SqliteStore, tmp_path: Path
) -> None:
    with pytest.raises(kind) as caught:
        put(store, write(tmp_path, "bad.geojson", body))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
    assert store.layers() == []


def test_a_georeference_needs_local_coordinates_and_a_place_near_them(tmp_path: Path) -> None:
    options = ImportOptions(placement=Placement.anchored(0.8, 0.2))
    with pytest.raises(errors.NeedsGeoreference, match="8 of 8 nodes have no local_x and local_y, first node 1"):
        read_features(write(tmp_path, "a.osm", STREET), "a", options)
    far = osm('<node id="1" lat="0" lon="0"><tag k="local_x" v="9e6"/><tag k="local_y" v="0"/></node>')
    with pytest.raises(errors.BadGeometry, match="lies 9000 km from the georeference, the limit is 50 km"):
        read_features(write(tmp_path, "b.osm", far), "b", options)


def test_options_that_cannot_be_are_refused() -> None:
    for wrong, told in (
        ({"other": "ndt_signs"}, "holds Gaussians"),
        ({"layers": {"pole": "no spaces"}}, "does not match"),
        ({"sigma_m": 0.0}, "sigmas are in 0 … 100 m"),
        ({"height_offset_m": 2e4}, "beyond 10000 m"),
        ({"exist": 1.5}, "0 … 1"),
    ):
        with pytest.raises(GndError, match=told):
            ImportOptions(**wrong)  # type: ignore[arg-type]


def test_a_name_that_tells_no_format_is_refused() -> None:
    assert format_of(Path("a.OSM")) == "lanelet2"
    assert format_of(Path("log_map_archive_x____PIT_city_1.json")) == "argoverse2"
    assert format_of(Path("a.json"), "geojson") == "geojson"
    with pytest.raises(errors.UnknownFormat, match=r"a\.json: its name tells no format"):
        format_of(Path("a.json"))
