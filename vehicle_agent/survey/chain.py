"""The submaps of a survey as they grow: scans go into the submap in which they were taken, fixes and anchors too."""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.gnd_map.submap import Column, SubmapPoints
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix
from gnd.schemas.survey import SurveyAnchor, SurveyFix, SurveyMotion, SurveySubmap
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter, SegmentedScan
from gnd.vehicle_agent.survey.odometry import OdometryScan, between

SUBMAP_M: Final = 20.0
"""Way of a submap. The clouds of neighbours overlap by most of what a LiDAR sees."""
ADDED_M: Final = 0.25
"""A scan adds its points once the vehicle has moved so far since the last that did."""
_STEP_M, _STEP_SHARE, _STEP_RAD = 0.01, 0.003, 4e-4
"""One sigma of the step between two submaps: of its place at least and by its length, of its turn by the root of it;
a step without scans, by wheels and gyro alone, is worse by `_BLIND`."""
_BLIND: Final = 5.0
_ANCHOR_M, _ANCHOR_RAD = 0.03, np.array([2e-3, 2e-3, 1e-3])
"""The least sigma of an anchor: what all poses on a stretch of the map share."""
MAX_ANCHOR_M: Final = 0.10
"""A localiser that knows its place no better than this gives no anchor."""
FIX_EVERY_M: Final = 5.0
_REMEMBERED_NS: Final = 30_000_000_000
"""Which submap a scan went into is known for so long: by then its pose is final, and what moves in it is found."""


@dataclass(slots=True, eq=False)
class GrowingSubmap:
    """A submap that scans still go into."""

    number: int
    t_ns: int
    way_m: float
    T_odom_submap: F64
    step: SurveyMotion | None
    points: SubmapPoints = field(default_factory=SubmapPoints)
    blind_m: float = 0.0
    anchor: PoseEstimate | None = None
    T_submap_anchored: F64 | None = None
    fixes: list[SurveyFix] = field(default_factory=list)
    last_ns: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ClosedSubmap:
    """A submap that is complete, with its fixes, its anchor if it has one, and the time of its last scan."""

    submap: SurveySubmap
    fixes: tuple[SurveyFix, ...]
    anchor: SurveyAnchor | None
    last_ns: int
    T_odom_submap: F64
    size: int


