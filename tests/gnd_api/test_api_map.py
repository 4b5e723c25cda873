"""`gnd.Map`: a store read as numpy columns, by region and time, also where nothing can be written."""

import os
import shutil
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyproj
import pytest
from api_testing import EAST, FAR, HERE, Program, gaussian_tile, sign_tile

import gnd
from gnd.gnd_map.grid import VoxelGrid
from gnd.tile_store.sqlite_store import SqliteStore

SURVEY_NS = 1_767_225_600_000_000_000  # 2026-01-01
SECOND_NS = 1_000_000_000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Three versions of a tile, at 100, 200 and 300 s; another tile, one far away, and signs."""
    now_ns = 100 * SECOND_NS
    path = tmp_path / "map.sqlite"
    with SqliteStore(path, now_ns=lambda: now_ns) as store:
        store.put_tiles([gaussian_tile(HERE, 5, 9, 70), gaussian_tile(EAST, 3)], surveyed_ns=SURVEY_NS)
        store.put_tiles([sign_tile(HERE, 1, 2)], layer="signs")
        now_ns = 200 * SECOND_NS
        store.put_tiles([gaussian_tile(HERE, 5, 70, 71), gaussian_tile(FAR, 1)])
        now_ns = 300 * SECOND_NS
        store.put_tiles([gaussian_tile(HERE, 71)])
        store.put_tiles([sign_tile(HERE, 2, 3, 4)], layer="signs")
    return path


@pytest.fixture
def opened(path: Path) -> Iterator[gnd.Map]:
    with gnd.Map(path) as opened:
        yield opened


def test_layers_tiles_and_versions(opened: gnd.Map) -> None:
    assert opened.layers == ("ndt", "signs")
    assert opened.tile_ids() == [FAR, HERE, EAST]
    assert [tile.tile_id for tile in opened.tiles("13033/03021/**")] == [HERE, EAST]
    assert opened.tile(HERE).version == 3
    assert opened.tile(HERE.path, version=1).gaussians.voxel_id.tolist() == [5, 9, 70]
    assert opened.tile(HERE.morton, at=datetime(1970, 1, 1, 0, 3, 20, tzinfo=UTC)).version == 2
    assert opened.tile(HERE, at="1970-01-01T00:01:40Z").version == 1
    assert [tile.version for tile in opened.tiles(at=150 * SECOND_NS)] == [1, 1]
    assert [line.version for line in opened.history(HERE)] == [1, 2, 3]
    with pytest.raises(gnd.GndError, match=r"tile .*22102: there is no such version 9"):
        opened.tile(HERE, version=9)
    with pytest.raises(gnd.GndError, match="no such version then"):
        opened.tile(HERE, at=1)
    with pytest.raises(gnd.GndError, match="is not like 2026"):
        opened.tile(HERE, at="yesterday")


def test_gaussians_as_columns_lie_where_the_voxels_are(opened: gnd.Map) -> None:
    found = opened.gaussians("13033/**", at=150 * SECOND_NS)
    assert len(found) == 4
    assert found.tile.tolist() == [HERE.morton] * 3 + [EAST.morton]
    assert found.voxel_id.tolist() == [5, 9, 70, 3]
    assert found.frame == gnd.LocalFrame.of_tile(HERE)
    assert found.day.tolist() == [datetime(2026, 1, 1, tzinfo=UTC).date()] * 4
    assert found.version.tolist() == [1] * 4
    assert found.reports.tolist() == [0] * 4
    tile = opened.tile(HERE, version=1)
    assert isinstance(tile, gnd.Tile)
    assert np.array_equal(found.count[:3], tile.gaussians.count)
    assert np.array_equal(found.cells[:3], tile.gaussians.cells)
    inside = VoxelGrid.of(HERE).voxel_of(
        np.radians(found.lat_deg[:3]), np.radians(found.lon_deg[:3]), found.height_m[:3]
    )
    assert inside.tolist() == [5, 9, 70]
    again_m = found.frame.enu_from_geodetic(np.radians(found.lat_deg), np.radians(found.lon_deg), found.height_m)
    assert np.abs(again_m - found.mean_m).max() < 1e-6


def test_distances_are_those_of_another_projection(opened: gnd.Map) -> None:
    """UTM by PROJ knows nothing of our frames; its scale is within 4 parts in 10,000."""
    found = opened.gaussians("13033/**", at=150 * SECOND_NS)
    east_m, north_m = pyproj.Transformer.from_crs(4979, 32652, always_xy=True).transform(found.lon_deg, found.lat_deg)
    ours_m, theirs_m = np.hypot(*np.diff(found.mean_m[:, :2], axis=0).T), np.hypot(np.diff(east_m), np.diff(north_m))
    assert ours_m.max() > 20
    assert np.abs(ours_m - theirs_m).max() < 0.02


def test_covariances_turn_with_the_frame(opened: gnd.Map) -> None:
    """The same ellipsoids in two frames: a point one sigma out is the same point on the Earth."""
    away = gnd.LocalFrame.of_tile(FAR)
    own, turned = opened.gaussians(HERE), opened.gaussians(HERE, frame=away)
    assert turned.frame == away
    assert not np.allclose(own.cov_m2, turned.cov_m2, atol=1e-3)
    for mean_m, cov_m2, other_mean_m, other_cov_m2 in zip(
        own.mean_m, own.cov_m2, turned.mean_m, turned.cov_m2, strict=True
    ):
        values, axes = np.linalg.eigh(cov_m2)
        ends_m = mean_m + (np.sqrt(np.maximum(values, 0)) * axes).T
        moved_m = away.enu_from_ecef(own.frame.ecef_from_enu(ends_m)) - other_mean_m
        assert np.allclose(moved_m.T @ moved_m, other_cov_m2, atol=1e-6)


def test_a_region_without_tiles_has_no_rows(opened: gnd.Map) -> None:
    found = opened.gaussians("00000/**")
    assert (len(found), found.mean_m.shape, found.cov_m2.shape) == (0, (0, 3), (0, 3, 3))
    assert opened.features("00000/**") == []


def test_what_nobody_dated_has_no_day(opened: gnd.Map) -> None:
    assert np.isnat(opened.gaussians(FAR).day).all()


def test_features_and_where_they_are(opened: gnd.Map) -> None:
    placed = opened.features("13033/**")
    assert [one.feature.feature_id for one in placed] == [2, 3, 4]
    assert {one.version for one in placed} == {2}
    at_m = gnd.LocalFrame.of_tile(HERE).enu_from_geodetic(
        np.radians(placed[0].lat_deg), np.radians(placed[0].lon_deg), placed[0].height_m
    )
    assert np.abs(at_m - [[1.0, 2.0, 30.0]]).max() < 1e-6
    assert [one.feature.feature_id for one in opened.features(HERE, at=150 * SECOND_NS)] == [1, 2]
    with pytest.raises(gnd.GndError, match="holds Gaussians"):
        opened.features(HERE, layer="ndt")
    with pytest.raises(gnd.GndError, match="holds features"):
        opened.gaussians(HERE, layer="signs")


def test_differences_by_version_and_by_time(opened: gnd.Map) -> None:
    of_versions = opened.diff(1, 2, tile=HERE)
    assert (of_versions.new, of_versions.deleted, of_versions.modified, of_versions.same) == (1, 1, 0, 2)
    to_newest = opened.diff(2, tile=HERE)
    assert (to_newest.new, to_newest.deleted, to_newest.same) == (0, 2, 1)
    of_times = opened.diff("1970-01-01T00:02:00Z", region="13033/**")
    assert (of_times.new, of_times.deleted, of_times.same, of_times.tiles_same) == (1, 3, 1, 1)
    assert opened.diff(150 * SECOND_NS, region=EAST).tiles == ()
    lat_rad, lon_rad = EAST.centre_rad
    near = gnd.Region.circle(float(np.degrees(lat_rad)), float(np.degrees(lon_rad)), 5.0)
    assert near.tiles == {EAST}
    assert opened.diff(150 * SECOND_NS, region=near).deleted == 0
    assert opened.diff(1, 2, tile=HERE, layer="signs").new == 2
    with pytest.raises(gnd.GndError, match="no version 9"):
        opened.diff(1, 9, tile=HERE)
    with pytest.raises(gnd.GndError, match="is no version of a tile"):
        opened.diff("2026-01-01", tile=HERE)


READS = """
import os, sys
import gnd
from gnd.tile_store.warm import warm_up
warm_up(); gnd.Map  # all modules, while the interpreter may be read
if os.getuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)
assert not os.access(os.path.dirname(sys.argv[1]), os.W_OK)
with gnd.Map(sys.argv[1]) as opened:
    print(opened.layers, len(opened.gaussians("13033/**")), opened.diff(1, 2, tile="13033/03021/23031/22102").new)
