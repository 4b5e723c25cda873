"""Writes the files of an export: each world's map and truth, each drive, and what says what is there."""

import shutil
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.progress import Progress

import gnd
from gnd.fleet_sim.drives import DriveSimulation
from gnd.fleet_sim.street import street
from gnd.fleet_sim.trajectory import gauss_markov
from gnd.fleet_sim.truth import Truth, make_truth
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians, six_entries
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import exp_so3, quaternion_xyzw_from_R
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from studies.benchmark.errors import BenchmarkError
from studies.benchmark.files import read_json, sha_of, whole_folder, write_cloud, write_json, write_table
from studies.benchmark.frames import IndexFrame
from studies.benchmark.kit.score import FORMAT, VERSION
from studies.benchmark.plan import ExportOptions, PlannedDrive, PlannedWorld, planned_worlds
from studies.frame.pool import Job, Tick, run_jobs
from studies.pcd import base_pcd
from studies.simulation.base_map import surveyed
from studies.simulation.options import PoseSource
from studies.simulation.poses import TIME_CONSTANT_S
from studies.simulation.streams import as_recorded, ticking

KIT: Final = Path(__file__).parent / "kit"
KIT_FILES: Final = ("README.md", "score.py", "example.py")
MARK: Final = "benchmark.json"
GIVEN: Final = PoseSource()
"""The error of the poses that a program may take instead of localising: 4 cm, 0.08 degrees."""
_ROTATED: Final = ("qx", "qy", "qz", "qw")


def export(options: ExportOptions, folder: Path, processes: int, progress: Progress) -> dict[str, Any]:
    """Write what is missing of an export and return the content of benchmark.json.

    Raises:
        BenchmarkError: the folder holds an export of other options, or something else, or cannot be written.
    """
    mark = {"format": FORMAT, "version": VERSION, "finished": False, "options": options.chosen}
    _begin(folder, mark)
    worlds = planned_worlds(options)
    jobs = [Job(f"{world.name}: map and truth", write_world_files, (world, folder)) for world in worlds
            if not _is_done(folder, world)]  # fmt: skip
    drives = _drive_jobs(worlds, folder)
    if jobs or drives:
        write_json(folder / MARK, mark)  # what was finished is not, until all is there again
    run_jobs(jobs, processes, progress, "worlds")
    run_jobs(drives, processes, progress, "drives")
    for name in KIT_FILES:
        shutil.copyfile(KIT / name, folder / name)
    shutil.copyfile(Path(gnd.__file__).resolve().parents[2] / "LICENSE", folder / "LICENSE")
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != MARK]
    hashes = run_jobs([Job(path.name, sha_of, (path,)) for path in files], 1, progress, "hashes")
    listed = {str(path.relative_to(folder)): {"bytes": path.stat().st_size, "sha256": sha}
              for path, sha in zip(files, hashes, strict=True)}  # fmt: skip
    done = mark | {"finished": True, "worlds": [_plain_world(world) for world in worlds], "files": listed}
    write_json(folder / MARK, done)
    return done


