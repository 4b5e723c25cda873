"""Small OpenDRIVE roads, written by hand, whose lanes, signals and objects lie where geometry says."""

import sys

import numpy as np
import pyproj
import pytest

from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io import errors
from gnd.tile_store.feature_io.opendrive_import import read_opendrive
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions

PROJ = "+proj=tmerc +lat_0=48 +lon_0=11 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
HEADER = f'<header revMajor="1" revMinor="7"><geoReference><![CDATA[{PROJ}]]></geoReference></header>'
LINE = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
ARC = '<geometry s="0" x="10" y="20" hdg="0" length="78.53981633974483"><arc curvature="0.02"/></geometry>'
SPIRAL = '<geometry s="0" x="0" y="0" hdg="0" length="100"><spiral curvStart="0" curvEnd="0.02"/></geometry>'
WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
CENTRE = '<center><lane id="0"><roadMark sOffset="0" type="broken" color="white"/></lane></center>'
SECTION = (
    f'<laneSection s="0"><left><lane id="1" type="driving">{WIDTH}</lane></left>{CENTRE}'
    f'<right><lane id="-1" type="driving">{WIDTH}</lane><lane id="-2" type="shoulder">'
    '<width sOffset="0" a="1" b="0.01" c="0" d="0"/></lane></right></laneSection>'
)
FRAME = LocalFrame(np.radians(48.0), np.radians(11.0), 0.0)


def road(inside: str, plan: str = LINE, lanes: str = SECTION, length: float = 100.0, id_: str = "1") -> str:
    return (
        f'<road id="{id_}" length="{length}" junction="-1"><planView>{plan}</planView>'
        f"<lanes>{lanes}</lanes>{inside}</road>"
    )


def xodr(*roads: str, header: str = HEADER) -> bytes:
    return f'<?xml version="1.0"?><OpenDRIVE>{header}{"".join(roads)}</OpenDRIVE>'.encode()


def read(data: bytes, **options: object) -> FeatureFile:
    return read_opendrive(data, "r.xodr", "r", ImportOptions(**options))  # type: ignore[arg-type]


def in_file(found: FeatureFile, kind: str, **attributes: str) -> np.ndarray:
    """(N, 3) vertices of the one feature of a kind with these attributes, in the file's own coordinates, by pyproj."""
    (one,) = (f for f in found.features if f.kind == kind and attributes.items() <= dict(f.attributes).items())
    back = pyproj.Transformer.from_crs(4326, PROJ, always_xy=True)
    x, y = back.transform(np.degrees(one.lon_rad), np.degrees(one.lat_rad))
    return np.column_stack([x, y, one.height_m])


def test_lanes_of_a_straight_road() -> None:
    found = read(xodr(road('<elevationProfile><elevation s="0" a="5" b="0.1" c="0" d="0"/></elevationProfile>')))
    assert found.layers == {"lanes": 4}
    np.testing.assert_allclose(in_file(found, "lane_boundary", lane="1"), [[0, 3.5, 5], [100, 3.5, 15]], atol=1e-6)
    np.testing.assert_allclose(in_file(found, "lane_boundary", lane="0"), [[0, 0, 5], [100, 0, 15]], atol=1e-6)
    shoulder = in_file(found, "lane_boundary", lane="-2")
    np.testing.assert_allclose(shoulder, [[0, -4.5, 5], [100, -5.5, 15]], atol=1e-6)
    middle = next(one for one in found.features if dict(one.attributes)["lane"] == "0")
    told = {"color": "white", "lane": "0", "lane_type": "none", "mark": "broken", "road": "1", "section": "0"}
    assert dict(middle.attributes) == told


def test_lanes_of_an_arc_lie_on_circles() -> None:
    found = read(xodr(road("", ARC, length=78.53981633974483)))
    for lane, radius in (("1", 46.5), ("0", 50.0), ("-1", 53.5)):
        border = in_file(found, "lane_boundary", lane=lane)
        np.testing.assert_allclose(np.hypot(border[:, 0] - 10, border[:, 1] - 70), radius, atol=1e-6)
        np.testing.assert_allclose(border[-1, :2], [10 + radius, 70], atol=1e-6)
        chord_m = np.linalg.norm(np.diff(border, axis=0), axis=1)
        assert chord_m.max() ** 2 / (8 * radius) < 0.006  # 5 mm from any sample, which lie half a metre apart


