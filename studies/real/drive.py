"""The vehicle's half: scans become refined scans, movers are marked, rays become classes, as in the vehicle's agent."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.detect.classify import Classification, classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.records import planar_normals
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import RefinedScan
from gnd.vehicle_agent.pipeline import Parts
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter, SegmentedScan
from gnd.vehicle_agent.tiles_at_hand import localising_on
from studies.frame.errors import RealDataError
from studies.real.scene import RecordedScene, keys_of

Poses = Literal["reference", "estimated"]
Tiles = dict[TileId, Gaussians]


@dataclass(frozen=True, slots=True, eq=False)
class FoundVoxels:
    """What a drive says of every voxel that it touched.

    keys: (K,). g: (K, 3) int64 grid coordinates. change_class: (K,) uint8. in_map: (K,) whether the map has a Gaussian
    there. mean_m: (K, 3) map frame, mean of the points that ended there, else the voxel's centre. surface_m: (K, 3)
    the same of the map's Gaussian where there is one. normal: (K, 3) map frame, of that Gaussian, else of the
    measured one; zeros where it is no plane. hits: (K,) rays that ended there. passes: (K,) rays that passed through
    the map's Gaussian, or through the voxel where there is none.
    """

    keys: NDArray[np.int64]
    g: NDArray[np.int64]
    change_class: NDArray[np.uint8]
    in_map: NDArray[np.bool_]
    mean_m: NDArray[np.float64]
    surface_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    hits: NDArray[np.int64]
    passes: NDArray[np.int64]
    scans_used: int

    def within(self, keys: NDArray[np.int64]) -> "FoundVoxels":
        """What is said of these voxels only."""
        return self.take(np.isin(self.keys, keys))

    def take(self, kept: NDArray[np.bool_]) -> "FoundVoxels":
        """What is said of the voxels that are marked (K,)."""
        columns = {f.name: getattr(self, f.name)[kept] for f in fields(self) if f.name != "scans_used"}
        return FoundVoxels(**columns, scans_used=self.scans_used)

    def rows(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """(N,) where each key stands among these, -1 where it does not."""
        if not len(self.keys):
            return np.full(len(keys), -1, np.int64)
        order = np.argsort(self.keys)
        at = order[np.minimum(np.searchsorted(self.keys, keys, sorter=order), len(order) - 1)]
        return np.where(self.keys[at] == keys, at, -1)

    def where(self, *classes: int) -> NDArray[np.bool_]:
        """(K,) bool."""
        return np.isin(self.change_class, classes)


def local_map_of(scene: RecordedScene, tiles: Tiles) -> LocalMap:
    """The map of all tiles around the track; tiles without Gaussians are known to be empty."""
    local_map = LocalMap(scene.grid_frame)
    for tile_id in scene.grid_frame.tiles:
        if tile_id in tiles:
            local_map.set_tile(Tile(tile_id, 1, tiles[tile_id]))
        else:
            local_map.set_absent(tile_id)
    return local_map


def segmented(scans: Iterable[RefinedScan], parameters: SegmentParameters) -> Iterator[SegmentedScan]:
    """Scans in time order with the points on moving objects marked."""
    segmenter = MotionSegmenter(parameters)
    for scan in scans:
        yield from segmenter.push(scan)
    yield from segmenter.flush()


def refined_scans(
    scene: RecordedScene, local_map: LocalMap, scans: Iterable[Scan], poses: Poses
) -> Iterator[RefinedScan]:
    """Scans at the poses of the track, or at those that the vehicle's localiser finds on the map."""
    if poses == "reference":
        yield from map(scene.refined, scans)
        return
    seen: list[RefinedScan] = []
    vehicle = localising_on(local_map, scene.header, scene.gnss[0], parts=Parts(placed=(seen.append,)))
    items: list[MotionSample | GnssFix | Scan] = [*scene.motion, *scene.gnss, *scans]
    for item in sorted(items, key=lambda item: (item.t_ns, isinstance(item, Scan))):
        vehicle.push(item)
        yield from seen
        seen.clear()
    vehicle.finish()
    yield from seen


