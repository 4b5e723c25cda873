"""A Lanelet2 map comes back from a store as it was; what changed in the store has changed in it, and nothing else."""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_maps import STREET, STREET_IDS, exported, put, write

from gnd.gnd_map.features import FeatureTile, feature_id_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.about import about_options, options_about
from gnd.tile_store.feature_io.formats import export_features, read_features
from gnd.tile_store.feature_io.lanelet2_export import write_lanelet2
from gnd.tile_store.feature_io.lanelet2_import import read_lanelet2
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.stored import layer_tiles, load_features, sources_of
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature
from gnd.tile_store.sqlite_store import SqliteStore

SOURCE = "street.osm"
MM = 1e-3


@pytest.fixture
def street(tmp_path: Path, store: SqliteStore) -> SqliteStore:
    put(store, write(tmp_path, SOURCE, STREET))
    return store


def feature(store: SqliteStore, what: str, id_: int) -> MapFeature:
    wanted = feature_id_of("lanelet2", SOURCE, what, id_)
    return next(one for one in load_features(store) if one.feature_id == wanted)


def change(store: SqliteStore, layer: str, edit: "callable") -> None:  # type: ignore[valid-type]
    """Publish a layer whose tiles `edit` has changed: tuple of features → tuple of features."""
    tiles = [FeatureTile.of(tile.tile_id, 1, edit(tile.features)) for tile in layer_tiles(store, layer)]
    store.put_tiles(tiles, layer=layer)


def positions(data: bytes) -> dict[str, np.ndarray]:
    """Metres of each node about the first, by a reader that knows nothing of ours."""
    root = ET.fromstring(data)
    frame = LocalFrame(np.radians(49.0), np.radians(8.4), 0.0)
    nodes = {}
    for node in root.iter("node"):
        ele = node.find("tag[@k='ele']")
        height = 0.0 if ele is None else float(ele.attrib["v"])
        nodes[node.attrib["id"]] = frame.enu_from_geodetic(
            np.radians(float(node.attrib["lat"])), np.radians(float(node.attrib["lon"])), height
        ).reshape(3)
    return nodes


def tree_without_positions(data: bytes) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for element in ET.fromstring(data).iter():
        said = {k: v for k, v in element.attrib.items() if k not in ("lat", "lon")}
        if said.get("k") != "ele":
            rows.append((element.tag, *(f"{k}={v}" for k, v in said.items()), (element.text or "").strip()))
    return rows


def test_the_street_gives_its_features(street: SqliteStore) -> None:
    found = load_features(street)
    assert {layer: sum(one.layer == layer for one in found) for layer in street.layers()} == STREET_IDS
    border = feature(street, "way", 10)
    assert (border.kind, len(border)) == ("lane_boundary", 2)
    assert border.attributes == (("my:colour", "ü"), ("subtype", "dashed"), ("type", "line_thin"))
    sign = feature(street, "way", 12)
    assert (sign.kind, len(sign)) == ("traffic_sign", 1)
    assert np.degrees(sign.lat_rad[0]) == pytest.approx(49.000053, abs=1e-8)  # the middle of its edges
    assert sign.height_m[0] == pytest.approx(113.0, abs=MM)
    assert feature(street, "node", 7).attributes == (("height", '6 & "a half"'), ("type", "pole"))


def test_what_was_imported_comes_back_byte_by_byte(street: SqliteStore, tmp_path: Path) -> None:
    assert exported(street, tmp_path / "back.osm") == STREET


def test_written_anew_the_geometry_is_the_same_to_the_millimetre(street: SqliteStore) -> None:
    kept = sources_of(street)[SOURCE]
    options = options_about(kept.options)
    data, changes = write_lanelet2(load_features(street), kept.document, SOURCE, options, keep_within_m=-1.0)
    assert changes.moved == 7  # but not node -8, which draws no feature
    assert data != STREET
    assert tree_without_positions(data) == tree_without_positions(STREET)
    was, now = positions(STREET), positions(data)
    assert max(float(np.linalg.norm(was[id_] - now[id_])) for id_ in was) < MM
    assert was["-8"].tolist() == now["-8"].tolist()


