"""PLY and LAS of a map, read back with the libraries that others read them with."""

from pathlib import Path

import laspy
import numpy as np
import plyfile
import pyproj
import pytest
from click.testing import CliRunner
from map_export_maps import TILE, some_tile

from gnd.deploy.cli import gnd
from gnd.deploy.map_export.las import COLUMNS, export_las
from gnd.extras import MissingExtra
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.tile_store.export import POINT_TYPE
from gnd.tile_store.sqlite_store import SqliteStore

SURVEYED_NS = 1_700_000_000_000_000_000


@pytest.fixture
def store(tmp_path: Path):
    with SqliteStore(tmp_path / "map.sqlite") as opened:
        opened.put_tiles([some_tile(1)], surveyed_ns=SURVEYED_NS)
        yield opened


def export(store: SqliteStore, out: Path, *more: str) -> str:
    ran = CliRunner().invoke(gnd, ["map", "export", str(store.path), str(out), *more])
    assert ran.exit_code == 0, ran.output
    return ran.stdout


def test_plyfile_reads_all_columns(store: SqliteStore, tmp_path: Path) -> None:
    export(store, tmp_path / "map.ply")
    vertex = plyfile.PlyData.read(tmp_path / "map.ply")["vertex"]
    assert [prop.name for prop in vertex.properties] == list(POINT_TYPE.names or ())
    tile = some_tile(1)
    assert np.array_equal(vertex["count"], tile.gaussians.count)
    assert np.allclose(vertex["cov_zz"], tile.gaussians.cov_m2[:, 5], atol=1e-5)
    assert set(vertex["day"].tolist()) == {SURVEYED_NS // 86_400_000_000_000}


def test_open3d_reads_the_points_and_their_columns(store: SqliteStore, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    export(store, tmp_path / "map.ply")
    vertex = plyfile.PlyData.read(tmp_path / "map.ply")["vertex"]
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "map.ply"))
    assert np.allclose(cloud.point.positions.numpy()[:, 2], vertex["z"])
    assert np.allclose(cloud.point["cov_xx"].numpy().ravel(), vertex["cov_xx"])


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_a_las_file_lies_where_its_crs_says(store: SqliteStore, tmp_path: Path, ending: str) -> None:
    export(store, tmp_path / f"map.{ending}")
    las = laspy.read(tmp_path / f"map.{ending}")
    assert str(las.header.version) == "1.4"
    crs = las.header.parse_crs()
    assert crs.is_projected
    assert "UTM zone 32N" in crs.name
    to_geodetic = pyproj.Transformer.from_crs(crs.to_2d(), "EPSG:4326", always_xy=True)
    lon_deg, lat_deg = to_geodetic.transform(np.asarray(las.x), np.asarray(las.y))
    tile = some_tile(1)
    mean_m = VoxelGrid.of(TILE).centre_m(tile.gaussians.voxel_id) + tile.gaussians.mean_m
    height = LocalFrame.of_tile(TILE).geodetic_from_enu(mean_m)[2]
    off_m = (
        LocalFrame.of_tile(TILE).enu_from_geodetic(np.radians(lat_deg), np.radians(lon_deg), np.asarray(las.z)) - mean_m
    )
    assert np.abs(off_m).max() < 0.001
    assert np.abs(np.asarray(las.z) - height).max() < 0.001
    assert np.array_equal(las["count"], tile.gaussians.count)
    assert set(COLUMNS) <= set(las.point_format.dimension_names)


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_what_is_said_counts_and_not_the_ending(store: SqliteStore, tmp_path: Path, kind: str) -> None:
    export(store, tmp_path / "map.dat", "--to", kind)
    with laspy.open(tmp_path / "map.dat") as reader:
        assert reader.header.are_points_compressed == (kind == "laz")


@pytest.mark.parametrize("words", [("--points", "means"), ("--projector", "MGRS")])
def test_an_option_of_another_format_is_refused(store: SqliteStore, tmp_path: Path, words: tuple[str, str]) -> None:
    ran = CliRunner().invoke(gnd, ["map", "export", str(store.path), str(tmp_path / "map.ply"), *words])
    assert f"{words[0]} is for --to autoware, not for ply" in str(ran.exception)


def test_covariances_lie_along_the_axes_of_the_grid(store: SqliteStore, tmp_path: Path) -> None:
    """Twice the deviation along the first axis, projected as points are, is that of the covariance in the file."""
    export_las(store, "ndt", "", tmp_path / "map.las")
    las = laspy.read(tmp_path / "map.las")
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    tile, frame = some_tile(1), LocalFrame.of_tile(TILE)
    mean_m = VoxelGrid.of(TILE).centre_m(tile.gaussians.voxel_id) + tile.gaussians.mean_m
    value, axes = np.linalg.eigh(tile.gaussians.full_cov())
    ends = []
    for sign in (-1.0, 1.0):
        lat, lon, _ = frame.geodetic_from_enu(mean_m + sign * axes[:, :, 2] * np.sqrt(value[:, 2:]))
        ends.append(np.stack(to_grid.transform(np.degrees(lon), np.degrees(lat)), axis=1))
    along = (ends[1] - ends[0]) / 2.0
    wanted = along[:, 0] * along[:, 1]  # a line has no other part; of flat ones the second axis adds
    line = value[:, 1] < 0.01 * value[:, 2]
    assert line.sum() > 10
    found = np.asarray(las["cov_xy"])
    assert np.abs(found[line] - wanted[line]).max() < 0.0105 * value[:, 2].max()
    assert np.corrcoef(found[line], wanted[line])[0, 1] > 0.999


def test_without_the_library_it_says_what_to_install(
    store: SqliteStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(MissingExtra, match=r"laspy is not installed; it comes with: pip install 'gnd-fleet\[export\]'"):
        export_las(store, "ndt", "", tmp_path / "map.las")
    assert not (tmp_path / "map.las").exists()


def test_an_unknown_ending_is_refused(store: SqliteStore, tmp_path: Path) -> None:
    ran = CliRunner().invoke(gnd, ["map", "export", str(store.path), str(tmp_path / "map.shp")])
    assert "unknown export format 'shp'; known are pcd, ply" in str(ran.exception)