def test_the_end_of_a_clothoid_is_fresnels() -> None:
    end = in_file(read(xodr(road("", SPIRAL))), "lane_boundary", lane="0")[-1]
    np.testing.assert_allclose(end[:2], [90.452423790, 31.026830172], atol=1e-6)  # sqrt(π L / κ) · C, S of L² κ / 2 L
    assert (end[0], end[1]) != (100.0, 0.0)


def test_lane_offset_borders_and_sections() -> None:
    lanes = (
        '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="50" a="1" b="0" c="0" d="0"/>'
        f'<laneSection s="0">{CENTRE}<right><lane id="-1">{WIDTH}</lane></right></laneSection>'
        f'<laneSection s="60">{CENTRE}<right><lane id="-1"><border sOffset="0" a="-4" b="0" c="0" d="0"/></lane>'
        "</right></laneSection>"
    )
    found = read(xodr(road("", lanes=lanes)))
    first = in_file(found, "lane_boundary", lane="-1", section="0")
    assert first[[0, -1]][:, 1] == pytest.approx([-3.5, -2.5], abs=1e-6)
    assert first[-1, 0] == pytest.approx(60.0, abs=1e-6)
    second = in_file(found, "lane_boundary", lane="-1", section="1")
    np.testing.assert_allclose(second[:, 1], -3.0, atol=1e-6)  # the border is told from the offset line


def test_a_road_that_leans_lowers_its_right_side() -> None:
    lean = '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    border = in_file(read(xodr(road(lean))), "lane_boundary", lane="-1")
    np.testing.assert_allclose(border[0], [0, -3.5 * np.cos(0.1), -3.5 * np.sin(0.1)], atol=1e-6)


SIGNALS = """<signals>
<signal id="a" s="20" t="-4" zOffset="2.5" dynamic="no" type="274" subtype="50" country="DE" orientation="+"/>
<signal id="b" s="30" t="4" dynamic="yes" type="1000001" subtype="-1"/>
<signal id="c" s="30" t="4" dynamic="no" type="206"><positionInertial x="7" y="8" z="9" hdg="0"/></signal>
<signal id="d" s="30" t="4" dynamic="no" type="205"><positionRoad roadId="2" s="10" t="1" zOffset="1"/></signal>
</signals>"""
OBJECTS = """<objects>
<object id="a" type="pole" name="post" s="5" t="-5" zOffset="0.5"/>
<object id="b" type="streetLamp" s="0" t="6"><repeat s="10" length="80" distance="20" tStart="6" tEnd="8"/></object>
<object id="c" type="pole" subtype="streetLamp" s="50" t="9"/>
<object id="d" type="trafficIsland" s="60" t="0"/>
</objects>"""
SECOND = road("", LINE.replace('y="0"', 'y="50"'), id_="2")


def test_signals_and_objects_stand_where_they_say() -> None:
    found = read(xodr(road(SIGNALS + OBJECTS), SECOND))
    assert found.layers == {"lanes": 8, "poles": 1, "signs": 4, "streetlights": 6}
    assert found.left_out == {"traffic_island": 1}
    np.testing.assert_allclose(in_file(found, "traffic_sign", type="274"), [[20, -4, 2.5]], atol=1e-6)
    np.testing.assert_allclose(in_file(found, "traffic_light"), [[30, 4, 0]], atol=1e-6)
    np.testing.assert_allclose(in_file(found, "traffic_sign", type="206"), [[7, 8, 9]], atol=1e-6)
    np.testing.assert_allclose(in_file(found, "traffic_sign", type="205"), [[10, 51, 1]], atol=1e-6)
    np.testing.assert_allclose(in_file(found, "pole"), [[5, -5, 0.5]], atol=1e-6)
    lamps = [one.enu_m(FRAME)[0, :2] for one in found.features if one.kind == "streetlight"][:5]
    np.testing.assert_allclose(lamps, [[10, 6], [30, 6.5], [50, 7], [70, 7.5], [90, 8]], atol=0.01)
    sign = next(one for one in found.features if dict(one.attributes).get("type") == "274")
    assert dict(sign.attributes) == {
        "country": "DE", "dynamic": "no", "orientation": "+", "road": "1", "subtype": "50", "type": "274"
    }  # fmt: skip


def test_the_header_may_shift_and_turn_the_map() -> None:
    header = HEADER.replace("</header>", '<offset x="1000" y="2000" z="30" hdg="1.5707963267948966"/></header>')
    border = in_file(read(xodr(road(""), header=header)), "lane_boundary", lane="0")
    np.testing.assert_allclose(border, [[1000, 2000, 30], [1000, 2100, 30]], atol=1e-6)


