"""Changes as objects: found where they were put, with who reported them, in files that a GIS opens."""

import json
import sqlite3
import time
from pathlib import Path

import numpy as np
import pyogrio
import pytest
from click.testing import CliRunner
from map_export_maps import TILE

from gnd.deploy.cli import gnd
from gnd.deploy.map_export.changes import Change, map_changes
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Publication, ReportRow

GRID = VoxelGrid.of(TILE)
DRIVEN_MS = 1_700_000_000_000
SD_M = {"ground": (0.29, 0.29, 0.02), "post": (0.05, 0.05, 0.29), "car": (0.2, 0.2, 0.29), "wall": (0.02, 0.29, 0.29)}


def voxels(what: str, columns: list[tuple[int, int, int]], shift_m: float = 0.0) -> Gaussians:
    ids = np.array([int(GRID.voxel_id(*column)) for column in columns], np.int32)
    n = len(ids)
    x, y, z = SD_M[what]
    six = np.tile(np.array([x * x, 0, 0, y * y, 0, z * z], np.float32), (n, 1))
    mean = np.full((n, 3), [shift_m, 0.0, 0.0], np.float32)
    return Gaussians(*(np.sort(ids), np.full(n, 50, np.int32), np.full(n, 20, np.int32)), mean, six)


def joined(*parts: Gaussians) -> Gaussians:
    order = np.argsort(np.concatenate([part.voxel_id for part in parts]))
    return Gaussians(*(np.concatenate(columns)[order] for columns in zip(*(p.columns for p in parts), strict=True)))


GROUND = voxels("ground", [(i, j, 115) for i in range(26) for j in range(10)])
POST = voxels("post", [(5, 5, z) for z in (116, 117, 118)])
CAR = voxels("car", [(i, j, 116) for i in range(15, 19) for j in (2, 3)])
WALL = voxels("wall", [(25, j, z) for j in range(6) for z in (116, 117)])
SPECK = voxels("car", [(0, 9, 125)])
BEFORE = joined(GROUND, POST, WALL)
AFTER = joined(GROUND, CAR, SPECK, voxels("wall", [(25, j, z) for j in range(6) for z in (116, 117)], 0.35))


@pytest.fixture
def two_maps(tmp_path: Path) -> tuple[Path, Path]:
    paths = tmp_path / "old.sqlite", tmp_path / "new.sqlite"
    for path, gaussians, day in zip(paths, (BEFORE, AFTER), (19_600, 19_700), strict=True):
        with SqliteStore(path) as store:
            store.put_tiles([Tile(TILE, 1, gaussians)], surveyed_ns=day * 86_400_000_000_000)
    return paths


@pytest.fixture
def healed(tmp_path: Path) -> Path:
    """A map that two vehicles changed: both saw the car, one that the post is gone."""
    path = tmp_path / "healed.sqlite"
    with SqliteStore(path) as store:
        store.put_tiles([Tile(TILE, 1, BEFORE)])
        ids = [deterministic_report_id(DRIVEN_MS + 1000 * n, "report", str(n)) for n in range(2)]
        base = store.get("ndt", TILE)
        assert base is not None
        rows = [
            ReportRow(one, "ndt", TILE, f"car-{n}", base.created_ns + 1, b"x", base.sha) for n, one in enumerate(ids)
        ]
        store.put_reports(rows)
        time.sleep(max(store.ready_in_s() or 0.0, 0.0) + 0.01)  # reports that come together are merged together
        (claim,) = store.claim("merger", 1, 60.0)
        by = {int(v): tuple(sorted(ids)) for v in CAR.voxel_id} | {int(v): (ids[1],) for v in POST.voxel_id}
        tile = Tile(TILE, 2, joined(GROUND, CAR, WALL))
        (result,) = store.publish([Publication(claim, 1, tile, report_ids=tuple(ids), voxel_reports=by)])
        assert result.status == "published"
    return path


def diff(*words: object) -> str:
    ran = CliRunner().invoke(gnd, ["map", "diff", *map(str, words)])
    assert ran.exit_code == 0, ran.output + repr(ran.exception)
    return ran.stdout


def by_kind(found: tuple[Change, ...]) -> dict[tuple[str, str], Change]:
    kinds = {(one.change, one.shape): one for one in found}
    assert len(kinds) == len(found)
    return kinds


