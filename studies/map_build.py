"""What closing loops does to a map: a street driven up and down whose reference poses drift as LiDAR odometry does.

The truth is known, so passes are set against each other by their errors at the same place. Doubled surfaces are counted
for the first pass alone, for both as recorded, and for both refined.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.trajectory import Direction
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.schemas.drive import ReferencePose
from gnd.schemas.drive_mcap import DriveWriter
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.map_build.build import BuiltMap, build_recorded_map
from gnd.vehicle_agent.map_build.quality import measure
from gnd.vehicle_agent.map_build.refine_poses import RefineMode
from studies.frame.measure import Figure


@dataclass(frozen=True)
class MapDrift:
    """Errors of odometry: of scale, and of heading, pitch and height by the root of the way."""

    scale: float = 0.003
    yaw_deg_root_m: float = 0.03
    tilt_deg_root_m: float = 0.01
    start_m: float = 0.0
    start_deg: float = 0.0


def drifted(poses: Trajectory, drift: MapDrift, seed: int) -> Trajectory:
    """The track as odometry would have it: it begins at the truth (or beside it) and goes astray from there."""
    rng = np.random.default_rng([91, seed])
    steps = T_inverse(poses.T_dst_vehicle[:-1]) @ poses.T_dst_vehicle[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)
    turn = np.radians([drift.tilt_deg_root_m, drift.tilt_deg_root_m, drift.yaw_deg_root_m])
    noise = rng.standard_normal((len(steps), 3)) * turn * np.sqrt(length)[:, None]
    steps[:, :3, 3] *= 1.0 + drift.scale
    steps[:, :3, :3] = steps[:, :3, :3] @ exp_so3(noise)
    T = poses.T_dst_vehicle[0].copy()
    T[:3, :3] = exp_so3([0.0, 0.0, np.radians(drift.start_deg)]) @ T[:3, :3]
    T[:2, 3] += drift.start_m * np.array([0.8, -0.6])
    found = [T]
    for step in steps:
        found.append(found[-1] @ step)
    return Trajectory(poses.t_ns, np.stack(found))


def drift_drive(world: World, config: DriveConfig, path: Path, drift: MapDrift) -> Trajectory:
    """Write a drive with drifting reference poses; give the true ones."""
    simulation = DriveSimulation(world, config)
    t_s = np.arange(-0.1, simulation.scans / config.model.rate_hz + 0.3, 0.1)
    truth = Trajectory(config.start_ns + np.round(t_s * 1e9).astype(np.int64), simulation.motion.T_map_vehicle(t_s))
    wrong = drifted(truth, drift, config.seed)
    with DriveWriter(path, simulation.header()) as writer:
        for t, T in zip(wrong.t_ns.tolist(), wrong.T_dst_vehicle, strict=True):
            writer.add(ReferencePose(t, T))
        for item in simulation.items():
            if not isinstance(item, ReferencePose):
                writer.add(item)
    return truth


def relative_errors(tracks: list[Trajectory], truths: list[Trajectory]) -> np.ndarray:
    """(N,) horizontal distance [m] of all poses from the truth, after the best common rigid motion is taken off."""
    found = np.concatenate([t.at(truth.t_ns)[:, :3, 3] for t, truth in zip(tracks, truths, strict=True)])
    true = np.concatenate([truth.T_dst_vehicle[:, :3, 3] for truth in truths])
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    return np.asarray(np.linalg.norm((a @ exp_so3([0.0, 0.0, yaw]).T - b)[:, :2], axis=1))


SEED, LENGTH_M = 1101, 300.0
PASSES: Final[tuple[tuple[Direction, int, MapDrift], ...]] = (
    (1, 11, MapDrift()),
    (-1, 12, MapDrift(start_m=0.8, start_deg=0.5)),
)


def run() -> list[Figure]:
    """Build the maps of one street; the seed was not used for tuning."""
    with TemporaryDirectory() as folder:
        world, paths, truths = street(SEED, StreetOptions(length_m=LENGTH_M)), list[Path](), list[Trajectory]()
        for direction, seed, drift in PASSES:
            config = DriveConfig("car", "VLP-16", "before", seed=seed, direction=direction, cruise_mps=12.0)
            paths.append(Path(folder) / f"{seed}.mcap")
            truths.append(drift_drive(world, config, paths[-1], drift))
        found = _figures("one pass", paths[:1], truths[:1], "never", Path(folder))
        found += _figures("as recorded", paths, truths, "never", Path(folder))
        return found + _figures("refined", paths, truths, "auto", Path(folder))


def _figures(name: str, paths: list[Path], truths: list[Trajectory], mode: RefineMode, folder: Path) -> list[Figure]:
    start_s = time.perf_counter()
    with SqliteStore(folder / f"{name}.db") as store:
        built = build_recorded_map(paths, store, refine=mode)
    spent_s, quality = time.perf_counter() - start_s, measure(built)
    scans = sum(one.scans for one in built.counts)
    found = [
        Figure(
            f"doubled walls, {name}", quality.walls.per_thousand, "of 1,000", f"{quality.walls.surfaces:,} surfaces"
        ),
        Figure(f"doubled road, {name}", quality.road.per_thousand, "of 1,000", f"{quality.road.surfaces:,} surfaces"),
        Figure(f"thickness of planes, {name}", 100 * quality.thickness_m[1], "cm", "median sd"),
        Figure(f"time, {name}", 1e3 * spent_s / scans, "ms a scan", f"{scans} scans"),
    ]
    if len(truths) == 2:
        apart_m = _passes_apart_m(built, truths)
        detail = f"95 %: {100 * np.quantile(apart_m, 0.95):.1f} cm"
        found.append(Figure(f"passes apart by the truth, {name}", 100 * float(np.median(apart_m)), "cm", detail))
    for when, drift in (("before", built.poses.before), ("after", built.poses.after)):
        if drift is not None:
            detail = f"95 %: {100 * drift.horizontal_p95_m:.1f} cm; {drift.loops} places"
            found.append(Figure(f"passes apart by loops, {when}", 100 * drift.horizontal_m, "cm", detail))
    return found


def _passes_apart_m(built: BuiltMap, truths: list[Trajectory]) -> F64:
    """(N,) horizontal difference of the two passes' errors, at each place of the first where the second came by."""
    off = [
        source.poses.at(truth.t_ns)[:, :2, 3] - truth.T_dst_vehicle[:, :2, 3]
        for source, truth in zip(built.sources, truths, strict=True)
    ]
    first, second = (truth.T_dst_vehicle[:, :2, 3] for truth in truths)
    near = np.argmin(((first[:, None] - second[None]) ** 2).sum(axis=2), axis=1)
    return np.asarray(np.linalg.norm(off[0] - off[1][near], axis=1))