def test_a_moved_sign_moves_its_edges_and_nothing_else(street: SqliteStore, tmp_path: Path) -> None:
    step = np.array([1.5, -2.0, 0.25])
    change(street, "signs", lambda found: [replace(one, points_m=one.points_m + step) for one in found])
    data = exported(street, tmp_path / "back.osm")
    was, now = positions(STREET), positions(data)
    for id_ in was:
        moved = now[id_] - was[id_]
        np.testing.assert_allclose(moved, step if id_ in ("5", "6") else 0.0, atol=2 * MM)
    unchanged = [line for line in STREET.splitlines() if b"id='5'" not in line and b"id='6'" not in line]
    assert [line for line in data.splitlines() if b"id='5'" not in line and b"id='6'" not in line] == unchanged


def test_other_attributes_become_other_tags(street: SqliteStore, tmp_path: Path) -> None:
    told = (("condition", 'bent & "dirty"'), ("subtype", "de274-55"), ("type", "traffic_sign"))
    change(street, "signs", lambda found: [replace(one, attributes=told) for one in found])
    data = exported(street, tmp_path / "back.osm")
    way = ET.fromstring(data).find("way[@id='12']")
    assert way is not None
    assert {tag.attrib["k"]: tag.attrib["v"] for tag in way.iter("tag")} == dict(told)
    assert data.replace(re.findall(rb"<way id='12'>.*?</way>", data, re.S)[0], b"") == STREET.replace(
        re.findall(rb"<way id='12'>.*?</way>", STREET, re.S)[0], b""
    )


def test_a_deleted_pole_is_gone_and_a_new_one_is_there(street: SqliteStore, tmp_path: Path) -> None:
    new_id = feature_id_of("seen by vehicles", 1)
    change(
        street,
        "poles",
        lambda found: [replace(one, feature_id=new_id, attributes=(("height", "4"),)) for one in found],
    )
    data = exported(street, tmp_path / "back.osm")
    root = ET.fromstring(data)
    assert root.find("node[@id='7']") is None
    new = root.find("node[@id='23']")  # one more than the highest id in the file
    assert new is not None
    tags = {tag.attrib["k"]: tag.attrib["v"] for tag in new.iter("tag")}
    assert tags == {"ele": "111.0000", "type": "pole", "height": "4"}
    again = read_lanelet2(data, "again", "again", ImportOptions())
    assert again.layers == STREET_IDS


def test_a_lanelet_without_a_border_goes_with_it(street: SqliteStore, tmp_path: Path) -> None:
    gone = feature(street, "way", 11).feature_id
    change(street, "lanes", lambda found: [one for one in found if one.feature_id != gone])
    root = ET.fromstring(exported(street, tmp_path / "back.osm"))
    ids = {element.attrib.get("id") for element in root}
    assert {"11", "20", "4"}.isdisjoint(ids)
    assert {"10", "12", "13", "21", "22", "3"} <= ids  # the hedge still uses node 3


def test_a_border_with_more_vertices_keeps_the_nodes_it_had(street: SqliteStore, tmp_path: Path) -> None:
    border = feature(street, "way", 11)
    columns = (border.lat_rad + np.array([0.0, 1e-9]), border.lon_rad, border.height_m)
    lat, lon, height = (np.insert(values, 1, values.mean()) for values in columns)
    bent = replace(border, lat_rad=lat, lon_rad=lon, height_m=height)
    found = [bent if one.feature_id == border.feature_id else one for one in load_features(street)]
    data, changes = write_lanelet2(found, STREET, SOURCE, ImportOptions())
    way = ET.fromstring(data).find("way[@id='11']")
    assert way is not None
    assert [nd.attrib["ref"] for nd in way.iter("nd")] == ["3", "23", "24"]  # the last one was moved by 6 mm
    assert changes.moved == 1


def test_features_of_other_files_stay_out_of_it(street: SqliteStore, tmp_path: Path) -> None:
    other = STREET.replace(b"49.0", b"49.1")
    put(street, write(tmp_path, "other.osm", other))
    assert exported(street, tmp_path / "a.osm", SOURCE) == STREET
    assert exported(street, tmp_path / "b.osm", "other.osm") == other


def local_places(data: bytes) -> dict[str, tuple[float, float]]:
    places = {}
    for node in ET.fromstring(data).iter("node"):
        told = {tag.attrib["k"]: tag.attrib["v"] for tag in node.iter("tag")}
        places[node.attrib["id"]] = float(told["local_x"]), float(told["local_y"])
    return places