class SubmapChain:
    """Takes scans of the odometry and makes submaps.

    Args:
        segmenter: finds what moves; that does not go into a submap.
        frame: the map frame, in which the localiser's poses are.
    """

    def __init__(self, segmenter: MotionSegmenter, frame: LocalFrame) -> None:
        self._segmenter, self._frame = segmenter, frame
        self._growing: deque[GrowingSubmap] = deque()
        self._of_scan: deque[tuple[int, F64, GrowingSubmap]] = deque()  # time, T_odom_vehicle, submap
        self._added_way_m, self._fix_way_m, self._way_m, self._number = -np.inf, -np.inf, 0.0, 0

    def take(self, scan: OdometryScan) -> None:
        """Take the next scan."""
        if not self._growing or scan.way_m - self._growing[-1].way_m >= SUBMAP_M:
            self._growing.append(self._next(scan))
        here = self._growing[-1]
        here.blind_m += 0.0 if scan.seen else scan.way_m - self._way_m
        here.last_ns, self._way_m = scan.t_ns, scan.way_m
        self._of_scan.append((scan.t_ns, scan.T_odom_vehicle, here))
        while self._of_scan[0][0] < scan.t_ns - _REMEMBERED_NS:  # each holds its submap's points
            self._of_scan.popleft()
        if scan.way_m - self._added_way_m >= ADDED_M:
            self._added_way_m = scan.way_m
            estimate = PoseEstimate(scan.t_ns, scan.T_odom_vehicle, 0.0, 0.0, 1.0, "good")
            self._add(self._segmenter.push(RefinedScan(scan.t_ns, PlacedRays(scan.points_m, scan.origins_m), estimate)))

    def take_fix(self, fix: GnssFix, T_odom_vehicle: F64) -> None:
        """Take a position from satellites at a pose of the odometry."""
        if not self._growing or self._way_m - self._fix_way_m < FIX_EVERY_M or not 0 < fix.sigma_m < np.inf:
            return
        here, self._fix_way_m = self._growing[-1], self._way_m
        place_m = between(here.T_odom_submap, T_odom_vehicle)[:3, 3]
        here.fixes.append(SurveyFix(here.number, place_m, fix.lat_rad, fix.lon_rad, fix.height_m, fix.sigma_m))

    def take_final(self, estimate: PoseEstimate) -> None:
        """Take a final pose of the localiser on the map: of each submap the best one counts."""
        while self._of_scan and self._of_scan[0][0] < estimate.t_ns:
            self._of_scan.popleft()
        if not self._of_scan or self._of_scan[0][0] != estimate.t_ns:
            return
        _, T_odom_vehicle, here = self._of_scan[0]
        is_good = estimate.health == "good" and estimate.sigma_m <= MAX_ANCHOR_M and estimate.covariance is not None
        if is_good and (here.anchor is None or estimate.sigma_m <= here.anchor.sigma_m):
            here.anchor, here.T_submap_anchored = estimate, between(here.T_odom_submap, T_odom_vehicle)

    def closed(self, before_ns: int | None) -> list[ClosedSubmap]:
        """The submaps whose last scan is older, and are complete; None: all, the survey has ended."""
        if before_ns is None:
            self._add(list(self._segmenter.flush()))
        found = []
        while self._growing and (
            before_ns is None or (len(self._growing) > 1 and self._growing[0].last_ns < before_ns)
        ):
            found.append(self._close(self._growing.popleft()))
        return found

    def _next(self, scan: OdometryScan) -> GrowingSubmap:
        number, self._number = self._number, self._number + 1
        step = None
        if self._growing:
            before = self._growing[-1]
            step = _step(between(before.T_odom_submap, scan.T_odom_vehicle), before.blind_m)
        return GrowingSubmap(number, scan.t_ns, scan.way_m, scan.T_odom_vehicle, step)

    def _add(self, scans: list[SegmentedScan]) -> None:
        by_time = {t_ns: here for t_ns, _, here in self._of_scan}
        for one in scans:
            here = by_time.get(one.scan.t_ns) or self._submap_at(one.scan.t_ns)
            if here is not None:
                standing = one.scan.points_map_m[~one.moving]
                here.points.add(transform(T_inverse(here.T_odom_submap), standing))

    def _submap_at(self, t_ns: int) -> GrowingSubmap | None:
        return next((one for one in reversed(self._growing) if one.t_ns <= t_ns), None)

    def _close(self, one: GrowingSubmap) -> ClosedSubmap:
        bodies: dict[Column, bytes] = one.points.encoded()
        submap = SurveySubmap(one.number, one.t_ns, one.step, bodies)
        size = sum(map(len, bodies.values())) + 300
        return ClosedSubmap(submap, tuple(one.fixes), self._anchor(one), one.last_ns, one.T_odom_submap, size)

    def _anchor(self, one: GrowingSubmap) -> SurveyAnchor | None:
        """Where the submap lies in the frame of the tile that it begins in."""
        if one.anchor is None or one.T_submap_anchored is None or one.anchor.covariance is None:
            return None
        T_map_submap = one.anchor.T_map_vehicle @ T_inverse(one.T_submap_anchored)
        lat, lon, _ = self._frame.geodetic_from_enu(T_map_submap[None, :3, 3])
        tile = TileId.from_geodetic(float(lat[0]), float(lon[0]))
        T = LocalFrame.of_tile(tile).T_self_other(self._frame) @ T_map_submap
        lever_m = float(np.linalg.norm(one.T_submap_anchored[:3, 3]))
        least = np.diag([*_ANCHOR_RAD**2, *[(_ANCHOR_M + 1e-3 * lever_m) ** 2] * 3])
        return SurveyAnchor(one.number, tile, SurveyMotion(T, _symmetric(one.anchor.covariance + least)))


def _step(T: F64, blind_m: float) -> SurveyMotion:
    """The step between two submaps, of which `blind_m` were driven without scans that fit."""
    length_m = float(np.linalg.norm(T[:3, 3]))
    worse = 1.0 + (_BLIND - 1.0) * min(blind_m / max(length_m, 0.1), 1.0)
    m, rad = worse * (_STEP_M + _STEP_SHARE * length_m), worse * _STEP_RAD * np.sqrt(max(length_m, 1.0))
    return SurveyMotion(T, np.diag([rad**2] * 3 + [m**2] * 3))


def _symmetric(covariance: F64) -> F64:
    return np.asarray((covariance + covariance.T) / 2)