def _begin(folder: Path, mark: dict[str, Any]) -> None:
    """Make the folder, or go on in one of the same options."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / MARK).is_file():
            found = read_json(folder / MARK)
            if any(found.get(name) != mark[name] for name in ("format", "version", "options")):
                raise BenchmarkError(f"{folder} holds an export with other options, {found.get('options')}")
        elif any(folder.iterdir()):
            raise BenchmarkError(f"{folder} is not empty and holds no export; choose another folder")
        else:
            write_json(folder / MARK, mark)
    except OSError as error:
        raise BenchmarkError(f"cannot write to {folder}: {error.strerror}") from error


def _is_done(folder: Path, world: PlannedWorld) -> bool:
    return (folder / "truth" / world.name / "voxels.npz").is_file() and (folder / "worlds" / world.name).is_dir()


def _drive_jobs(worlds: Iterable[PlannedWorld], folder: Path) -> list[Job]:
    return [
        Job(f"{world.name}, {drive.vehicle}", write_drive_files, (world, drive, folder), ticks=True)
        for world in worlds
        for drive in world.drives
        if not (folder / "worlds" / world.name / "drives" / drive.vehicle).is_dir()
    ]


def _plain_world(world: PlannedWorld) -> dict[str, Any]:
    return {
        "name": world.name,
        "family": world.family,
        "seed": world.seed,
        "length_m": world.street.length_m,
        "vehicles": [drive.vehicle for drive in world.drives],
        "sensors": [drive.sensor for drive in world.drives],
    }


# --- the map and the truth ------------------------------------------------------------------------------------------


def write_world_files(planned: PlannedWorld, folder: Path) -> None:
    """Write the map before and the truth of a world."""
    world = street(planned.seed, planned.street)
    truth = make_truth(world)
    frame = IndexFrame.around(truth)
    (folder / "truth" / planned.name).mkdir(parents=True, exist_ok=True)
    if not (folder / "worlds" / planned.name).is_dir():
        with whole_folder(folder / "worlds" / planned.name) as home:
            (home / "map_before").mkdir()
            (home / "drives").mkdir()
            write_json(home / "frame.json", frame.plain())
            write_map(home / "map_before", truth, frame)
            write_cloud(home / "map_before" / "points.pcd", base_pcd(world).points_m)
    write_voxels(folder / "truth" / planned.name / "voxels.npz", truth, frame)


def write_map(home: Path, truth: Truth, frame: IndexFrame) -> None:
    """The map before as a store, and as a table of Gaussians in the map frame."""
    base = surveyed(truth.before)
    with SqliteStore(home / "store.sqlite") as store:
        store.put_tiles([tile for tile_id in base.tiles if (tile := base.tile(tile_id)) is not None])
    parts = [_rows_of(tile_id, gaussians, frame) for tile_id, gaussians in base.tiles.items()]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    head = ("i", "j", "k", "x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz", "count", "cells")
    write_table(home / "gaussians.csv", head, columns, ("%d",) * 3 + ("%.6g",) * 9 + ("%d",) * 2)


def _rows_of(tile_id: TileId, gaussians: Gaussians, frame: IndexFrame) -> tuple[Any, ...]:
    """Columns of a tile's Gaussians: i, j, k, mean [m] and covariance [m^2] in the map frame, points, sub-cells."""
    grid, map_frame = VoxelGrid.of(tile_id), frame.grid.frame
    ijk = frame.ijk(np.full(len(gaussians), tile_id.morton), gaussians.voxel_id)
    mean = map_frame.enu_from_ecef(grid.frame.ecef_from_enu(grid.centre_m(gaussians.voxel_id) + gaussians.mean_m))
    R = map_frame.R_ecef_enu.T @ grid.frame.R_ecef_enu
    cov = six_entries(R @ gaussians.full_cov() @ R.T)
    return (*ijk.T, *mean.T, *cov.T, gaussians.count, gaussians.cells)


def write_voxels(path: Path, truth: Truth, frame: IndexFrame) -> None:
    """Write the truth's voxels; the file appears complete or not at all."""
    partial = path.with_name(f".{path.name}.part")
    ijk = frame.ijk(truth.morton, truth.voxel_id).astype(np.int32)
    columns: dict[str, Any] = {"ijk": ijk, "class": truth.change_class}
    columns |= {name: getattr(truth, name) for name in ("observable", "clear", "seasonal")}
    with partial.open("wb") as file:
        np.savez_compressed(file, **columns)
    partial.replace(path)


# --- drives ---------------------------------------------------------------------------------------------------------


def write_drive_files(planned: PlannedWorld, drive: PlannedDrive, folder: Path, tick: Tick) -> None:
    """Simulate a drive and write its files; the true poses go to the truth alone."""
    simulation = DriveSimulation(street(planned.seed, planned.street), drive.config)
    items = ticking(map(as_recorded, simulation.items()), tick, simulation.scans)
    true: list[ReferencePose] = []
    with whole_folder(folder / "worlds" / planned.name / "drives" / drive.vehicle) as home:
        (home / "scans").mkdir()
        small = list(_recorded(items, simulation.header(), home, true))
        _write_small(home, simulation.header(), small)
        write_poses(home / "poses.csv", with_error(true, drive.config.seed))
        poses = folder / "truth" / planned.name / "poses"
        poses.mkdir(parents=True, exist_ok=True)
        write_poses(poses / f"{drive.vehicle}.csv", true)


