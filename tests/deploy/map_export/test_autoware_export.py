"""A map for Autoware: its files by the letter of its documents, its coordinates, and who localises on it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import pytest
import yaml
from export_testing import Ndt, OnTiles, PlaneFrame, apart, beside, read_cell, read_export, scans_of, vgicp
from map_export_maps import TILE, some_tile
from service_localising import check_drive

from gnd.deploy.map_export import autoware
from gnd.deploy.map_export.autoware import CLOUDS, METADATA, PROJECTOR, export_autoware, read_metadata
from gnd.deploy.map_export.projection import ProjectionError, projection_for, projection_in
from gnd.deploy.map_export.sampling import sample
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.insert_drive import rewrite_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.build import build_map
from gnd.tile_store.export import ExportError, region_tiles
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.importer import import_recording
from gnd.vehicle_agent.importers.recording import NOMINAL


@pytest.fixture
def store(tmp_path: Path):
    with SqliteStore(tmp_path / "map.sqlite") as opened:
        opened.put_tiles([some_tile(1), some_tile(2, TileId.from_geodetic(np.radians(49.0104), np.radians(8.4306)))])
        yield opened


def test_samples_have_the_moments_of_their_gaussian() -> None:
    gaussians = some_tile(3).gaussians
    mean = np.random.default_rng(0).normal(0, 10, (len(gaussians), 3))
    points, row = sample(mean, gaussians, 0.2)
    assert (np.diff(row) >= 0).all()
    assert set(row.tolist()) == set(range(len(gaussians)))
    sd_m = np.sqrt(np.linalg.eigvalsh(gaussians.full_cov())[:, 2])
    for i, cov in enumerate(gaussians.full_cov()):
        cloud = points[row == i]
        assert np.abs(cloud.mean(axis=0) - mean[i]).max() < 1e-9
        if sd_m[i] < 0.01:
            assert len(cloud) == 1
        else:
            assert np.abs(np.cov(cloud.T, bias=True) - cov).max() < 1e-8


def test_a_flat_patch_is_a_grid_of_points() -> None:
    six = np.array([[0.29**2, 0.0, 0.0, 0.29**2, 0.0, 0.01**2]], np.float32)
    one = np.ones(1, np.int32)
    points, _ = sample(np.zeros((1, 3)), Gaussians(0 * one, one, one, np.zeros((1, 3), np.float32), six), 0.2)
    assert len(points) == 36
    steps = np.diff(np.unique(points[:, 0].round(6)))
    assert np.allclose(steps, steps[0])
    assert 0.15 < steps[0] < 0.2
    assert np.allclose(np.abs(points[:, 2]), 0.01)


def test_the_files_are_as_autoware_reads_them(store: SqliteStore, tmp_path: Path) -> None:
    out = tmp_path / "autoware"
    result = export_autoware(store, "ndt", "", out)
    metadata = yaml.safe_load((out / METADATA).read_text())
    assert (metadata.pop("x_resolution"), metadata.pop("y_resolution")) == (20.0, 20.0)
    assert {path.name for path in (out / CLOUDS).iterdir()} == set(metadata)
    assert sum(len(read_cell(out / CLOUDS / name)) for name in metadata) == result.points
    for name, corner in metadata.items():
        assert all(isinstance(value, int) for value in corner)  # its loader reads them as int
        inside = read_cell(out / CLOUDS / name)[:, :2] - corner
        assert ((inside >= 0.0) & (inside < 20.0)).all()
    info = yaml.safe_load((out / PROJECTOR).read_text())
    assert (info["projector_type"], info["vertical_datum"]) == ("TransverseMercator", "WGS84")
    assert info["map_origin"].keys() == {"latitude", "longitude", "altitude"}


@pytest.mark.parametrize("projector", ["TransverseMercator", "MGRS", "LocalCartesianUTM"])
def test_points_lie_where_autoware_puts_their_positions(store: SqliteStore, tmp_path: Path, projector: str) -> None:
    """x and y of PROJ's transverse Mercator with what the file says, z the height above the ellipsoid."""
    out = tmp_path / "autoware"
    export_autoware(store, "ndt", "", out, projector=projector, points="means")
    info = yaml.safe_load((out / PROJECTOR).read_text())
    if projector == "TransverseMercator":
        origin = info["map_origin"]
        to_plane = pyproj.Proj(
            f"+proj=tmerc +ellps=WGS84 +lat_0={origin['latitude']} +lon_0={origin['longitude']}"
            f" +k_0={info['scale_factor']}"
        )
        zero = (0.0, 0.0)
    else:
        to_plane = pyproj.Proj("EPSG:32632")
        zero = (
            (400_000.0, 5_400_000.0)
            if projector == "MGRS"
            else to_plane(*(info["map_origin"][k] for k in ("longitude", "latitude")))
        )
    if projector == "MGRS":
        assert info["mgrs_grid"] == "32UMV"
    expected = []
    for tile in region_tiles(store, "ndt", ""):
        mean_m = VoxelGrid.of(tile.tile_id).centre_m(tile.gaussians.voxel_id) + tile.gaussians.mean_m
        lat, lon, height = LocalFrame.of_tile(tile.tile_id).geodetic_from_enu(mean_m)
        x, y = to_plane(np.degrees(lon), np.degrees(lat))
        expected.append(np.stack([x - zero[0], y - zero[1], height], axis=1))
    names = [name for name in yaml.safe_load((out / METADATA).read_text()) if name.endswith(".pcd")]
    found = np.concatenate([read_cell(out / CLOUDS / name) for name in names])
    wanted = np.concatenate(expected)
    nearest = np.linalg.norm(wanted[:, None] - found[None], axis=2).min(axis=1)
    assert nearest.max() < (0.008 if projector == "MGRS" else 0.0002)  # the float32 of 100 km, of 100 m
    assert abs(found[:, 2].mean() - wanted[:, 2].mean()) < 1e-4


