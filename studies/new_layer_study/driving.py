"""One drive along a route of the new layer study, mapped without and with the lanes of the HD map; localisation."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.cloud_merger.features import merge_layer
from gnd.fleet_sim.drives import EPOCH_NS
from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.looks import DetectorNoise
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.fleet_sim.roads.test_track import test_track
from gnd.gnd_map.arrays import F64
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.features.layer import of_counts
from gnd.vehicle_agent.features.look import MapFeatures
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive, GnssFixes
from gnd.vehicle_agent.features.mapping.new_layer import NewLayer, lane_map, localise_with_features, map_new_layer
from gnd.vehicle_agent.features.view import SensorView
from studies.feature_study.reporting import (
    BaseLayer,
    Discovered,
    coverage_along,
    in_route_frame,
    reports_of,
)
from studies.new_layer_study.layers import DriveLayers, Layer, LayerLocalised, LayerTruth

TRACK: Final = "track"
MOTORWAY: Final = "motorway"
STRAIGHT: Final = "straight"
CONFIDENCE: Final = 0.9
"""λ of a detector that misses one in ten."""
_HOUR_NS: Final = 3_600 * 1_000_000_000
_LINE_STEP_M: Final = 0.5


@dataclass(frozen=True, slots=True)
class RouteTask:
    """A route and how noisy its drives are.

    Attributes:
        kind: `TRACK`, `MOTORWAY` or `STRAIGHT`.
        seed: of the route.
        km: length of a motorway; of the test track the way driven, 0 for one lap.
        beacon: noise level of the detector of point features.
        lane: noise level of the lane camera.
        gnss_bias_m: standard deviation of a drive's constant GNSS error, each axis.
    """

    kind: str
    seed: int
    km: float
    beacon: float = 1.0
    lane: float = 1.0
    gnss_bias_m: float = 0.0

    @property
    def route(self) -> Route:
        """The route itself."""
        if self.kind == TRACK:
            return test_track(self.seed)
        return streetlight_motorway(self.seed, straight=self.kind == STRAIGHT, length_m=1e3 * self.km)

    @property
    def is_usual(self) -> bool:
        """Whether both sensors have noise level 1."""
        return self.beacon == self.lane == 1.0

    @property
    def name(self) -> str:
        """What the progress bar says, and the folder."""
        noise = "" if self.is_usual else f"-beacon-{self.beacon:g}-lane-{self.lane:g}"
        return f"{self.kind}{noise}"


def drive_of(task: RouteTask, vehicle: int) -> RoadDrive:
    """Return the drive of a vehicle; with other noise levels it drives the same way with the same luck."""
    options = RoadDriveOptions(
        points=DetectorNoise(level=task.beacon),
        lanes=DetectorNoise(level=task.lane, false_alarms=0.0),
        length_m=1e3 * task.km if task.kind == TRACK and task.km else None,
        gnss_bias_m=task.gnss_bias_m,
        start_ns=EPOCH_NS + vehicle * _HOUR_NS,
    )
    return drive_route(task.route, vehicle, options)


def feature_drive(drive: RoadDrive) -> FeatureDrive:
    """Return what the vehicle has of a drive."""
    return FeatureDrive(drive.motion, GnssFixes(drive.gnss.t_ns, drive.gnss.xy_m), drive.looks, drive.lane_looks)


def layer_truth(route: Route) -> LayerTruth:
    """Return where the features of a route are, and which way the route goes beside each."""
    way = np.arange(0.0, route.length_m, _LINE_STEP_M)
    line, heading = route.line.at(way)
    xy_m = route.features.xy_m
    nearest = np.array([int(np.argmin(np.sum((line - one) ** 2, axis=1))) for one in xy_m], np.int64)
    return LayerTruth(xy_m, np.column_stack([np.cos(heading[nearest]), np.sin(heading[nearest])]))


def mapped(task: RouteTask, vehicle: int) -> tuple[DriveLayers, list[FeatureReport]]:
    """Return the layers that a drive makes without and with HD map, and what it reports of the latter.

    Without map only at the usual noise: Figure 8 is of mapping with it.
    """
    drive = drive_of(task, vehicle)
    taken = feature_drive(drive)
    without = map_new_layer(taken) if task.is_usual else None
    with_map = map_new_layer(taken, lanes=lane_map(drive.route.lanes()))
    layers = DriveLayers(None if without is None else _layer(without), _layer(with_map))
    return layers, _reports(drive, with_map, vehicle)


def _layer(found: NewLayer) -> Layer:
    return Layer(found.features.xy_m, found.features.cov_m2)


def _reports(drive: RoadDrive, found: NewLayer, vehicle: int) -> list[FeatureReport]:
    features, times = found.features, np.array([look.t_ns for look in drive.looks], np.int64)
    view = SensorView(drive.view.width_rad, drive.view.range_m)
    poses = found.path.at(times)
    coverage = coverage_along(drive.route.frame, view, poses, [None] * len(poses), float(drive.view.eye_m))
    discovered = [
        Discovered(kind, xy, cov, of_counts(hits, 0, CONFIDENCE), hits)
        for kind, xy, cov, hits in zip(
            features.kinds, features.xy_m, features.cov_m2, features.hits.tolist(), strict=True
        )
    ]
    base = BaseLayer.empty(drive.route.frame)
    span = (int(times[0]), int(times[-1]))
    return reports_of(base, drive.route.layer, f"car-{vehicle}", span, coverage, ([], discovered))


def integrated(route: Route, reports: list[FeatureReport]) -> Layer:
    """Return the layer that the cloud publishes."""
    places = [in_route_frame(route.frame, tile, one.features) for tile, one in merge_layer({}, reports).items()]
    xy_m, cov_m2 = [np.zeros((0, 2))], [np.zeros((0, 2, 2))]
    for xy, cov in places:
        xy_m.append(xy)
        cov_m2.append(cov)
    return Layer(np.concatenate(xy_m), np.concatenate(cov_m2))


def localised(task: RouteTask, vehicle: int, layer: Layer | None) -> LayerLocalised:
    """Return the errors of a drive's poses at its looks, by motion, GNSS, lanes, and a layer where given."""
    drive = drive_of(task, vehicle)
    known = None if layer is None else _known(drive.route, layer)
    found = localise_with_features(feature_drive(drive), lanes=lane_map(drive.route.lanes()), known=known)
    times = np.array([look.t_ns for look in drive.looks], np.int64)
    times = times[(times >= found.path.t_ns[0]) & (times <= found.path.t_ns[-1])]
    rows = np.searchsorted([look.t_ns for look in drive.looks], times)
    return LayerLocalised(
        (times - drive.motion.t_ns[0]) * 1e-9, along_and_across(found.path.at(times), drive.truth.look_poses[rows])
    )


def _known(route: Route, layer: Layer) -> MapFeatures:
    n, kind = len(layer.xy_m), route.features.kinds[0]
    return MapFeatures(np.arange(1, n + 1), (kind,) * n, layer.xy_m, np.full(n, np.nan), layer.cov_m2)


def along_and_across(pose: F64, true: F64) -> F64:
    """Return errors (S, 2) of poses (S, 3): along and to the left of the true heading, m."""
    dx, dy = (pose - true)[:, :2].T
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx])