def _recorded(
    items: Iterable[DriveItem], header: DriveHeader, home: Path, true: list[ReferencePose]
) -> Iterator[DriveItem]:
    """Write everything but the true poses as MCAP and scans as plain files, too; pass on what is small."""
    rows: list[tuple[int, int, int]] = []
    with DriveWriter(home / "drive.mcap", header) as writer:
        for item in items:
            if isinstance(item, ReferencePose):
                true.append(item)
                continue
            writer.add(item)
            if isinstance(item, Scan):
                rows.append((len(rows), item.t_ns, len(item)))
                ring = np.zeros(len(item)) if item.ring is None else item.ring
                points = np.column_stack([item.points_m, item.t_offset_ns * 1e-9, ring])
                (home / "scans" / f"{len(rows) - 1:06d}.bin").write_bytes(points.astype("<f4").tobytes())
            else:
                yield item
    write_table(home / "scans.csv", ("scan", "t_ns", "points"), list(zip(*rows, strict=True)), ("%06d", "%d", "%d"))


def _write_small(home: Path, header: DriveHeader, items: Iterable[DriveItem]) -> None:
    """Positions, motion and calibration as text."""
    held = list(items)
    fixes = [(f.t_ns, np.degrees(f.lat_rad), np.degrees(f.lon_rad), f.height_m, f.sigma_m)
             for f in held if isinstance(f, GnssFix)]  # fmt: skip
    names = ("t_ns", "lat_deg", "lon_deg", "height_m", "sigma_m")
    write_table(home / "gnss.csv", names, list(zip(*fixes, strict=True)), ("%d", "%.9f", "%.9f", "%.3f", "%.3f"))
    motion = [(m.t_ns, m.speed_mps, m.yaw_rate_radps) for m in held if isinstance(m, MotionSample)]
    columns = list(zip(*motion, strict=True))
    write_table(home / "motion.csv", ("t_ns", "speed_mps", "yaw_rate_radps"), columns, ("%d", "%.5f", "%.6f"))
    content = {"sensor": header.sensor_model, "T_vehicle_lidar": header.T_vehicle_lidar.tolist()}
    write_json(home / "calibration.json", content)


def with_error(true: list[ReferencePose], seed: int) -> list[ReferencePose]:
    """Return poses as a good localiser would give them: `GIVEN` on each axis, half of it in height, roll and pitch.

    The error is a first-order Gauss-Markov process, as that of `studies.simulation.poses`.
    """
    rng, step_s = np.random.default_rng([seed, 0x61E]), (true[1].t_ns - true[0].t_ns) * 1e-9
    m, rad = GIVEN.sigma_m, GIVEN.sigma_rad
    draw = partial(gauss_markov, rng, len(true), step_s, time_constant_s=TIME_CONSTANT_S)
    errors = np.stack([draw(sigma=sigma) for sigma in (m, m, m / 2, rad / 2, rad / 2, rad)], axis=1)
    return [ReferencePose(one.t_ns, _moved(one.T_map_vehicle, e)) for one, e in zip(true, errors, strict=True)]


def _moved(T: F64, error: F64) -> F64:
    moved = T.copy()
    moved[:3, 3] += error[:3]
    moved[:3, :3] = T[:3, :3] @ exp_so3(error[3:])
    return moved


def write_poses(path: Path, poses: list[ReferencePose]) -> None:
    """Write T_map_vehicle: time, place [m], quaternion."""
    T = np.stack([one.T_map_vehicle for one in poses])
    columns = (np.array([one.t_ns for one in poses]), *T[:, :3, 3].T, *quaternion_xyzw_from_R(T[:, :3, :3]).T)
    write_table(path, ("t_ns", "x", "y", "z", *_ROTATED), columns, ("%d",) + ("%.4f",) * 3 + ("%.9f",) * 4)


def tiles_of(store: SqlStore) -> dict[TileId, Tile]:
    """Return all tiles of a store."""
    found = {entry.tile: store.get("ndt", entry.tile) for entry in store.heads()}
    return {tile_id: stored.decode_gaussians() for tile_id, stored in found.items() if stored is not None}
