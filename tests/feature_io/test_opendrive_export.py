"""OpenDRIVE back from a store: byte by byte, and with what has changed where it belongs."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import exported, put, write
from test_opendrive_import import ARC, HEADER, OBJECTS, SECOND, SIGNALS, SPIRAL, road, xodr

from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.formats import export_features
from gnd.tile_store.feature_io.geojson_export import write_geojson
from gnd.tile_store.feature_io.opendrive_export import write_opendrive
from gnd.tile_store.feature_io.opendrive_import import read_opendrive
from gnd.tile_store.feature_io.stored import load_features, sources_of
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature
from gnd.tile_store.feature_io.xml_spans import read_root
from gnd.tile_store.feature_io.xodr_road import road_of
from gnd.tile_store.sqlite_store import SqliteStore

MAPS = Path(__file__).parent / "maps"
STREET = xodr(road(SIGNALS + OBJECTS), SECOND)
FRAME = LocalFrame(np.radians(48.0), np.radians(11.0), 0.0)


def read(data: bytes) -> dict[tuple[str, ...], MapFeature]:
    """By what the file calls them."""
    found = read_opendrive(data, "r.xodr", "r", ImportOptions()).features
    return {tuple(one.name.split(": road ", 1)[1].replace(",", "").split()): one for one in found}


def rewritten(features: list[MapFeature]) -> tuple[bytes, dict[str, int]]:
    data, changes = write_opendrive(features, STREET, "r", ImportOptions())
    counts = {name: getattr(changes, name) for name in ("moved", "retagged", "removed", "added", "unwritten")}
    return data, {name: count for name, count in counts.items() if count}


def moved(feature: MapFeature, east_m: float, north_m: float) -> MapFeature:
    step = np.array([east_m, north_m, 0.0])
    lat, lon, height = FRAME.geodetic_from_enu(feature.enu_m(FRAME) + step)
    return replace(feature, lat_rad=lat, lon_rad=lon, height_m=height)


def test_an_unchanged_road_network_comes_back_byte_by_byte(store: SqliteStore, tmp_path: Path) -> None:
    data = (MAPS / "town.xodr").read_bytes()
    put(store, write(tmp_path, "town.xodr", data))
    assert exported(store, tmp_path / "back.xodr") == data


@pytest.mark.parametrize("what", ["a", "c", "d"])
def test_a_sign_that_has_moved_stands_there(what: str) -> None:
    """One on its road, one by its position in the file, one on another road."""
    was = read(STREET)
    new = moved(was["1", "signal", what], 3.0, -0.5)
    data, counts = rewritten([*(one for one in was.values() if one.feature_id != new.feature_id), new])
    assert counts == {"moved": 1}
    back = read(data)
    off = back["1", "signal", what].enu_m(FRAME) - new.enu_m(FRAME)
    assert np.abs(off).max() < 1e-3
    assert all(
        np.array_equal(back[key].lat_rad, one.lat_rad) for key, one in was.items() if key[1:] != ("signal", what)
    )


def test_what_has_gone_is_taken_out_and_nothing_else() -> None:
    was = read(STREET)
    data, counts = rewritten([one for key, one in was.items() if key[1:] != ("object", "a")])
    assert counts == {"removed": 1}
    assert data == STREET.replace(b'<object id="a" type="pole" name="post" s="5" t="-5" zOffset="0.5"/>', b"")


def test_attributes_that_have_changed_are_written() -> None:
    was = read(STREET)
    sign = was["1", "signal", "a"]
    other = replace(sign, attributes=tuple(sorted((dict(sign.attributes) | {"subtype": "30"}).items())))
    data, counts = rewritten([*(one for one in was.values() if one is not sign), other])
    assert counts == {"retagged": 1}
    assert data == STREET.replace(b'subtype="50"', b'subtype="30"')


def test_an_attribute_that_has_gone_is_counted() -> None:
    was = read(STREET)
    sign = was["1", "signal", "a"]
    other = replace(sign, attributes=tuple(one for one in sign.attributes if one[0] != "subtype"))
    data, counts = rewritten([*(one for one in was.values() if one is not sign), other])
    assert counts == {"unwritten": 1}
    assert data == STREET


def test_what_the_format_cannot_say_is_counted() -> None:
    """A copy of a row of lamps that has gone, and a border that has moved: the road network is not the features'."""
    was = read(STREET)
    lamp, border = was["1", "object", "b", "0", "2"], was["1", "lane", "0", "1"]
    rest = [one for one in was.values() if one.feature_id not in (lamp.feature_id, border.feature_id)]
    data, counts = rewritten([*rest, moved(border, 0.0, 1.0)])
    assert counts == {"unwritten": 2}
    assert data == STREET


def test_new_features_stand_at_the_nearest_road() -> None:
    was = read(STREET)
    post, sign = was["1", "object", "a"], was["1", "signal", "a"]
    crosswalk = replace(
        post, feature_id=7, kind="crosswalk", layer="crosswalks",
        **dict(zip(("lat_rad", "lon_rad", "height_m"), FRAME.geodetic_from_enu(
            np.array([[40.0, 47, 0], [44, 47, 0], [44, 53, 0], [40, 53, 0], [40, 47, 0]])), strict=True)),
    )  # fmt: skip
    lamp = replace(moved(post, 20.0, 50.0), feature_id=5, kind="streetlight", layer="streetlights")
    light = replace(moved(sign, 8.0, 0.0), feature_id=6, kind="traffic_light")
    data, counts = rewritten([*was.values(), crosswalk, lamp, light])
    assert counts == {"added": 3}
    ET.fromstring(data)
    back = read(data)
    assert set(back) - set(was) == {("2", "object", "gnd7"), ("2", "object", "gnd5"), ("1", "signal", "gnd6")}
    for key, new in (
        (("2", "object", "gnd7"), crosswalk),
        (("2", "object", "gnd5"), lamp),
        (("1", "signal", "gnd6"), light),
    ):
        assert back[key].kind == new.kind
        assert np.abs(back[key].enu_m(FRAME) - new.enu_m(FRAME)).max() < 1e-3


