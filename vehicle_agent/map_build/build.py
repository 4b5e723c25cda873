"""`gnd map build`: a map from recorded drives, without what moves and without the vehicle itself.

Three steps. A first look over each drive finds the bodywork, the road and samples of its scans. Where drives meet
again, loops are closed and the poses refined (`refine_poses`). Then every scan passes the motion segmentation, and what
stands goes into its voxel.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.accumulate import N_MIN_CELLS
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.gnd_map.tile import Tile
from gnd.tile_store.build import (
    POINT_RANGE_M,
    BuildError,
    MapPoints,
    MapSource,
    drive_sources,
    map_lattice,
    put_map,
    surveyed_ns,
)
from gnd.tile_store.store import Store
from gnd.tile_store.values import DEFAULT_CODEC, DEFAULT_LAYER
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.map_build.bodywork import HIGH_M, LOW_M, Bodywork
from gnd.vehicle_agent.map_build.placed_scans import NoPose, drive_scans, placed, why_no_pose
from gnd.vehicle_agent.map_build.refine_poses import PosesReport, RefineMode, refine_poses
from gnd.vehicle_agent.map_build.survey import DriveSurvey, Progress, look_over
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan, SegmentParameters

MOVERS: Final = SegmentParameters(range_max_m=80.0)
"""As on the vehicle, but as far as points are taken."""
_BODY_REACH_M: Final = float(np.linalg.norm(np.maximum(np.abs(LOW_M), np.abs(HIGH_M))))


@dataclass(slots=True)
class BuiltDrive:
    """What became of the scans and points of one drive; points of scans with a pose, within range."""

    scans: int = 0
    without_pose: Counter[NoPose] = field(default_factory=Counter)
    points: int = 0
    movers: int = 0
    bodywork: int = 0

    @property
    def points_used(self) -> int:
        """Points in the map."""
        return self.points - self.movers - self.bodywork


@dataclass(frozen=True, slots=True, eq=False)
class BuiltMap:
    """A map that was put into a store, and what it was made of.

    sources: the drives with the poses that were used. surveys, counts: of each drive. poses: what was done about them.
    tiles: as published. measured: all points in their voxels.
    """

    sources: tuple[MapSource, ...]
    surveys: tuple[DriveSurvey, ...]
    poses: PosesReport
    counts: tuple[BuiltDrive, ...]
    tiles: tuple[Tile, ...]
    measured: MapPoints
    versions_published: int


def no_progress(_step: str, _done: int, _total: int) -> None:
    """For callers that show nothing."""


def build_recorded_map(
    drives: Sequence[Path],
    store: Store,
    *,
    layer: str = DEFAULT_LAYER,
    codec: str = DEFAULT_CODEC,
    n_min_cells: int = N_MIN_CELLS,
    keep_movers: bool = False,
    refine: RefineMode = "auto",
    progress: Progress = no_progress,
) -> BuiltMap:
    """Build the tiles that the drives measured and put them into the store as a new base, all or none.

    Args:
        drives: recordings with reference poses.
        store: where the tiles go.
        layer: such as "ndt"; its name begins so, or it would hold features.
        codec: one of `MAP_CODECS`.
        n_min_cells: a voxel holds a Gaussian from so many occupied sub-cells on.
        keep_movers: what moves, and the vehicle itself, stay in the map.
        refine: whether poses are closed in loops and tied to GNSS; see `refine_poses`.
        progress: called after each scan of each step.

    Raises:
        BuildError: a feature layer, no drives, no reference poses, impossible poses, no voxel dense enough.
        DriveError: a drive cannot be read.
        StoreError: an unknown codec, or the store cannot take the tiles.
    """
    lattice = map_lattice(layer, codec)
    sources = drive_sources(drives)
    surveys = [look_over(source, progress) for source in sources]
    sources, poses = refine_poses(sources, surveys, refine, progress)
    measured, counts = MapPoints(sources), list[BuiltDrive]()
    for source, survey in zip(sources, surveys, strict=True):
        counts.append(BuiltDrive())
        for points_map_m in _standing(source, survey, keep_movers, counts[-1], progress):
            measured.add(points_map_m)
    if not sum(one.scans for one in counts):
        missing = sum((one.without_pose for one in counts), Counter[NoPose]())
        raise BuildError(f"none of {missing.total()} scans has a pose: {reasons(missing)}; are both in the same clock?")
    tiles = measured.tiles(n_min_cells, lattice)
    published = put_map(tiles, store, layer, surveyed_ns(sources))
    return BuiltMap(tuple(sources), tuple(surveys), poses, tuple(counts), tuple(tiles), measured, published)


def reasons(missing: Counter[NoPose]) -> str:
    """In words: "3 before the first pose, 1 after the last pose"."""
    return ", ".join(f"{n} {reason}" for reason, n in sorted(missing.items()))


def _standing(
    source: MapSource,
    survey: DriveSurvey,
    keep_movers: bool,
    counts: BuiltDrive,
    progress: Progress,
) -> Iterator[F64]:
    """Points (N, 3) in the map frame of what stands still, scan after scan; `counts` is filled."""
    segmenter = MotionSegmenter(replace(MOVERS, enabled=not keep_movers))
    for scan in _scans(source, survey.bodywork, keep_movers, counts, progress):
        for done in segmenter.push(scan):
            yield _still(done, counts)
    for done in segmenter.flush():
        yield _still(done, counts)


def _still(one: SegmentedScan, counts: BuiltDrive) -> F64:
    counts.movers += int(one.moving.sum())
    return one.scan.points_map_m[~one.moving]


def _scans(
    source: MapSource,
    bodywork: Bodywork,
    keep_bodywork: bool,
    counts: BuiltDrive,
    progress: Progress,
) -> Iterator[RefinedScan]:
    """The scans that have a pose, without the vehicle's own points."""
    for done, scan in enumerate(drive_scans(source)):
        progress(f"{source.path.name}: mapping", done + 1, source.scans)
        reason = why_no_pose(scan, source.poses)
        if reason is not None:
            counts.without_pose[reason] += 1
            continue
        mount = source.header.T_vehicle_lidar
        one = placed(scan, source.poses, mount, POINT_RANGE_M)
        counts.scans, counts.points = counts.scans + 1, counts.points + len(one.points_map_m)
        yield one if keep_bodywork else _without(one, bodywork, counts)


def _without(one: RefinedScan, bodywork: Bodywork, counts: BuiltDrive) -> RefinedScan:
    if not bodywork.cells.any():
        return one
    T = one.estimate.T_map_vehicle
    near = np.flatnonzero(((one.points_map_m - T[:3, 3]) ** 2).sum(axis=1) < _BODY_REACH_M**2)
    own = near[bodywork.of(transform(T_inverse(T), one.points_map_m[near]))]
    kept = np.ones(len(one.points_map_m), np.bool_)
    kept[own] = False
    counts.bodywork += len(own)
    return RefinedScan(one.t_ns, PlacedRays(one.points_map_m[kept], one.origins_map_m[kept]), one.estimate)