def test_a_map_of_local_coordinates_comes_back_by_its_anchor(tmp_path: Path, store: SqliteStore) -> None:
    local = re.sub(
        rb"lat='49.000([0-9]*)' *lon='8.40([0-9]*)' *>",
        lambda m: (
            b"lat='0.1' lon='0.2'><tag k='local_x' v='%.4f'/><tag k='local_y' v='%.4f'/>"
            % (float(b"0.0" + m[2]) * 7e4, float(b"0.0" + m[1]) * 1e5)
        ),
        STREET.replace(b"<node id='-8' lat='49.00007' lon='8.4008' />", b"").replace(
            b'lat="49.00006" lon="8.4007">', b"lat='49.00006' lon='8.4007'>"
        ),
    )
    assert local.count(b"local_x") == 7
    options = ImportOptions(placement=Placement.anchored(*np.radians([48.0, 11.0]), 500.0, 0.3))
    put(store, write(tmp_path, SOURCE, local), options)
    assert exported(store, tmp_path / "back.osm") == local
    border = feature(store, "way", 10)
    assert np.degrees(border.lat_rad[0]) == pytest.approx(48.0, abs=1e-3)
    assert border.height_m[0] == pytest.approx(610.5, abs=0.01)
    kept = sources_of(store)[SOURCE]
    forced = write_lanelet2(load_features(store), kept.document, SOURCE, options_about(kept.options), keep_within_m=-1)[
        0
    ]
    was, now = local_places(local), local_places(forced)
    assert was.keys() == now.keys()
    assert max(abs(a - b) for key in was for a, b in zip(was[key], now[key], strict=True)) < MM


def test_a_new_file_holds_what_a_store_without_one_has(street: SqliteStore, tmp_path: Path) -> None:
    told = export_features(street, tmp_path / "new.osm", source="")
    assert (told.features, told.source) == (4, None)
    again = read_features(tmp_path / "new.osm", "again", ImportOptions())
    assert again.layers == STREET_IDS
    key = lambda one: (one.layer, *one.attributes)  # noqa: E731
    for a, b in zip(sorted(load_features(street), key=key), sorted(again.features, key=key), strict=True):
        assert a.attributes == tuple(pair for pair in b.attributes if pair[0] != "type" or pair in a.attributes)
        assert (
            np.linalg.norm(a.enu_m() - b.enu_m(LocalFrame(a.lat_rad[0], a.lon_rad[0], a.height_m[0])), axis=1).max()
            < MM
        )


def test_options_come_back_as_they_were_kept() -> None:
    options = ImportOptions({"pole": "posts"}, "rest", None, True, 12.5, 0.2, 0.3, 0.8)
    assert options_about(about_options(options)) == options


def test_what_an_editor_of_geojson_changes_goes_into_the_lanelet2_file(street: SqliteStore, tmp_path: Path) -> None:
    """As QGIS saves it: without the mark of the whole, attributes as text."""
    export_features(street, tmp_path / "edit.geojson")
    told = json.loads((tmp_path / "edit.geojson").read_text("utf-8"))
    del told["gnd"]
    told["features"] = [one for one in told["features"] if one["properties"]["kind"] != "traffic_sign"]
    for one in told["features"]:
        del one["id"]
        one["properties"]["attributes"] = json.dumps(one["properties"]["attributes"])
        if one["properties"]["kind"] == "pole":
            one["geometry"]["coordinates"][2] += 1.0
    result = put(street, write(tmp_path, "edit.geojson", json.dumps(told)), source=SOURCE)
    assert (result.removed, dict(result.features)) == (1, {"lanes": 2, "poles": 1})
    data = exported(street, tmp_path / "back.osm")
    assert b'<tag k="ele" v="112.0000"/>\n    <tag k="type" v="pole"/>' in data
    ids = {element.attrib.get("id") for element in ET.fromstring(data)}
    assert {"5", "6", "12"}.isdisjoint(ids)
    again = [line for line in STREET.splitlines() if not re.search(rb"id='(5|6|12|21)'", line)]
    left = [line for line in data.splitlines() if not re.search(rb"id='21'", line)]
    assert sum(a != b for a, b in zip(again, left, strict=True)) == 2  # the pole's position and its height