def test_a_metre_of_the_map_is_a_metre_on_the_ground() -> None:
    """An MGRS map is 40 cm a kilometre too short: 4 cm for a beam of 100 m."""
    frame = LocalFrame(np.radians(49.0), np.radians(8.4), 900.0)
    lat, lon, _ = frame.geodetic_from_enu([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    for projector, off_m in (("TransverseMercator", 0.0), ("MGRS", -0.05)):
        x, y = projection_for(projector, 49.0, 8.4, 900.0).forward(lat, lon)
        assert float(np.hypot(x[1] - x[0], y[1] - y[0])) - 100.0 == pytest.approx(off_m, abs=0.005)


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "square"),
    [(35.6762, 139.6503, "54SUE"), (-33.8568, 151.2153, "56HLH"), (60.39, 5.32, "32VKN"), (0.1, -179.9, "01NAA")],
)
def test_mgrs_squares_have_their_names(lat_deg: float, lon_deg: float, square: str) -> None:
    assert projection_for("MGRS", lat_deg, lon_deg, 0.0).square.zfill(5) == square


def test_what_it_writes_it_reads_and_inverts() -> None:
    for projector in ("TransverseMercator", "LocalCartesianUTM"):
        made = projection_for(projector, -33.8568, 179.9999, 40.0)
        assert projection_in(made.yaml()) == made
        lat, lon = np.radians([-33.85, -33.86]), np.radians([179.9, -179.95])
        back_lat, back_lon = made.inverse(*made.forward(lat, lon))
        assert np.abs(back_lat - lat).max() < 1e-11
        assert np.abs(back_lon - lon).max() < 1e-11


def test_a_name_changes_with_the_content_and_only_then(store: SqliteStore, tmp_path: Path) -> None:
    out = tmp_path / "autoware"
    first = export_autoware(store, "ndt", "", out)
    before = {path.name: path.stat().st_mtime_ns for path in (out / CLOUDS).iterdir()}
    again = export_autoware(store, "ndt", "", out)
    assert (again.written, again.removed, again.kept) == (0, 0, first.written)
    tile = some_tile(1)
    store.put_tiles([Tile(TILE, 2, tile.gaussians.take(np.arange(len(tile.gaussians) - 1)))])
    # a tile in the north: the middle of the map moves, its projection must not
    store.put_tiles([some_tile(4, TileId.from_geodetic(np.radians(49.0109), np.radians(8.43)))])
    changed = export_autoware(store, "ndt", "", out)
    after = {path.name: path.stat().st_mtime_ns for path in (out / CLOUDS).iterdir()}
    assert changed.removed >= 1
    assert changed.kept > len(before) / 2
    assert {name: t for name, t in after.items() if name in before}.items() <= before.items()
    names = yaml.safe_load((out / METADATA).read_text())
    assert set(after) == {name for name in names if name.endswith(".pcd")}


