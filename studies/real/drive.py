"""The vehicle's half: scans become refined scans, movers are marked, rays become classes, as in the vehicle's agent."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.detect.classify import Classification, classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.parameters import DetectParameters
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
    there. mean_m: (K, 3) map frame, mean of the points that ended there, else the voxel's centre.
    """

    keys: NDArray[np.int64]
    g: NDArray[np.int64]
    change_class: NDArray[np.uint8]
    in_map: NDArray[np.bool_]
    mean_m: NDArray[np.float64]
    scans_used: int

    def within(self, keys: NDArray[np.int64]) -> "FoundVoxels":
        """What is said of these voxels only."""
        kept = np.isin(self.keys, keys)
        return FoundVoxels(
            keys=self.keys[kept],
            g=self.g[kept],
            change_class=self.change_class[kept],
            in_map=self.in_map[kept],
            mean_m=self.mean_m[kept],
            scans_used=self.scans_used,
        )

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


def detect(
    scene: RecordedScene, local_map: LocalMap, scans: Iterable[SegmentedScan], parameters: DetectParameters
) -> FoundVoxels:
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
    return _found(scene, {tile: classify(e, parameters) for tile, e in evidence.items()}, used)


def _found(scene: RecordedScene, classified: dict[TileId, Classification], used: int) -> FoundVoxels:
    g = [scene.grid_frame.grid_of_voxel(tile, c.evidence.voxel_id) for tile, c in classified.items()]
    at = np.concatenate([np.empty((0, 3), np.int64), *g])
    parts = list(classified.values())
    means = [_means_map_m(scene, tile, c) for tile, c in classified.items()]
    return FoundVoxels(
        keys=keys_of(scene.grid_frame, at),
        g=at,
        change_class=np.concatenate([np.empty(0, np.uint8), *(c.change_class for c in parts)]),
        in_map=np.concatenate([np.empty(0, np.bool_), *(c.evidence.in_map for c in parts)]),
        mean_m=np.concatenate([np.empty((0, 3)), *means]),
        scans_used=used,
    )


def _means_map_m(scene: RecordedScene, tile: TileId, one: Classification) -> NDArray[np.float64]:
    """(K, 3) map frame; a voxel without points has its mean at its centre."""
    frame = LocalFrame.of_tile(tile)
    p_tile_m = VoxelGrid.of(tile).centre_m(one.evidence.voxel_id) + one.evidence.measured.mean_m
    return transform(scene.grid_frame.frame.T_self_other(frame), p_tile_m)