def test_objects_are_found_where_and_as_large_as_they_are(two_maps: tuple[Path, Path]) -> None:
    with SqliteStore(two_maps[0]) as old, SqliteStore(two_maps[1]) as new:
        found = map_changes(old, new, layer="ndt")
    kinds = by_kind(found.changes)
    assert set(kinds) == {("new", "object"), ("deleted", "pole"), ("modified", "wall")}
    assert found.alone == 1  # the speck
    car, post, wall = kinds["new", "object"], kinds["deleted", "pole"], kinds["modified", "wall"]
    assert (car.voxels, post.voxels, wall.voxels) == (8, 3, 12)
    assert (car.points, post.tiles) == (400, (TILE.path,))
    # 4 x 2 voxels of 1 m: middles 3 and 1 m apart, and 0.2 * sqrt(3) m on both sides
    assert car.length_m == pytest.approx(3 * GRID.dx_m + 0.69, abs=0.02)
    assert car.width_m == pytest.approx(1 * GRID.dy_m + 0.69, abs=0.02)
    assert post.tall_m == pytest.approx(3.0, abs=0.02)
    assert post.height_m == pytest.approx(116.0, abs=0.02)
    assert car.bearing_deg == pytest.approx(90.0, abs=0.5)
    assert wall.bearing_deg % 180.0 == pytest.approx(0.0, abs=0.5)
    ids = GRID.voxel_id([15, 18], [2, 3], [116, 116])
    middle = LocalFrame.of_tile(TILE).geodetic_from_enu(GRID.centre_m(ids).mean(axis=0))
    assert np.abs(np.degrees(middle[:2]) - [car.lat_deg, car.lon_deg]).max() < 1e-7
    # two surveys: the time of the new one, nobody to count
    assert (car.vehicles, car.reports, car.confidence) == (None, 0, None)
    assert car.first_seen is not None
    assert car.first_seen.timestamp() == 19_700 * 86_400


def test_the_reports_say_when_and_how_many_vehicles(healed: Path) -> None:
    with SqliteStore(healed) as store:
        found = map_changes(store, store, layer="ndt", tile=TILE, versions=(1, 2))
    kinds = by_kind(found.changes)
    car, post = kinds["new", "object"], kinds["deleted", "pole"]
    assert (car.vehicles, car.reports, car.confidence) == (2, 2, 1.0)
    assert (post.vehicles, post.reports, post.confidence) == (1, 1, 0.0)
    for moment, after_s in ((car.first_seen, 0), (car.last_seen, 1), (post.first_seen, 1), (post.last_seen, 1)):
        assert moment is not None
        assert moment.timestamp() == DRIVEN_MS / 1000 + after_s


def test_equal_maps_have_no_changes_and_noise_is_none(two_maps: tuple[Path, Path], tmp_path: Path) -> None:
    """Another survey of the same place, its Gaussians a centimetre off."""
    with SqliteStore(two_maps[0]) as old, SqliteStore(tmp_path / "again.sqlite") as again:
        assert map_changes(old, old, layer="ndt").changes == ()
        mean = BEFORE.mean_m + np.random.default_rng(5).normal(0, 0.01, BEFORE.mean_m.shape).astype(np.float32)
        again.put_tiles([Tile(TILE, 1, Gaussians(*BEFORE.columns[:3], mean, BEFORE.cov_m2))])
        found = map_changes(old, again, layer="ndt")
    assert (found.changes, found.alone) == ((), 0)


def test_a_gis_opens_the_geopackage(two_maps: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "changes.gpkg"
    text = diff(*two_maps, "--to", out)
    assert "3 changes: 1 deleted pole, 1 modified wall, 1 new object; 1 voxels that lie alone are left out" in text
    info = pyogrio.read_info(out, layer="changes")
    assert (info["crs"], info["geometry_type"], info["features"]) == ("EPSG:4326", "Polygon", 3)
    assert dict(zip(info["fields"], info["dtypes"], strict=True))["last_seen"].startswith("datetime64")
    _, table = pyogrio.read_arrow(out, layer="changes")
    rows = table.to_pylist()
    assert {row["change"]: row["voxels"] for row in rows} == {"modified": 12, "new": 8, "deleted": 3}
    _, near = pyogrio.read_arrow(out, layer="changes", bbox=(*([rows[1]["lon_deg"], rows[1]["lat_deg"]] * 2),))
    assert [row["change"] for row in near.to_pylist()] == [rows[1]["change"]]
    with sqlite3.connect(out) as base:
        assert base.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert base.execute("PRAGMA user_version").fetchone() == (10300,)
        assert base.execute("PRAGMA foreign_key_check").fetchall() == []
        assert base.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_geojson_holds_the_same(two_maps: tuple[Path, Path], tmp_path: Path) -> None:
    told = json.loads(diff(*two_maps, "--to", tmp_path / "changes.geojson", "--json"))
    collection = json.loads((tmp_path / "changes.geojson").read_text())
    assert [feature["properties"] for feature in collection["features"]] == told["changes"]
    for feature in collection["features"]:
        (ring,) = feature["geometry"]["coordinates"]
        corners = np.array(ring)
        assert ring[0] == ring[-1]
        x, y = (corners - corners[0]).T
        assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0  # counter-clockwise
    assert pyogrio.read_info(tmp_path / "changes.geojson")["features"] == 3


def test_versions_and_bad_names(healed: Path, tmp_path: Path) -> None:
    text = diff(healed, "--tile", TILE.path, "--to", tmp_path / "c.gpkg")
    assert "2 changes: 1 deleted pole, 1 new object" in text
    ran = CliRunner().invoke(gnd, ["map", "diff", str(healed), "--tile", TILE.path, "--to", str(tmp_path / "c.shp")])
    assert isinstance(ran.exception, StoreError)
    assert "changes go to .gpkg or .geojson" in str(ran.exception)
    with SqliteStore(healed) as store, pytest.raises(StoreError, match="holds features"):
        map_changes(store, store, layer="signs")