def test_an_interrupted_export_leaves_nothing_behind(
    store: SqliteStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Autoware loads all files of the folder: cells that no metadata names would lie in its map for ever."""
    out, plain = tmp_path / "autoware", autoware._write

    def full(path: Path, data: bytes) -> None:
        if path.name == METADATA:
            raise OSError(28, "No space left on device")
        plain(path, data)

    monkeypatch.setattr(autoware, "_write", full)
    with pytest.raises(ExportError, match="No space left"):
        export_autoware(store, "ndt", "", out, points="means")
    left = len(list((out / CLOUDS).iterdir()))
    assert left > 0
    monkeypatch.setattr(autoware, "_write", plain)
    assert export_autoware(store, "ndt", "", out).removed == left
    assert {path.name for path in (out / CLOUDS).iterdir()} == set(read_metadata(out))


@pytest.mark.parametrize("change", [("WGS84", "EGM2008"), ("altitude: 0.0", "altitude: 30.0")])
def test_the_projection_of_another_map_is_not_written_over(
    store: SqliteStore, tmp_path: Path, change: tuple[str, str]
) -> None:
    """A map beside a Lanelet2 map with heights above the geoid would lie tens of metres off it."""
    text = projection_for("LocalCartesianUTM", 49.01, 8.43, 0.0).yaml().replace(*change)
    (tmp_path / PROJECTOR).write_text(text)
    with pytest.raises(ProjectionError, match="says another projection than LocalCartesianUTM with heights above"):
        export_autoware(store, "ndt", "", tmp_path)
    assert (tmp_path / PROJECTOR).read_text() == text


def test_it_refuses_what_it_cannot_do_right(store: SqliteStore, tmp_path: Path) -> None:
    out = tmp_path / "autoware"
    export_autoware(store, "ndt", "", out)
    with pytest.raises(ProjectionError, match="says another projection than MGRS"):
        export_autoware(store, "ndt", "", out, projector="MGRS")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("years of work")
    with pytest.raises(ExportError, match="not empty"):
        export_autoware(store, "ndt", "", foreign)
    (foreign / METADATA).write_text("x_resolution: 20.0\ny_resolution: 20.0\nA.pcd: [0, 0]\n")
    with pytest.raises(ExportError, match=r"another program \(A.pcd\)"):
        export_autoware(store, "ndt", "", foreign)
    store.put_tiles([some_tile(5, TileId.from_geodetic(np.radians(52.5), np.radians(13.4)))])
    with pytest.raises(ProjectionError, match="export a smaller region"):
        export_autoware(store, "ndt", "", tmp_path / "two_cities")


@dataclass(frozen=True)
class Localised:
    """Poses in the plane of the export, of the same scans from the same starts."""

    true: np.ndarray
    ours_on_tiles: np.ndarray
    ndt_on_tiles: np.ndarray
    ndt_on_export: np.ndarray
    vgicp_on_export: np.ndarray
    vgicp_on_moved: np.ndarray
    ndt_on_means: np.ndarray


def localised(folder: Path, drive: Path, every: int) -> Localised:
    with SqliteStore(folder / "base.sqlite") as opened:
        tiles = region_tiles(opened, "ndt", "")
        export_autoware(opened, "ndt", "", folder / "autoware")
        export_autoware(opened, "ndt", "", folder / "means", points="means")
    projection, cloud = read_export(folder / "autoware")
    _, means = read_export(folder / "means")
    few_points = Ndt.of_moments(means, np.zeros((1, 3, 3)), np.ones(len(means)), 2.0, 6)
    scans = list(scans_of(drive, every))
    plane = PlaneFrame(scans[0][2], projection)
    on_tiles = OnTiles(tiles, plane)
    ndt = Ndt.of_moments(cloud, np.zeros((1, 3, 3)), np.ones(len(cloud)), 2.0, 6)
    moved = vgicp(cloud + np.array([0.05, 0.0, 0.0]))
    on_cloud, rng, rows = vgicp(cloud), np.random.default_rng(1), []
    for points, T, _ in scans:
        start = beside(T, rng)
        there, few = plane.pose(start), points[rng.permutation(len(points))[:3000]]
        rows.append(
            (
                plane.pose(T),
                on_tiles.ours(points, start),
                on_tiles.ndt.align(few, there),
                ndt.align(few, there),
                on_cloud(points, there),
                moved(points, there),
                few_points.align(few, there),
            )
        )
    return Localised(*(np.stack(column) for column in zip(*rows, strict=True)))


def check_poses(found: Localised) -> None:
    """The issue asks for 2 cm, and aims at 1 cm."""
    for name, a, b in (
        ("VGICP on the export, ours on the tiles", found.vgicp_on_export, found.ours_on_tiles),
        ("NDT on the export, NDT on the tiles", found.ndt_on_export, found.ndt_on_tiles),
    ):
        off = apart(a, b)
        across_m = np.linalg.norm(off[:, :2], axis=1)
        middle, worst, height = np.median(across_m), across_m.max(), np.median(np.abs(off[:, 2]))
        print(f"{name}: median {1e3 * middle:.1f} mm, worst {1e3 * worst:.1f} mm, height {1e3 * height:.1f} mm")
        assert worst < 0.02
        assert middle < 0.015
        assert np.abs(off[:, 2]).max() < 0.01
    # the same comparison sees that NDT cannot use the means alone, and a map that is 5 cm off
    of_means, of_samples = (
        float(np.median(np.linalg.norm(apart(poses, found.ndt_on_tiles), axis=1)))
        for poses in (found.ndt_on_means, found.ndt_on_export)
    )
    print(f"NDT on the means: median {1e3 * of_means:.1f} mm with the height, on samples {1e3 * of_samples:.1f} mm")
    assert of_means > 3.0 * of_samples
    moved = found.vgicp_on_moved[:, :3, 3] - found.vgicp_on_export[:, :3, 3]
    assert np.median(moved[:, 0]) == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
def test_localisers_find_the_same_pose_on_a_simulated_street(tmp_path: Path) -> None:
    world = street(1005, StreetOptions(length_m=100.0))
    mapping = DriveConfig("mapper", "HDL-32E", "before", errors=PERFECT, car_share=0.0, cruise_mps=10.0, scans=30)
    with SqliteStore(tmp_path / "base.sqlite") as opened:
        build_map([simulate_drive(world, mapping, tmp_path / "mapping.mcap")], opened)
    config = DriveConfig("car", "HDL-32E", "before", seed=3, scans=30, car_share=0.0, cruise_mps=10.0)
    check_poses(localised(tmp_path, simulate_drive(world, config, tmp_path / "drive.mcap"), 4))


@pytest.mark.slow
def test_localisers_find_the_same_pose_on_a_real_street(shared_data: Path, tmp_path: Path, free_port: int) -> None:
    """And one that gets its cells from the map service."""
    import_recording("kitti", shared_data / "kitti00_start16", tmp_path / "whole.mcap", anchor=NOMINAL)
    rewrite_drive(tmp_path / "whole.mcap", tmp_path / "mapped.mcap", [], slice(0, None, 2))
    rewrite_drive(tmp_path / "whole.mcap", tmp_path / "driven.mcap", [], slice(1, None, 2))
    with SqliteStore(tmp_path / "base.sqlite") as opened:
        build_map([tmp_path / "mapped.mcap"], opened)
    check_poses(localised(tmp_path, tmp_path / "driven.mcap", 1))
    check_drive(tmp_path, tmp_path / "driven.mcap", 1, 2.0, free_port)
