"""All feature layers of one vehicle: looks and scans with final poses go in, reports come out.

A vehicle that localises with its LiDAR knows its pose to centimetres: SLAMCU runs with given poses, one layer after the
other. Looks of a camera wait until the poses about them are final; poles are looked for in a few scans together.
"""

from collections import Counter, deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import interpolate_poses
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Detections
from gnd.schemas.features import FeatureChange
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.features.layer import FeatureLayer, PlacedLook, pose_of
from gnd.vehicle_agent.features.layer_parameters import MARGIN_M, FeatureParameters
from gnd.vehicle_agent.features.look import MAX_RANGE_M, Look
from gnd.vehicle_agent.features.poles.detector import PoleDetector, Rays, detections_of
from gnd.vehicle_agent.features.poles.slices import PoseSigma
from gnd.vehicle_agent.features.view import Occlusion
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.report.feature_report import FeatureReporter
from gnd.vehicle_agent.report.pose_doubts import GOOD, POOR, WRONG, PoseDoubts
from gnd.vehicle_agent.segment.segmenter import SegmentedScan

SCANS_TOGETHER: Final = 5
"""Poles are looked for in so many scans at a time: half a second."""
LONGEST_GAP_NS: Final = 500_000_000
"""Looks between poses farther apart have no place."""
MOST_WAITING: Final = 4096
STEP_M: Final = 3.0
"""Tiles left behind are looked for after this much way."""


class _Pose(NamedTuple):
    t_ns: int
    T_map_vehicle: F64


