"""What closing loops does to a map: a street driven up and down whose reference poses drift as LiDAR odometry does.

The truth is known, so passes are set against each other by their errors at the same place. Doubled surfaces are counted
for the first pass alone, for both as recorded, and for both refined.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from gnd.fleet_sim.drives import DriveConfig
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.trajectory import Direction
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.map_build.build import BuiltMap, build_recorded_map
from gnd.vehicle_agent.map_build.quality import measure
from gnd.vehicle_agent.map_build.refine_poses import RefineMode
from studies.drifting_drives import Drift, drift_drive
from studies.frame.measure import Figure

SEED, LENGTH_M = 1101, 300.0
PASSES: Final[tuple[tuple[Direction, int, Drift], ...]] = (
    (1, 11, Drift()),
    (-1, 12, Drift(start_m=0.8, start_deg=0.5)),
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
