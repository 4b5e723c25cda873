"""Lines across 180 degrees of longitude in a store, and nodes that have local coordinates only."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import exported, put, write

from gnd.gnd_map.features import cut_polyline
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io import errors
from gnd.tile_store.feature_io.lanelet2_export import write_lanelet2
from gnd.tile_store.feature_io.lanelet2_import import read_lanelet2
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.stored import load_features
from gnd.tile_store.feature_io.values import ImportOptions
from gnd.tile_store.sqlite_store import SqliteStore

OVER = """<osm version="0.6"><node id="1" lat="-16.8" lon="179.9995"/><node id="2" lat="-16.8" lon="-179.9995"/>
<way id="3"><nd ref="1"/><nd ref="2"/><tag k="type" v="stop_line"/></way></osm>"""
LOCAL = (Path(__file__).parent / "maps" / "hatched_road_marking.osm").read_bytes()


def test_a_line_across_180_degrees_goes_the_short_way(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "over.osm", OVER))
    (line,) = load_features(store)
    assert np.degrees(line.lon_rad) == pytest.approx([179.9995, -179.9995], abs=1e-8)
    assert len(store.heads("lanes")) in (4, 5)  # 107 m, tiles of 36.5 m
    assert exported(store, tmp_path / "back.osm") == OVER.encode()


@settings(max_examples=60, deadline=None)
@given(st.floats(-80.0, 80.0), st.lists(st.tuples(st.floats(-200, 200), st.floats(-200, 200)), min_size=2, max_size=6))
def test_a_line_has_the_same_length_on_180_degrees_as_elsewhere(lat: float, shape: list[tuple[float, float]]) -> None:
    points = np.column_stack([np.array(shape), np.zeros(len(shape))])
    lengths = []
    for lon in (0.3, np.pi):  # 0.3 rad lies within a tile, π on the border of two
        frame = LocalFrame(np.radians(lat), lon, 0.0)
        pieces = cut_polyline(*frame.geodetic_from_enu(points))
        lengths.append(sum(np.linalg.norm(np.diff(p[1], axis=0), axis=1).sum() for p in pieces))
    assert lengths[1] == pytest.approx(lengths[0], rel=1e-6, abs=1e-6)


def test_nodes_without_lat_and_lon_are_placed_by_their_local_coordinates() -> None:
    with pytest.raises(errors.NeedsGeoreference, match="35 of 35 nodes have local_x and local_y"):
        read_lanelet2(LOCAL, "h.osm", "h", ImportOptions())
    with pytest.raises(errors.NeedsGeoreference, match="35 of 35 nodes have no lat or lon, first node 42; say --geor"):
        read_lanelet2(LOCAL, "h.osm", "h", ImportOptions(trust_latlon=True))
    assert len(read_lanelet2(LOCAL, "h.osm", "h", _anchored()).lanes) == 3


def test_what_moves_there_keeps_its_lat_and_lon_empty() -> None:
    found = read_lanelet2(LOCAL, "h.osm", "h", _anchored()).features
    first = found[0]
    moved = replace(first, lat_rad=first.lat_rad + 1e-7)
    new = replace(first, feature_id=5, lat_rad=first.lat_rad - 1e-5)
    data, changes = write_lanelet2([moved, new, *found[1:]], LOCAL, "h", _anchored())
    assert (changes.moved, changes.added) == (5, 1)
    assert data.count(b'lat="" lon=""') == 35 + 5
    assert b"nan" not in data
    again = {one.feature_id: one for one in read_lanelet2(data, "h.osm", "h", _anchored()).features}
    assert np.abs(again[first.feature_id].lat_rad - moved.lat_rad).max() * 6.4e6 < 1e-3


def _anchored() -> ImportOptions:
    return ImportOptions(placement=Placement.anchored(np.radians(35.9), np.radians(139.9), 0.0))