@dataclass(frozen=True, slots=True, eq=False)
class DriveFindings:
    """What a drive found: voxel by voxel, and the map that it would be after it."""

    found: FoundVoxels
    grown: Tiles
    """The tiles of the map with the Gaussians that the drive calls new."""


def detect(
    scene: RecordedScene, local_map: LocalMap, scans: Iterable[SegmentedScan], parameters: DetectParameters
) -> DriveFindings:
    """Classes of all voxels that the scans touched.

    Raises:
        RealDataError: no scan had a pose that is good enough.
    """
    detector, used = ChangeDetector(local_map, parameters), 0
    for one in scans:
        if one.scan.estimate.health == "good":
            pose = PoseUncertainty.of(one.scan.estimate)
            detector.add_scan(one.scan.points_map_m, one.scan.origins_map_m, one.moving, pose)
            used += 1
    if not used:
        raise RealDataError(f"{scene.name}: the localiser found no good pose for any scan on the map of the other half")
    evidence = detector.finish(detector.touched_tiles())
    classified = {tile: classify(e, parameters) for tile, e in evidence.items()}
    held = {tile.tile_id: tile.gaussians for t in local_map.tiles if (tile := local_map.tile(t)) is not None}
    grown = held | {tile: _grown(one) for tile, one in classified.items()}
    return DriveFindings(_found(scene, classified, used), grown)


def _grown(one: Classification) -> Gaussians:
    new = one.evidence.measured.take(one.change_class == ChangeClass.NEW)
    return concat([one.evidence.base.gaussians, new])


def _found(scene: RecordedScene, classified: dict[TileId, Classification], used: int) -> FoundVoxels:
    g = [scene.grid_frame.grid_of_voxel(tile, c.evidence.voxel_id) for tile, c in classified.items()]
    at = np.concatenate([np.empty((0, 3), np.int64), *g])
    parts = [c.evidence for c in classified.values()]
    surfaces = [_surfaces_map(scene, tile, c) for tile, c in classified.items()]
    mean_m, surface_m, normal = (
        np.concatenate([np.empty((0, 3)), *columns])
        for columns in (zip(*surfaces, strict=True) if surfaces else ((),) * 3)
    )
    return FoundVoxels(
        keys=keys_of(scene.grid_frame, at),
        g=at,
        change_class=np.concatenate([np.empty(0, np.uint8), *(c.change_class for c in classified.values())]),
        in_map=np.concatenate([np.empty(0, np.bool_), *(e.in_map for e in parts)]),
        mean_m=mean_m,
        surface_m=surface_m,
        normal=normal,
        hits=np.concatenate([np.empty(0, np.int64), *(e.n_bi + e.n_bo + e.n_be for e in parts)]),
        passes=np.concatenate([np.empty(0, np.int64), *(np.where(e.in_map, e.n_pi, e.n_pe) for e in parts)]),
        scans_used=used,
    )


def _surfaces_map(
    scene: RecordedScene, tile: TileId, one: Classification
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(K, 3) each, map frame: mean of the points, of the map's Gaussian, and its normal; see `FoundVoxels`."""
    e, held = one.evidence, one.evidence.base.gaussians
    T = scene.grid_frame.frame.T_self_other(LocalFrame.of_tile(tile))
    offset_m, normal = e.measured.mean_m.astype(np.float64), planar_normals(e.measured.full_cov())
    mean_m, rows = VoxelGrid.of(tile).centre_m(e.voxel_id) + offset_m, e.map_row[e.in_map]
    surface_m = mean_m.copy()
    surface_m[e.in_map] += held.mean_m[rows] - offset_m[e.in_map]
    normal[e.in_map] = planar_normals(held.full_cov())[rows]
    return transform(T, mean_m), transform(T, surface_m), np.asarray(normal @ T[:3, :3].T)