def test_a_map_without_georeference_needs_an_anchor() -> None:
    bare = xodr(road(""), header='<header revMajor="1" revMinor="4"/>')
    with pytest.raises(errors.NeedsGeoreference, match="its header has no geoReference; say --georeference LAT,LON"):
        read(bare)
    found = read(bare, placement=Placement.anchored(FRAME.lat_rad, FRAME.lon_rad, 100.0))
    end = next(f for f in found.features if dict(f.attributes)["lane"] == "0").enu_m(FRAME)[-1]
    np.testing.assert_allclose(end, [100.0, 0.0, 100.0], atol=1e-6)


def test_without_pyproj_the_file_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(errors.MissingLibrary, match=r"needs pyproj \(pip install 'gnd-fleet\[opendrive\]'\)"):
        read(xodr(road("")))
    assert read(xodr(road("")), placement=Placement.anchored(0.8, 0.2)).layers == {"lanes": 4}


SQUARE = '<geometry s="0" x="0" y="0" hdg="0" length="60"><arc curvature="0.5"/></geometry>'
BAD = [
    (b"<OpenDRIVE>", errors.NotWellFormed, "line 1"),
    (b"<!DOCTYPE x><OpenDRIVE/>", errors.UnsafeFile, "document type"),
    (b"<osm/>", errors.UnknownFormat, "root element <osm>"),
    (b"<OpenDRIVE/>", errors.BadElement, "no <header>"),
    (xodr(header='<header revMajor="2" revMinor="0"/>'), errors.UnknownFormat, "OpenDRIVE '2'.0, known is"),
    (xodr(header=HEADER.replace(PROJ, "+proj=nonsense")), errors.BadElement, "geoReference '+proj=nonsense'"),
    (xodr(road("", plan="")), errors.BadElement, "road 1: has no geometry, so no position"),
    (xodr(road("", plan=LINE + LINE)), errors.BadElement, "its 2 geometries do not ascend in s"),
    (xodr(road("", plan=LINE.replace("<line/>", "<loop/>"))), errors.BadElement, "a geometry that is none of line"),
    (xodr(road("", plan=LINE.replace('x="0"', 'x="?"'))), errors.BadElement, "x of <geometry> is '?', no number"),
    (xodr(road("", plan=LINE.replace(' hdg="0"', ""))), errors.BadElement, "<geometry> without hdg"),
    (xodr(road("", length=2e6)), errors.BadElement, "length 2000000.0 m is not in 0 … 1000000 m"),
    (xodr(road("", lanes=SECTION.replace('id="-2"', 'id="-3"'))), errors.BadElement, "lanes [-1, -3] do not count"),
    (xodr(road("", lanes=SECTION.replace('id="-2"', 'id="-1"'))), errors.BadElement, "lane -1 comes twice"),
    (xodr(road("", lanes=SECTION + SECTION)), errors.BadElement, "its 2 lane sections do not ascend"),
    (xodr(road(""), road("")), errors.DuplicateId, "a road of this id comes twice"),
    (xodr(road(SIGNALS.replace('id="b"', 'id="a"')), SECOND), errors.DuplicateId, "signal a comes twice"),
    (xodr(road(SIGNALS)), errors.BadElement, "stands at road '2', which is not in the file"),
    (xodr(road(SIGNALS.replace('s="20"', 's="200"')), SECOND), errors.BadElement, "s 200.0 m is not on its road"),
    (xodr(road(OBJECTS.replace('distance="20"', 'distance="1e-9"'))), errors.FileTooLarge, "copies, the limit is"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "kind", "told"), BAD, ids=[told for _, _, told in BAD])
def test_a_file_with_a_fault_is_refused(data: bytes, kind: type[Exception], told: str) -> None:
    with pytest.raises(kind) as caught:
        read(data)
    assert told in str(caught.value)
    assert "r.xodr" in str(caught.value)


def test_a_road_that_crosses_itself_is_reported_and_strictly_refused() -> None:
    found = read(xodr(road("", plan=SQUARE, length=60.0)))
    assert found.layers == {"lanes": 4}
    assert "crosses itself" in found.notes[0]
    with pytest.raises(errors.BadGeometry, match="crosses itself"):
        read(xodr(road("", plan=SQUARE, length=60.0)), strict=True)
