"""The segmenter: scans vote on each other's points, then objects are kept or removed as a whole."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan, WaitingRays
from gnd.vehicle_agent.segment.parameters import PAST_S, SegmentParameters
from gnd.vehicle_agent.segment.scene import (
    SEGMENT_VOXEL_M,
    GroundMap,
    Objects,
    RangeImage,
    belief,
    find_all_objects,
    hash_table,
    image_of,
    judge_of,
)
from gnd.vehicle_agent.segment.voxel_kernels import components, components_of, moving_points

_EVERY_S: Final = 0.3
"""Time between the scans that are kept for comparison."""
_APART_S: Final = 0.15
"""Scans nearer in time show too little motion."""
_MASS_MOVING: Final = 0.5
"""Mass that one passing ray gives to "moving"."""
_MASS_STATIC: Final = 0.6
"""Mass that one return at the same place gives to "static"."""
_MOVING_SHARE: Final = 0.3
"""Share of moving voxels that makes a whole object move."""
_MIN_VOXELS: Final = 2
"""Moving voxels that an object needs."""
_PART_VOXELS: Final = 6
"""Adjacent moving voxels that are taken out of an object which as a whole stands."""

I16 = NDArray[np.int16]
Mask = NDArray[np.bool_]

_S = 1_000_000_000
_MOST_OF_I16: Final = 32767
OLD_STEP = 3


@dataclass(frozen=True, slots=True, eq=False)
class SegmentedScan:
    """A scan and which of its points lie on moving objects: `moving` (N,) bool."""

    scan: RefinedScan
    moving: Mask


@dataclass(frozen=True, slots=True, eq=False)
class _LaggedScan:
    """A scan that waits for later ones."""

    t_ns: int
    estimate: PoseEstimate
    rays: WaitingRays
    objects: Objects | None

    def restore(self) -> RefinedScan:
        """The scan as it came."""
        return RefinedScan(self.t_ns, self.rays, self.estimate)


class MotionSegmenter:
    """Takes refined scans in time order; gives each back `future_s` later with its moving points marked."""

    def __init__(self, parameters: SegmentParameters | None = None) -> None:
        self.parameters = parameters or SegmentParameters()
        self._judge = judge_of(0.0)
        self._held: deque[_LaggedScan] = deque()
        self._images: deque[RangeImage] = deque()
        self._ground = GroundMap(self.parameters)
        self._gap_tan, self._tan_low = 0.0, -np.inf

    def push(self, scan: RefinedScan) -> list[SegmentedScan]:
        """Take a scan; give those that no later scan is compared with any more, oldest first."""
        if not self.parameters.enabled:
            return [SegmentedScan(scan, np.zeros(len(scan), np.bool_))]
        p = self.parameters
        self._take(scan)
        return list(self._released(scan.t_ns - round(p.future_s * _S)))

    def flush(self) -> Iterator[SegmentedScan]:
        """Finish: give the scans that are still held, one by one (they are large)."""
        yield from self._released(None)
        self._images.clear()

    def _take(self, scan: RefinedScan) -> None:
        p, objects = self.parameters, None
        rays = scan.rays.packed()
        centre, (points, origins) = rays.centre_m, rays.from_centre()
        if len(points) and scan.estimate.health == "good":
            ground = self._ground.around(points, centre, scan.estimate.T_map_vehicle, self._tan_low)
            objects = find_all_objects(points, origins, ground, self._gap_tan, p)
            self._hear_the_past(scan.t_ns, objects, centre)
            if not self._images or scan.t_ns - self._images[-1].t_ns >= _EVERY_S * _S - _S // 50:
                R = scan.estimate.T_map_vehicle[:3, :3].T.copy()
                voxel_of = objects.voxel_of.astype(np.int32, copy=False)
                image = image_of(scan.t_ns, centre, R, points, origins, voxel_of)
                self._tell_the_held(image)
                self._images.append(image)
                self._gap_tan, self._tan_low = image.gap_tan, image.optics.tan_low
                self._judge = judge_of(self._gap_tan)
            if len(objects.points) <= _MOST_OF_I16:
                objects = replace(objects, voxel_of=objects.voxel_of.astype(np.int16))
        self._held.append(_LaggedScan(scan.t_ns, scan.estimate, rays, objects))

    def _hear_the_past(self, t_ns: int, objects: Objects, centre_m: F64) -> None:
        self._thin_out(t_ns)
        for image in self._images:
            if t_ns - image.t_ns >= _APART_S * _S:
                image.vote(t_ns, objects, centre_m, self._judge)

    def _thin_out(self, t_ns: int) -> None:
        """Forget images that are too old; of the older half keep one of `OLD_STEP` times `every_s`."""
        p, kept = self.parameters, deque[RangeImage]()
        for image in self._images:
            age_ns, last_ns = t_ns - image.t_ns, kept[-1].t_ns if kept else -(2**62)
            young = age_ns <= p.future_s * _S
            if age_ns <= PAST_S * _S and (young or image.t_ns - last_ns >= OLD_STEP * _EVERY_S * _S - _S // 50):
                kept.append(image)
        self._images = kept

    def _tell_the_held(self, image: RangeImage) -> None:
        p = self.parameters
        for held in self._held:
            if _APART_S * _S <= image.t_ns - held.t_ns <= p.future_s * _S and held.objects is not None:
                image.vote(held.t_ns, held.objects, held.rays.centre_m, self._judge)

    def _released(self, until_ns: int | None) -> Iterator[SegmentedScan]:
        while self._held and (until_ns is None or self._held[0].t_ns <= until_ns):
            held = self._held.popleft()
            yield SegmentedScan(held.restore(), self._moving(held))

    def _moving(self, held: _LaggedScan) -> Mask:
        objects = held.objects
        if objects is None:
            return np.zeros(len(held.rays), np.bool_)
        moves = decide(objects)
        if not moves.any():
            return np.zeros(len(held.rays), np.bool_)
        table = hash_table(int(moves.sum()))
        voxel_of = objects.voxel_of.astype(np.int32, copy=False)
        return moving_points(held.rays.points_m, voxel_of, objects.index, moves, SEGMENT_VOXEL_M, *table)


def decide(objects: Objects) -> Mask:
    """(V,) bool: voxels of moving objects.

    An object moves as a whole when the share of its voxels that were passed is large; from one that stands, parts of
    adjacent passed voxels are taken (somebody who walks along a wall).
    """
    moving, static = belief(objects.passed, objects.met, _MASS_MOVING, _MASS_STATIC)
    goes, stays = moving > static, static > moving
    if not goes.any():
        return goes
    whole, waiting = np.empty((2, len(goes)), np.int32)
    components_of(objects.index, objects.reach, goes, *hash_table(len(goes)), whole, waiting)
    with_goes = whole >= 0
    n_goes, n_stays = np.bincount(whole[with_goes], goes[with_goes]), np.bincount(whole[with_goes], stays[with_goes])
    moves = (n_goes >= _MIN_VOXELS) & (n_goes >= _MOVING_SHARE * (n_goes + n_stays))
    part = components(objects.index, objects.reach, goes, *hash_table(int(goes.sum())))
    large = np.append(np.bincount(part[part >= 0]) >= _PART_VOXELS, False)
    return np.asarray((with_goes & moves[whole]) | large[part])