LYING = """<objects>
<object id="1" type="crosswalk" s="20" t="0" hdg="0.3" length="3" width="7"/>
<object id="2" type="crosswalk" s="30" t="1"><outline><cornerLocal u="-2" v="-3"/><cornerLocal u="2" v="-3"/>
<cornerLocal u="2" v="3"/></outline></object>
<object id="3" type="crosswalk" s="40" t="0"><outlines><outline><cornerRoad s="40" t="-3"/><cornerRoad s="44" t="-3"/>
<cornerRoad s="44" t="3"/></outline></outlines></object>
<object id="4" type="roadMark" subtype="stopLine" s="50" t="-1.75" length="0.4" width="3.5"/>
</objects><signals><signal id="5" s="60" t="-2" type="294" width="3"/></signals>"""


def test_what_lies_on_a_bend_moves_without_turning() -> None:
    """Outlines in the object's own frame and on the road; a stop line that is a signal lies across its lanes only."""
    data = xodr(road(LYING, ARC, length=78.5398))
    was = read(data)
    lying = {key: one for key, one in was.items() if key[1] in ("object", "signal")}
    features = [moved(one, 2.0, 3.0) if key in lying else one for key, one in was.items()]
    back, changes = write_opendrive(features, data, "r", ImportOptions())
    assert (changes.moved, changes.unwritten, changes.removed, changes.added) == (4, 1, 0, 0)
    again = read(back)
    for key, one in lying.items():
        step = again[key].enu_m(FRAME) - one.enu_m(FRAME)
        expected = [2.0, 3.0] if key[1] == "object" else [0.0, 0.0]
        assert np.abs(step[:, :2] - expected).max() < 2e-3


def test_a_store_without_an_opendrive_file_has_no_road_network_to_write(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "s.osm", '<osm><node id="1" lat="48" lon="8"><tag k="type" v="pole"/></node></osm>'))
    assert len(load_features(store)) == 1
    with pytest.raises(FeatureFileError, match="no source is one, or a part was chosen"):
        export_features(store, tmp_path / "new.xodr")


LEAN = '<lateralProfile><superelevation s="0" a="0.05" b="0" c="0" d="0"/></lateralProfile>'
PLANS = {"arc": (ARC, 78.53), "clothoid": (SPIRAL, 100.0)}


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(PLANS)), st.floats(0.01, 0.99), st.floats(-15.0, 15.0), st.floats(-2.0, 8.0), st.booleans()
)
def test_a_place_on_a_road_is_found_again(plan: str, share: float, t: float, up: float, lean: bool) -> None:
    shape, length = PLANS[plan]
    root = read_root(xodr(road(LEAN if lean else "", shape, length=length), header=HEADER), "r.xodr")
    one = road_of(root.all("road")[0], "r.xodr")
    point = one.points_m(np.array([share * length]), np.array([t]), up)[0]
    s_t_up = one.place_of(point)
    np.testing.assert_allclose(s_t_up, [share * length, t, up], atol=1e-5)


def test_lanes_follow_features_that_an_editor_has_moved_or_removed(store: SqliteStore, tmp_path: Path) -> None:
    """The town as GeoJSON with all of it moved by 1 m and a border taken out, imported under the town's name."""
    put(store, write(tmp_path, "town.xodr", (MAPS / "town.xodr").read_bytes()))
    gone = next(one for one in load_features(store, ["lanes"]) if dict(one.attributes).get("lane") == "0")
    features = [one for one in load_features(store) if one.feature_id != gone.feature_id]
    frame = LocalFrame(np.radians(37.77), np.radians(-122.42), 0.0)
    shifted = []
    for one in features:
        lat, lon, height = frame.geodetic_from_enu(one.enu_m(frame) + np.array([1.0, 0.0, 0.0]))
        shifted.append(replace(one, lat_rad=lat, lon_rad=lon, height_m=height))
    put(store, write(tmp_path, "edited.geojson", write_geojson(shifted)), source="town.xodr")
    lanes = sources_of(store)["town.xodr"].lanes
    used = [one for one in lanes if gone.feature_id in (one.left.feature_id, one.right.feature_id)]
    changes = export_features(store, tmp_path / "new.osm").changes
    assert changes is not None
    assert len(used) in (1, 2)
    assert (changes.lanelets, changes.unbounded) == (32 - len(used), len(used))
    assert changes.joined_m < 2e-3
    back = export_features(store, tmp_path / "back.xodr").changes
    assert back is not None
    things = sum(one.kind != "lane_boundary" for one in features)
    assert (back.moved, back.removed, back.added, back.unwritten) == (things, 0, 0, 58 - things)
    again = read_opendrive((tmp_path / "back.xodr").read_bytes(), "b", "town.xodr", ImportOptions()).features
    by_id = {one.feature_id: one for one in again}
    for one in shifted:
        if one.kind != "lane_boundary":
            assert np.abs(by_id[one.feature_id].enu_m(frame) - one.enu_m(frame))[:, :2].max() < 2e-3
