"""GeoJSON by the letter of RFC 7946, and back again to less than a millimetre."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import STREET, put, write

from gnd.gnd_map.features import Existence
from gnd.tile_store.feature_io.formats import export_features, read_features
from gnd.tile_store.feature_io.geojson_export import write_geojson
from gnd.tile_store.feature_io.geojson_import import read_geojson
from gnd.tile_store.feature_io.stored import import_features, load_features
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature
from gnd.tile_store.sqlite_store import SqliteStore

GEOD = pyproj.Geod(ellps="WGS84")


def check_rfc7946(told: Any) -> None:
    """The MUSTs of RFC 7946 for a FeatureCollection of points and lines."""
    assert told["type"] == "FeatureCollection"
    assert "crs" not in told  # section 4: it is gone
    assert not {"coordinates", "geometries", "geometry", "properties"} & told.keys()  # section 7.1
    assert isinstance(told["features"], list)
    for feature in told["features"]:
        assert feature["type"] == "Feature"
        assert isinstance(feature["properties"], dict)
        assert isinstance(feature.get("id", ""), (str, int, float))  # section 3.2
        assert not {"coordinates", "geometries", "features"} & feature.keys()
        check_geometry(feature["geometry"])


def check_geometry(geometry: Any) -> None:
    assert set(geometry) == {"type", "coordinates"}
    positions = {"Point": [geometry["coordinates"]], "LineString": geometry["coordinates"]}[geometry["type"]]
    assert geometry["type"] == "Point" or len(positions) >= 2  # section 3.1.4
    for position in positions:
        assert 2 <= len(position) <= 3  # section 3.1.1
        assert all(isinstance(value, float) for value in position)
        lon, lat = position[:2]
        assert -180 <= lon <= 180
        assert -90 <= lat <= 90


def test_an_export_is_geojson_by_the_letter(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "street.osm", STREET))
    export_features(store, tmp_path / "out.geojson")
    told = json.loads((tmp_path / "out.geojson").read_text("utf-8"))
    check_rfc7946(told)
    assert [one["geometry"]["type"] for one in told["features"]] == ["LineString", "LineString", "Point", "Point"]
    sign = told["features"][-1]
    np.testing.assert_allclose(sign["geometry"]["coordinates"], [8.4005, 49.000053, 113.0], atol=2e-8)
    assert sign["properties"]["attributes"] == {"subtype": "de274", "type": "traffic_sign"}
    assert (sign["properties"]["layer"], sign["properties"]["state"]) == ("signs", "exist")
    assert len(sign["properties"]["cov_m2"]) == 6


def test_an_imported_export_is_the_same_store(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "street.osm", STREET))
    export_features(store, tmp_path / "out.geojson")
    with SqliteStore(tmp_path / "other.sqlite") as other:
        put(other, tmp_path / "out.geojson")
        assert other.layers() == store.layers()
        for layer in store.layers():
            assert [(e.tile, e.sha) for e in other.heads(layer)] == [(e.tile, e.sha) for e in store.heads(layer)]


places = st.lists(st.tuples(st.floats(-3e-5, 3e-5), st.floats(-3e-5, 3e-5), st.floats(-50, 50)), min_size=1, max_size=1)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-89.0, 89.0), st.floats(-179.9, 179.9), places, st.floats(0, 1), st.integers(1, 2**63 - 1),
    st.dictionaries(st.text(min_size=1, max_size=20), st.text(max_size=20), max_size=3),
)  # fmt: skip
def test_a_feature_survives_the_text(
    lat: float, lon: float, place: list[tuple[float, float, float]], exist: float, id_: int, told: dict[str, str]
) -> None:
    d = np.array(place)
    feature = MapFeature(
        id_, "pole", "poles", np.radians(lat + d[:, 0]), np.radians(lon + d[:, 1]), d[:, 2],
        np.array([0.01, 0.001, 0.0, 0.02, 0.0, 1e4]), Existence(exist, 0.0, 1.0 - exist, 0.25),
        tuple(sorted(told.items())), hits=3, vehicles=2,
    )  # fmt: skip
    (again,) = read_geojson(write_geojson([feature]), "x", "x", ImportOptions()).features
    _, _, apart_m = GEOD.inv(*np.degrees([feature.lon_rad, feature.lat_rad, again.lon_rad, again.lat_rad]))
    assert np.max(apart_m) < 1e-3
    assert np.abs(again.height_m - feature.height_m).max() < 1e-3
    assert (again.feature_id, again.kind, again.layer, again.attributes) == (id_, "pole", "poles", feature.attributes)
    assert (again.existence, again.hits, again.vehicles) == (feature.existence, 3, 2)
    assert again.cov_m2.tolist() == feature.cov_m2.tolist()


RING = [[8.4, 49], [8.4001, 49], [8.4, 49.0001], [8.4, 49]]
OTHERS = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature", "id": 7, "geometry": {"type": "Point", "coordinates": [8.4, 49.0]},
            "properties": {"kind": "streetlight", "lumen": 4000, "lit": None, "on": True},
        },
        {
            "type": "Feature", "geometry": {"type": "Polygon", "coordinates": [RING]},
            "properties": {"type": "crosswalk", "layer": "zebras"},
        },
        {
            "type": "Feature", "geometry": {"type": "MultiPoint", "coordinates": [[8.4, 49.1, 5.0], [8.5, 49.1, 5.0]]},
            "properties": {"kind": "pole"},
        },
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [8.4, 49.0]}, "properties": None},
    ],
}  # fmt: skip


def test_files_of_others_are_understood_as_well_as_they_can(tmp_path: Path) -> None:
    read = read_features(write(tmp_path, "x.geojson", json.dumps(OTHERS)), "x", ImportOptions())
    assert read.layers == {"poles": 2, "streetlights": 1, "zebras": 1}
    assert read.left_out == {"unknown": 1}
    lamp, zebra, pole, _ = read.features
    assert lamp.attributes == (("lumen", "4000"), ("on", "true"))
    assert lamp.cov_m2[5] == 1e4  # no height is given
    assert pole.cov_m2[5] == pytest.approx(0.01)
    assert len(zebra) == 4
    assert len({one.feature_id for one in read.features}) == 4
    named = read_features(tmp_path / "x.geojson", "x", ImportOptions({"streetlight": "lamps"}, "rest"))
    assert named.layers == {"lamps": 1, "poles": 2, "rest": 1, "zebras": 1}


def test_equal_bytes_are_unchanged_tiles(store: SqliteStore, tmp_path: Path) -> None:
    file = read_features(write(tmp_path, "x.geojson", json.dumps(OTHERS)), "x", ImportOptions())
    first = import_features(store, file, "x")
    again = import_features(store, file, "x")
    assert (first.unchanged, again.tiles, again.unchanged) == (0, 0, first.tiles)
    assert len(load_features(store)) == 4