class FeatureLayers:
    """The layers of one drive; the agent's main thread owns it.

    Args:
        parameters: which layers.
        report: which poses may make statements.
        frame: the map frame.
        reporters: one a layer, in the order of the layers.
    """

    def __init__(
        self,
        parameters: FeatureParameters,
        report: ReportParameters,
        frame: LocalFrame,
        reporters: Sequence[FeatureReporter],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._parameters, self._report = parameters, report
        self.layers = {one.name: FeatureLayer(one, frame) for one in parameters.layers}
        self._reporters = dict(zip(self.layers, reporters, strict=True))
        self._detector = PoleDetector()
        self._looks: deque[Detections] = deque(maxlen=MOST_WAITING)
        self._scans: list[SegmentedScan] = []
        self._before: _Pose | None = None
        self._looked_at: F64 | None = None
        self._t_ns = 0
        self._doubts = PoseDoubts()

    def hold(self, layer: str, tile: FeatureTile) -> None:
        """A version of a tile has come."""
        self.layers[layer].hold(tile)

    def wait(self, look: Detections) -> None:
        """A look of the camera: it waits for the poses about it."""
        if any(one.name == look.layer and one.sensor == "camera" for one in self._parameters.layers):
            self._looks.append(look)

    def take(self, segmented: SegmentedScan, odometer_m: float) -> None:
        """A scan with a final pose whose movers are known: judge the looks until then, and look for poles."""
        scan = segmented.scan
        if not self._usable(scan):
            self.counts["feature_scans_uncertain"] += 1
            self._doubts.count(self._open(), POOR)
            self._before = None
            return
        self._t_ns = scan.t_ns
        self._camera_looks(scan)
        self._lidar_looks(segmented)
        self._before = _Pose(scan.t_ns, scan.estimate.T_map_vehicle)
        self._doubts.count(self._open(), GOOD)
        self._leave_behind(scan.estimate.T_map_vehicle[:3, 3], odometer_m)

    def finish(self) -> None:
        """The drive has ended: report everything."""
        for name, layer in self.layers.items():
            for change in layer.leave_all():
                self._say(name, change, 0.0)
            self._reporters[name].report_all(self._t_ns)

    def take_back(self) -> None:
        """The pose was wrong, and it is not known since when: nothing is reported of the tiles in sight."""
        self._doubts.count(self._open(), WRONG)
        self._scans.clear()
        self._before = None

    def doubt(self, scans: int) -> None:
        """A shift lays so many of the last scans better onto the map: their poses were off."""
        if scans:
            self._doubts.count(self._open(), POOR, scans)

    def _open(self) -> list[tuple[str, TileId]]:
        """Tiles of which there is evidence."""
        return [(name, tile) for name, layer in self.layers.items() for tile in layer.tiles]

    def _say(self, name: str, change: FeatureChange, odometer_m: float) -> None:
        """Report a tile, unless the poses from which it was seen are in doubt."""
        if self._doubts.holds_back((name, change.tile)):
            self.counts["tiles_held_back"] += 1
            self.counts["features_held_back"] += change.n_features
            return
        self._reporters[name].add(change, self._t_ns, odometer_m)

    def account(self) -> dict[str, dict[str, int]]:
        """Counts by layer: reports, features judged and found."""
        return {name: dict(reporter.counts) for name, reporter in self._reporters.items()}

    def _usable(self, scan: RefinedScan) -> bool:
        pose, most = PoseUncertainty.of(scan.estimate), self._report
        good = scan.estimate.health == "good" and not scan.estimate.disagrees
        return bool(good and pose.sigma_m <= most.max_sigma_m and pose.sigma_rad <= most.max_sigma_rad)

    # The camera

    def _camera_looks(self, scan: RefinedScan) -> None:
        due = [look for look in self._looks if look.t_ns <= scan.t_ns]
        self._looks = deque((look for look in self._looks if look.t_ns > scan.t_ns), MOST_WAITING)
        placeable = sorted((look for look in due if self._is_between(look.t_ns, scan)), key=lambda look: look.t_ns)
        self.counts["looks_without_pose"] += len(due) - len(placeable)
        if not placeable:
            return
        occlusion = occlusion_of(scan)
        for look, T in zip(placeable, self._poses_at([look.t_ns for look in placeable], scan), strict=True):
            self.counts["looks"] += 1
            self.layers[look.layer].see(placed(look, T, scan), occlusion)

    def _is_between(self, t_ns: int, scan: RefinedScan) -> bool:
        """Whether a time lies between the scan before and this one, and these are not far apart."""
        before = self._before
        return before is not None and before.t_ns <= t_ns and scan.t_ns - before.t_ns <= LONGEST_GAP_NS

    def _poses_at(self, t_ns: list[int], scan: RefinedScan) -> F64:
        """(N, 4, 4) poses at times between the scan before and this one."""
        assert self._before is not None
        times = np.array([self._before.t_ns, scan.t_ns], np.int64)
        T = np.stack([self._before.T_map_vehicle, scan.estimate.T_map_vehicle])
        return interpolate_poses(times, T, np.array(t_ns, np.int64))

    # The LiDAR

    def _lidar_looks(self, segmented: SegmentedScan) -> None:
        layers = [layer for layer in self.layers.values() if layer.parameters.sensor == "lidar"]
        if not layers:
            return
        self._scans.append(segmented)
        if len(self._scans) < SCANS_TOGETHER:
            return
        middle = self._scans[len(self._scans) // 2].scan
        T = middle.estimate.T_map_vehicle
        poles = self._detector.window([still(one) for one in self._scans], T[:3, 3])
        look, occlusion = detections_of(poles, T, middle.t_ns), occlusion_of(middle)
        self._scans.clear()
        self.counts["poles"] += len(poles)
        for layer in layers:
            layer.see(placed(look, T, middle), occlusion)

    # Tiles left behind

    def _leave_behind(self, p_map_m: F64, odometer_m: float) -> None:
        if self._looked_at is not None and np.linalg.norm(p_map_m - self._looked_at) < STEP_M:
            return
        self._looked_at = p_map_m.copy()
        for name, layer in self.layers.items():
            reporter, reach_m = self._reporters[name], layer.parameters.range_m + MARGIN_M
            for change in layer.leave(p_map_m, reach_m):
                self._say(name, change, odometer_m)
            reporter.report(layer.tiles, self._t_ns, odometer_m)


def still(segmented: SegmentedScan) -> Rays:
    """The rays that end on what does not move, map frame."""
    kept, scan = ~segmented.moving, segmented.scan
    sigma = PoseSigma(scan.estimate.sigma_m, scan.estimate.sigma_rad)
    ends_m, starts_m = scan.rays.restore()
    return Rays(ends_m[kept], starts_m[kept], sigma)


def occlusion_of(scan: RefinedScan) -> Occlusion:
    """What hides features from where a scan was taken."""
    T = scan.estimate.T_map_vehicle
    points = (scan.points_map_m - T[:3, 3]) @ T[:3, :3]
    sensor = (scan.origins_map_m[:1] - T[:3, 3]) @ T[:3, :3]
    return Occlusion.of_scan(points, sensor[0] if len(sensor) else np.zeros(3))


def placed(look: Detections, T_map_vehicle: F64, scan: RefinedScan) -> PlacedLook:
    """A look from a pose that is known as well as that of the scan near it."""
    estimate = scan.estimate
    cov = np.diag([estimate.sigma_m**2, estimate.sigma_m**2, estimate.sigma_rad**2])
    good = np.flatnonzero((look.range_m > 0) & (look.range_m <= MAX_RANGE_M))
    return PlacedLook(look_of(look, good, T_map_vehicle), pose_of(T_map_vehicle), cov, float(T_map_vehicle[2, 3]))


def look_of(look: Detections, rows: I64, T_map_vehicle: F64) -> Look:
    """Some detections of a recorded look; their heights over the vehicle's origin along the map's z, not the vehicle's:
    80 m ahead on a slope of 2 % that is 1.6 m.
    """
    columns = (look.range_m, look.bearing_rad, look.sigma_range_m, look.sigma_bearing_rad, look.height_m)
    range_m, bearing_rad, sigma_range_m, sigma_bearing_rad, height_m = (
        column[rows].astype(np.float64) for column in columns
    )
    place = np.column_stack([range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad), height_m])
    kinds = tuple(look.kinds[row] for row in rows)
    return Look(look.t_ns, range_m, bearing_rad, sigma_range_m, sigma_bearing_rad, kinds, place @ T_map_vehicle[2, :3])