"""


def test_a_folder_that_is_read_only(path: Path, tmp_path: Path, start: Callable[..., Program]) -> None:
    """As a user who may not write there: to the one who runs the tests a container may allow everything."""
    folder = tmp_path / "kept"
    folder.mkdir()
    copy = Path(shutil.copy(path, folder))
    copy.chmod(0o444)
    folder.chmod(0o555)
    for parent in (tmp_path, *tmp_path.parents):
        if parent.stat().st_uid == os.getuid() and parent.name.startswith(("pytest-", "popen-", tmp_path.name)):
            parent.chmod(parent.stat().st_mode | 0o055)
    try:
        program = start("-c", READS, str(copy))
        assert program.end() == 0, program.lines
        assert program.lines == ["('ndt', 'signs') 2 1"]
        assert [one.name for one in folder.iterdir()] == [copy.name]
    finally:
        folder.chmod(0o755)


def test_nothing_is_written_beside_a_map(path: Path) -> None:
    before = path.read_bytes()
    with gnd.Map(path) as opened:
        opened.gaussians()
        with pytest.raises(gnd.GndError):
            opened.store.put_tiles([gaussian_tile(HERE, 1)])
    assert path.read_bytes() == before


def test_a_map_that_a_fleet_writes_to_is_read_as_it_grows(path: Path) -> None:
    with SqliteStore(path) as store, gnd.Map(path) as opened:
        assert opened.tile(EAST).version == 1
        store.put_tiles([gaussian_tile(EAST, 4)])
        assert opened.tile(EAST).version == 2


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(gnd.GndError, match="no such store"):
        gnd.Map(tmp_path / "nothing.sqlite")
    (tmp_path / "text").write_text("not a map, but long enough to be looked at" * 40)
    with pytest.raises(gnd.GndError, match="not a tile store"):
        gnd.Map(tmp_path / "text")
