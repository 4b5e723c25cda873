"""Truth by construction: a vehicle drives between two walls; the map must hold exactly those walls."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.codec import LATTICES, is_on, snap
from gnd.gnd_map.day import day_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, GnssFix, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter
from gnd.schemas.errors import DriveError
from gnd.tile_store.build import BuildError, build_map
from gnd.tile_store.compare import map_info
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqliteStore

ANCHOR = LocalFrame(np.radians(37.5597), np.radians(127.0365), 30.0)
T0_NS = 1_700_000_000_000_000_000
SWEEP_NS = 100_000_000
SPEED_MPS, YAW_RATE_RADPS = 10.0, 0.2
WALL_Y_M = 6.3


def T_vehicle_lidar() -> np.ndarray:
    """A mount that is neither central nor level."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    T[:3, 3] = 0.7, -0.2, 1.9
    return T


def T_map_vehicle(t_ns: int | np.ndarray) -> np.ndarray:
    """Where the vehicle truly is: on a circle, heading along it."""
    t_s = (np.asarray(t_ns) - T0_NS) / 1e9
    yaw = YAW_RATE_RADPS * t_s - 0.1
    T = np.zeros((*np.shape(t_s), 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    T[..., 0, 3] = SPEED_MPS / YAW_RATE_RADPS * (np.sin(yaw) + np.sin(0.1))
    T[..., 1, 3] = -SPEED_MPS / YAW_RATE_RADPS * (np.cos(yaw) - np.cos(0.1))
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    return T


def wall_points_map_m(rng: np.random.Generator, n: int) -> np.ndarray:
    """Points on two walls along the map's x axis, in the map frame."""
    x, z = rng.uniform(-5, 25, n), rng.uniform(0.1, 3.9, n)
    return np.stack([x, rng.choice([-WALL_Y_M, WALL_Y_M], n), z], axis=1)


@dataclass(frozen=True)
class Drive:
    path: Path
    points_map_m: np.ndarray


def header(**changes: object) -> DriveHeader:
    plain = DriveHeader("walls", "car-1", "test", ANCHOR, T_vehicle_lidar(), "made by a test")
    return replace(plain, **changes)  # type: ignore[arg-type]


def scan_at(t_ns: int, points_map_m: np.ndarray, frame_T: np.ndarray | None = None) -> Scan:
    """The sweep that sees these points one after the other while the vehicle moves."""
    offset = np.sort(np.linspace(0, SWEEP_NS - 1, len(points_map_m)).astype(np.uint32))
    T_map_lidar = T_map_vehicle(t_ns + offset.astype(np.int64)) @ T_vehicle_lidar()
    points = np.einsum("nij,nj->ni", np.linalg.inv(T_map_lidar), np.c_[points_map_m, np.ones(len(points_map_m))])
    return Scan(t_ns, np.ascontiguousarray(points[:, :3], np.float32), offset)


def write_drive(path: Path, seed: int = 0, scans: int = 12, drive: DriveHeader | None = None) -> Drive:
    rng = np.random.default_rng(seed)
    seen = []
    with DriveWriter(path, drive or header()) as writer:
        for k in range(scans):
            t_ns = T0_NS + k * SWEEP_NS
            seen.append(wall_points_map_m(rng, 4000))
            writer.scan(scan_at(t_ns, seen[-1]))
        for t_ns in range(T0_NS, T0_NS + (scans + 1) * SWEEP_NS, 10_000_000):
            writer.reference(ReferencePose(t_ns, T_map_vehicle(t_ns)))
    return Drive(path, np.concatenate(seen))


@pytest.fixture
def store(tmp_path: Path):
    with SqliteStore(tmp_path / "map.sqlite") as opened:
        yield opened


def map_points_m(store: SqliteStore) -> np.ndarray:
    """Means of all Gaussians of the store, in the frame `ANCHOR`."""
    found = []
    for entry in store.heads():
        tile = store.get("ndt", entry.tile).decode()
        centres = VoxelGrid.of(entry.tile).centre_m(tile.gaussians.voxel_id)
        T = ANCHOR.T_self_other(LocalFrame.of_tile(entry.tile))
        found.append((centres + tile.gaussians.mean_m) @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(found)


def test_a_moving_vehicle_maps_the_walls_where_they_stand(tmp_path: Path, store: SqliteStore) -> None:
    drive = write_drive(tmp_path / "walls.mcap")
    result = build_map([drive.path], store, codec="float")
    assert (result.drives, result.scans, result.scans_skipped) == (1, 12, 0)
    assert result.points == len(drive.points_map_m)
    assert result.tiles == result.versions_published == len(store.heads())
    assert {store.get("ndt", entry.tile).day for entry in store.heads()} == {day_of(T0_NS)}
    points = map_points_m(store)
    assert result.gaussians == len(points) > 150
    # 10 ms between poses on a circle of 50 m: the chord is 25 µm off; float32 points 1 µm.
    np.testing.assert_allclose(np.abs(points[:, 1]), WALL_Y_M, atol=1e-4)


def test_the_map_is_that_of_the_true_points_put_straight_into_voxels(tmp_path: Path, store: SqliteStore) -> None:
    drive = write_drive(tmp_path / "walls.mcap")
    build_map([drive.path], store, codec="float")
    heads = store.heads()
    accumulator = VoxelAccumulator(GridFrame.around(ANCHOR, [entry.tile for entry in heads]))
    accumulator.add(drive.points_map_m)
    expected = accumulator.finish()
    # A voxel on the threshold, or a point on a voxel's face, may fall to the other side by rounding.
    shared = 0
    for entry in heads:
        built = store.get("ndt", entry.tile).decode().gaussians
        truth = expected[entry.tile].select(built.voxel_id)
        built = built.select(truth.voxel_id)
        close = np.abs(built.count - truth.count) <= 2
        assert close.mean() > 0.95
        np.testing.assert_allclose(built.mean_m[close], truth.mean_m[close], atol=0.02)
        shared += len(truth)
    assert shared > 0.97 * sum(map(len, expected.values()))


def test_drives_with_different_anchors_make_one_map(tmp_path: Path, store: SqliteStore) -> None:
    first = write_drive(tmp_path / "first.mcap", seed=1)
    elsewhere = LocalFrame(ANCHOR.lat_rad + 1e-5, ANCHOR.lon_rad - 2e-5, 10.0)
    T = elsewhere.T_self_other(ANCHOR)
    second = tmp_path / "second.mcap"
    rng = np.random.default_rng(2)
    with DriveWriter(second, header(anchor=elsewhere, drive_id="second")) as writer:
        for k in range(12):
            writer.scan(scan_at(T0_NS + k * SWEEP_NS, wall_points_map_m(rng, 4000)))
        for t_ns in range(T0_NS, T0_NS + 13 * SWEEP_NS, 10_000_000):
            writer.reference(ReferencePose(t_ns, T @ T_map_vehicle(t_ns)))
    result = build_map([first.path, second], store, codec="float")
    assert result.scans == 24
    points = map_points_m(store)
    np.testing.assert_allclose(np.abs(points[:, 1]), WALL_Y_M, atol=1e-4)
    counts = sum(int(store.get("ndt", e.tile).decode().gaussians.count.sum()) for e in store.heads())
    assert counts > 0.9 * result.points


def test_building_again_from_the_same_drive_publishes_nothing(tmp_path: Path, store: SqliteStore) -> None:
    drive = write_drive(tmp_path / "walls.mcap")
    first = build_map([drive.path], store)
    again = build_map([drive.path], store)
    assert again.gaussians == first.gaussians
    assert again.versions_published == 0


def test_range_limits_leave_out_what_is_too_near_or_too_far(
    tmp_path: Path, store: SqliteStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnd.tile_store.build.POINT_RANGE_M", (5.0, 10.0))
    drive = write_drive(tmp_path / "walls.mcap")
    result = build_map([drive.path], store)
    assert 0 < result.points < len(drive.points_map_m)
    positions = T_map_vehicle(T0_NS + np.arange(13) * SWEEP_NS)[:, :2, 3]
    reach = np.linalg.norm(map_points_m(store)[:, None, :2] - positions, axis=2).min(axis=1)
    assert reach.max() < 10.0 + 1.0


def test_scans_outside_the_reference_poses_are_counted_and_left_out(tmp_path: Path, store: SqliteStore) -> None:
    rng = np.random.default_rng(3)
    path = tmp_path / "longer.mcap"
    with DriveWriter(path, header()) as writer:
        for k in range(20):
            writer.scan(scan_at(T0_NS + k * SWEEP_NS, wall_points_map_m(rng, 4000)))
        for t_ns in range(T0_NS, T0_NS + 12 * SWEEP_NS, 10_000_000):
            writer.reference(ReferencePose(t_ns, T_map_vehicle(t_ns)))
    seen: list[tuple[int, int]] = []
    result = build_map([path], store, progress=lambda _, done, total: seen.append((done, total)))
    assert result.scans + result.scans_skipped == 20
    assert result.scans_skipped >= 6
    assert seen == [(k + 1, 20) for k in range(20)]


def poses(count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    t_ns = T0_NS + np.arange(count) * 20_000_000
    return t_ns, T_map_vehicle(t_ns)


def write_poses(path: Path, t_ns: np.ndarray, T: np.ndarray, fixes: list[GnssFix] | None = None) -> Path:
    with DriveWriter(path, header()) as writer:
        for t, pose in zip(t_ns.tolist(), T, strict=True):
            writer.reference(ReferencePose(t, pose))
        for fix in fixes or []:
            writer.gnss(fix)
        writer.scan(scan_at(int(t_ns[0]), wall_points_map_m(np.random.default_rng(0), 1000)))
    return path


def jumped(T: np.ndarray) -> np.ndarray:
    moved = T.copy()
    moved[25:, 0, 3] += 12.5
    return moved


def spun(T: np.ndarray) -> np.ndarray:
    turned = T.copy()
    turned[25:, :2, :2] = turned[25:, :2, :2] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    return turned


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, T: (t[:1], T[:1]), r"1 reference poses; a map needs known poses"),
        (lambda t, T: (t[:0], T[:0]), r"0 reference poses"),
        (lambda t, T: (t, jumped(T)), r"pose 26 of 50 jumps \(63\d m/s\), so do 0 others"),
        (lambda t, T: (t, spun(T)), r"pose 26 of 50 jumps in heading \(78\.\d rad/s\)"),
        (lambda t, T: (np.repeat(t, 2), np.repeat(T, 2, axis=0)), r"is not later than the one before \(0 s\)"),
        (lambda t, T: (np.delete(t, slice(10, 70)), np.delete(T, slice(10, 70), axis=0)), r"after a gap \(1\.22 s\)"),
    ],
    ids=["one pose", "no poses", "jump", "spin", "doubled", "gap"],
)
def test_poses_that_no_vehicle_has_are_refused_with_numbers(tmp_path, store, change, message) -> None:
    count = 100 if "gap" in message else 50
    t_ns, T = change(*poses(count))
    path = tmp_path / "bad.mcap"
    if len(t_ns):
        write_poses(path, t_ns, T)
    else:
        with DriveWriter(path, header()) as writer:
            writer.scan(scan_at(T0_NS, wall_points_map_m(np.random.default_rng(0), 1000)))
    with pytest.raises(BuildError, match=message):
        build_map([path], store)
    assert store.heads() == []


def test_a_vehicle_that_stands_may_have_a_gap_in_its_poses(tmp_path: Path, store: SqliteStore) -> None:
    t_ns, T = poses(50)
    t_ns = np.concatenate([t_ns, t_ns[-1] + 5_000_000_000 + np.arange(1, 20) * 20_000_000])
    T = np.concatenate([T, np.repeat(T[-1:], 19, axis=0)])
    assert build_map([write_poses(tmp_path / "stands.mcap", t_ns, T)], store, n_min_cells=1).scans == 1


def test_poses_elsewhere_than_the_gnss_fixes_are_refused(tmp_path: Path, store: SqliteStore) -> None:
    t_ns, T = poses()
    lat, lon, height = ANCHOR.geodetic_from_enu(T[:, :3, 3] + [0.0, 45.0, 0.0])
    fixes = [GnssFix(*row, 2.5) for row in zip(t_ns.tolist(), lat, lon, height, strict=True)]
    path = write_poses(tmp_path / "shifted.mcap", t_ns, T, fixes)
    with pytest.raises(BuildError, match=r"lie 45\.0 m from 50 GNSS fixes \(median\), allowed are 30\.0 m"):
        build_map([path], store)
    vague = [replace(fix, sigma_m=10.0) for fix in fixes]  # within five sigma the fixes may be to blame
    assert build_map([write_poses(tmp_path / "vague.mcap", t_ns, T, vague)], store, n_min_cells=1).scans == 1


def test_no_drives_missing_files_and_sparse_scans_are_refused(tmp_path: Path, store: SqliteStore) -> None:
    with pytest.raises(BuildError, match="no drives"):
        build_map([], store)
    with pytest.raises(DriveError, match=r"absent\.mcap: no such drive"):
        build_map([tmp_path / "absent.mcap"], store)
    with pytest.raises(BuildError, match=r"none of \d+ voxels with points has 900 occupied sub-cells"):
        build_map([write_drive(tmp_path / "walls.mcap", scans=2).path], store, n_min_cells=900)
    assert store.heads() == []


def test_a_drive_across_a_change_of_the_voxel_grid_fills_both_sides(tmp_path: Path, store: SqliteStore) -> None:
    # Going north from here a tile becomes one voxel narrower.
    lat_index = TileId.from_geodetic(ANCHOR.lat_rad, ANCHOR.lon_rad).lat_index
    lon_index = TileId.from_geodetic(ANCHOR.lat_rad, ANCHOR.lon_rad).lon_index
    nx = VoxelGrid.of(TileId.from_indices(lon_index, lat_index)).nx
    while VoxelGrid.of(TileId.from_indices(lon_index, lat_index)).nx == nx:
        lat_index += 1
    south, west = TileId.from_indices(lon_index, lat_index).south_west_rad
    drive = write_drive(tmp_path / "border.mcap", drive=header(anchor=LocalFrame(south, west, 30.0)))
    result = build_map([drive.path], store, codec="float")
    widths = {VoxelGrid.of(entry.tile).nx for entry in store.heads()}
    assert widths == {nx, nx - 1}
    counts = sum(int(store.get("ndt", e.tile).decode().gaussians.count.sum()) for e in store.heads())
    assert counts > 0.9 * result.points


@pytest.mark.parametrize("codec", ["archive", "standard", "compact"])
def test_a_map_is_built_on_a_lattice_and_stays_near_what_was_measured(tmp_path: Path, codec: str) -> None:
    drive = write_drive(tmp_path / "walls.mcap")
    with SqliteStore(tmp_path / "plain.sqlite") as plain, SqliteStore(tmp_path / "map.sqlite") as store:
        build_map([drive.path], plain, codec="float")
        build_map([drive.path], store, codec=codec)
        assert build_map([drive.path], store, codec=codec).versions_published == 0
        for entry in plain.heads():
            measured, built = (one.get("ndt", entry.tile).decode().gaussians for one in (plain, store))
            assert is_on(built, LATTICES[codec])
            assert not is_on(measured, LATTICES[codec])
            assert built == snap(measured, LATTICES[codec], new_map=True)
            assert np.array_equal(built.voxel_id, measured.voxel_id)
            sd_m = np.sqrt(measured.cov_m2[:, [0, 3, 5]])
            assert (np.abs(built.mean_m - measured.mean_m) <= sd_m + 0.002).all()
        assert map_info(store).bytes_a_voxel < map_info(plain).bytes_a_voxel
        assert list(map_info(plain).codecs.values()) == [len(plain.heads())]


def test_an_unknown_codec_is_refused_before_anything_is_read(tmp_path: Path, store: SqliteStore) -> None:
    with pytest.raises(StoreError, match="codec 'zip' is unknown; known are archive, standard, compact, float"):
        build_map([tmp_path / "absent.mcap"], store, codec="zip")
