"""Exports are read by other readers; differences and totals are those that were put in."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from store_helpers import EAST, FAR, TILE, Clock, SqliteMaker, tile_of_voxels

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.compare import map_diff, map_info, version_diff
from gnd.tile_store.errors import StoreError, UnknownVersion
from gnd.tile_store.export import ExportError, export_map, points_of, region_frame, region_tiles
from gnd.tile_store.store import Store


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock):
    opened = SqliteMaker(tmp_path / "map.sqlite").open(clock=clock)
    opened.put_tiles([tile_of_voxels(TILE, -604, 0, 36_000), tile_of_voxels(EAST, 5, 6)])
    yield opened
    opened.close()


def read_pcd(path: Path) -> tuple[dict[str, str], np.ndarray]:
    """Header and points of a PCD file by the letter of its own header."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    lines = [line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#")]
    header: dict[str, str] = dict(lines)  # type: ignore[arg-type]
    kinds = {"F": "f", "U": "u", "I": "i"}
    types = [
        (name, f"<{kinds[kind]}{size}")
        for name, kind, size in zip(*(header[key].split() for key in ("FIELDS", "TYPE", "SIZE")), strict=True)
    ]
    return header, np.frombuffer(body, types)


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    """Header lines and vertices of a binary PLY file by the letter of its own header."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    kinds = {"float": "<f4", "uint": "<u4", "int": "<i4"}
    types = [(name, kinds[kind]) for _, kind, name in (line.split() for line in lines if line.startswith("property"))]
    return lines, np.frombuffer(body, types)


def test_a_pcd_file_says_what_it_holds(store: Store, tmp_path: Path) -> None:
    result = export_map(store, "ndt", "", tmp_path / "map.pcd")
    header, points = read_pcd(result.path)
    assert (result.tiles, result.gaussians, result.size_bytes) == (2, 5, result.path.stat().st_size)
    assert (header["POINTS"], header["WIDTH"], header["HEIGHT"], header["VERSION"]) == ("5", "5", "1", "0.7")
    assert points["voxel_id"].tolist() == [-604, 0, 36_000, 5, 6]
    assert (points["count"].tolist(), points["cells"].tolist()) == ([100] * 5, [25] * 5)
    morton = points["tile_high"].astype(np.int64) * 2**32 + points["tile_low"]
    assert morton.tolist() == [TILE.morton] * 3 + [EAST.morton] * 2
    assert (
        "ENU frame at latitude 37.560024261 deg, longitude 127.036628723 deg"
        in result.path.read_text(errors="replace").splitlines()[1]
    )


def test_a_ply_file_holds_the_same_points(store: Store, tmp_path: Path) -> None:
    _, expected = read_pcd(export_map(store, "ndt", "", tmp_path / "map.pcd").path)
    path = export_map(store, "ndt", "", tmp_path / "map.ply").path
    lines, points = read_ply(path)
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 5" in lines
    assert np.array_equal(points, expected)


def test_points_lie_where_geodesy_says(store: Store) -> None:
    tiles = region_tiles(store, "ndt", "")
    frame = region_frame(tiles)
    lat_deg, lon_deg = np.degrees([frame.lat_rad, frame.lon_rad])
    to_enu = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={lat_deg} +lon_0={lon_deg} +h_0=0"
    )
    for tile in tiles:
        bare = Gaussians(*tile.gaussians.columns[:3], np.zeros_like(tile.gaussians.mean_m), tile.gaussians.cov_m2)
        points = points_of(Tile(tile.tile_id, 1, bare), frame)
        lat, lon, height = VoxelGrid.of(tile.tile_id).centre_geodetic(tile.gaussians.voxel_id)
        expected = np.stack(to_enu.transform(np.degrees(lon), np.degrees(lat), height), axis=1)
        np.testing.assert_allclose(np.stack([points[n] for n in "xyz"], axis=1), expected, atol=1e-5)


def test_a_map_across_180_degrees_has_its_frame_in_its_middle() -> None:
    places = [TileId.from_geodetic(np.radians(-16.8), np.radians(lon_deg)) for lon_deg in (179.999, -179.999)]
    for order in (places, places[::-1]):
        tiles = [tile_of_voxels(place, 0) for place in order]
        frame = region_frame(tiles)
        assert abs(abs(np.degrees(frame.lon_rad)) - 180.0) < 0.01
        assert np.abs(np.concatenate([points_of(tile, frame)["x"] for tile in tiles])).max() < 1000.0


def test_means_and_covariances_turn_with_the_frame() -> None:
    rng = np.random.default_rng(1)
    spread = rng.uniform(-0.3, 0.3, (3, 3))
    cov = spread @ spread.T
    six = cov[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)[None]
    one = np.ones(1, np.int32)
    mean = np.float32([[0.1, -0.2, 0.3]])
    tile = Tile(TILE, 1, Gaussians(np.zeros(1, np.int32), one * 50, one * 30, mean, six))
    far = LocalFrame(TILE.centre_rad[0] - 0.5, TILE.centre_rad[1] + 0.7)
    own, turned = points_of(tile, LocalFrame.of_tile(TILE)), points_of(tile, far)
    R = far.T_self_other(LocalFrame.of_tile(TILE))[:3, :3]
    names = ["cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"]
    np.testing.assert_allclose([own[n][0] for n in names], six[0], atol=1e-7)
    expected = (R @ cov @ R.T)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose([turned[n][0] for n in names], expected, atol=1e-7)
    assert not np.allclose(expected, six[0], atol=1e-3)
    centre = VoxelGrid.of(TILE).centre_m(np.zeros(1, np.int32))[0]
    np.testing.assert_allclose([own[n][0] for n in "xyz"], centre + mean[0], atol=1e-5)


def test_geojson_shows_the_tiles_as_polygons(store: Store, tmp_path: Path) -> None:
    collection = json.loads(export_map(store, "ndt", "", tmp_path / "map.geojson").path.read_text())
    first = collection["features"][0]
    properties = first["properties"]
    ring = np.array(first["geometry"]["coordinates"][0])
    assert (collection["type"], first["geometry"]["type"], len(collection["features"])) == (
        "FeatureCollection",
        "Polygon",
        2,
    )
    assert ring[0].tolist() == ring[4].tolist()
    assert ring[:, 0].min() == pytest.approx(127.036285, abs=1e-6)  # longitude first (RFC 7946)
    assert ring[:, 1].max() == pytest.approx(37.560196, abs=1e-6)
    area = 0.5 * np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
    assert area > 0  # counter-clockwise
    assert (properties["tile"], properties["morton"]) == (TILE.path, TILE.morton)
    assert (properties["gaussians"], properties["points"], properties["version"]) == (3, 300, 1)
    assert (properties["lowest_m"], properties["highest_m"]) == (0, 31)


def test_a_region_exports_only_its_tiles(store: Store, tmp_path: Path) -> None:
    store.put_tiles([tile_of_voxels(FAR, 9)])
    assert export_map(store, "ndt", "", tmp_path / "all.pcd").tiles == 3
    assert export_map(store, "ndt", "13033/03021", tmp_path / "near.pcd").tiles == 2
    assert export_map(store, "ndt", TILE.path, tmp_path / "one.pcd").tiles == 1


def test_the_format_may_be_named(store: Store, tmp_path: Path) -> None:
    assert export_map(store, "ndt", "", tmp_path / "map", "PLY").path.read_bytes().startswith(b"ply\n")


def test_what_cannot_be_exported_is_refused_and_nothing_is_left(store: Store, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="unknown export format 'las'; known are pcd, ply, geojson"):
        export_map(store, "ndt", "", tmp_path / "map.las")
    with pytest.raises(ExportError, match="no tiles in layer 'ndt', region '00000'"):
        export_map(store, "ndt", "00000", tmp_path / "map.pcd")
    with pytest.raises(ExportError, match="no tiles in layer 'signs', region 'everywhere'"):
        export_map(store, "signs", "", tmp_path / "map.pcd")
    with pytest.raises(ExportError, match=r"absent/map\.pcd: cannot write: No such file or directory"):
        export_map(store, "ndt", "", tmp_path / "absent" / "map.pcd")
    assert not [path for path in tmp_path.iterdir() if "map.pcd" in path.name]


def test_info_totals_a_region(store: Store, clock: Clock) -> None:
    clock.advance(60)
    store.put_tiles([tile_of_voxels(EAST, 5, 6, 7)])
    info = map_info(store)
    assert (info.tiles, info.districts, info.gaussians, info.points) == (2, 1, 6, 600)
    assert (info.lowest_version, info.highest_version, info.updated_ns) == (1, 2, clock())
    assert (info.lowest_m, info.highest_m) == (0, 31)
    assert info.body_bytes == sum(len(store.get("ndt", tile).body) for tile in (TILE, EAST))  # type: ignore[union-attr]
    assert (info.south_deg, info.west_deg) == pytest.approx((37.559853, 127.036285), abs=1e-6)
    assert (info.north_deg, info.east_deg) == pytest.approx((37.560196, 127.036972), abs=1e-6)
    assert json.loads(json.dumps(info.as_dict()))["tiles"] == 2
    assert map_info(store, prefix=TILE.path).tiles == 1
    with pytest.raises(StoreError, match="no tiles in layer 'signs'"):
        map_info(store, layer="signs")


def moved(tile: Tile, voxel_id: int, shift_m: float) -> Tile:
    mean_m = tile.gaussians.mean_m.copy()
    mean_m[tile.gaussians.voxel_id == voxel_id, 0] += np.float32(shift_m)
    columns: Any = tile.gaussians.columns
    return Tile(tile.tile_id, 0, Gaussians(*columns[:3], mean_m, columns[4]))


def test_the_difference_of_two_maps_is_what_was_changed(store: Store, tmp_path: Path) -> None:
    other = SqliteMaker(tmp_path / "other.sqlite").open(clock=Clock())
    other.put_tiles([moved(tile_of_voxels(TILE, -604, 7, 8, 36_000), -604, 0.25), tile_of_voxels(EAST, 5, 6)])
    other.put_tiles([tile_of_voxels(FAR, 1)])
    found = map_diff(store, other)
    other.close()
    assert (found.new, found.deleted, found.modified, found.same, found.tiles_same) == (3, 1, 1, 3, 1)
    far, near = sorted(found.tiles, key=lambda tile: tile.old_version)
    assert (near.tile, near.new, near.deleted, near.modified, near.same) == (TILE.path, 2, 1, 1, 1)
    assert near.max_shift_m == pytest.approx(0.25, abs=1e-6)
    assert (far.tile, far.old_version, far.new_version, far.new) == (FAR.path, 0, 1, 1)
    assert json.loads(json.dumps(found.as_dict()))["tiles"][0]["tile"] in (TILE.path, FAR.path)
    head, *rows = found.rows()
    assert head[:3] == ("tile", "old_version", "new_version")
    assert {len(row) for row in rows} == {len(head)}
    assert any(row[-1] == "0.250" for row in rows)


def test_a_map_does_not_differ_from_itself(store: Store) -> None:
    found = map_diff(store, store)
    assert (found.tiles, found.tiles_same, found.same) == ((), 2, 5)


def test_two_times_of_one_store_differ_by_what_came_between(store: Store, clock: Clock) -> None:
    before = clock()
    clock.advance(10)
    store.put_tiles([tile_of_voxels(EAST, 5), tile_of_voxels(FAR, 1, 2)])
    found = map_diff(store, store, old_at_ns=before)
    assert (found.new, found.deleted, found.modified, found.tiles_same) == (2, 1, 0, 1)
    assert map_diff(store, store, old_at_ns=before, new_at_ns=before).tiles == ()
    assert map_diff(store, store, old_at_ns=before, prefix="13033").new == 0


def test_two_versions_of_a_tile_differ_or_are_not_there(store: Store) -> None:
    store.put_tiles([tile_of_voxels(EAST, 5, 9, 10)])
    (found,) = version_diff(store, "ndt", EAST, 1, 2).tiles
    assert (found.new, found.deleted, found.old_version, found.new_version) == (2, 1, 1, 2)
    with pytest.raises(UnknownVersion, match=r"tile 13033/03021/23031/22103 of layer 'ndt' has no version 9"):
        version_diff(store, "ndt", EAST, 1, 9)
