"""A vehicle without LiDAR that localises by the features that it watches: SLAMCU on a vehicle (SLAMCU, Figure 2).

The particle filter of wheels, gyro, GNSS and a camera finds the poses (`watched.py`); what it concludes may change for
some kilometres. So a tile is decided once nothing can change what was concluded about it, or at the end.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import Detections, DriveItem, GnssFix, MotionSample, ReferencePose
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.features.errors import BadPose
from gnd.vehicle_agent.features.layer import FeatureLayer
from gnd.vehicle_agent.features.layer_parameters import MARGIN_M
from gnd.vehicle_agent.features.layers import look_of
from gnd.vehicle_agent.features.look import MAX_RANGE_M, MapFeatures
from gnd.vehicle_agent.features.slamcu.first_pose import AFTER_S, first_pose_of
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel
from gnd.vehicle_agent.features.slamcu.watched import WatchedSlamcu
from gnd.vehicle_agent.features.view import Occlusion
from gnd.vehicle_agent.features.without_lidar import VehicleWithoutLidar
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate
from gnd.vehicle_agent.pipeline import FeatureTiles, Output
from gnd.vehicle_agent.report.feature_report import FeatureReporter
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportSink

STEP_M: Final = 100.0
"""Tiles left behind are looked for after this much way."""
EVERY_LOOK: Final = 50
"""Of the poses that may still change, so many are passed over: a tile near one of them is not left."""
WINDOW_NS: Final = 10_000_000_000
"""The first pose is made of the measurements of this time: a vehicle that stands for long has turned in it only."""
TRY_EVERY_NS: Final = 500_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """A look that was taken: when, after how much way, and what was in its way."""

    t_ns: int
    odometer_m: float
    occlusion: Occlusion | None


class CameraPipeline(VehicleWithoutLidar):
    """One drive of one vehicle without LiDAR that localises by features.

    Args:
        fix: the first position, which lays the map frame.
        parameters: of the feature layer and its reports.
        identity: who reports.
        outbox: where reports go; None: nowhere but into the `Output`.
        feature_tiles: the map's tiles of the layer; None: no map.
        seed: of the particles.

    Attributes:
        slamcu: the filter; None until the first pose is known.

    Raises:
        AgentConfigError: not exactly one layer that a camera looks for.
    """

    def __init__(
        self,
        fix: GnssFix,
        parameters: PipelineParameters,
        identity: Identity,
        outbox: ReportSink | None = None,
        feature_tiles: FeatureTiles | None = None,
        seed: int = 0,
    ) -> None:
        layers = parameters.features.layers
        if len(layers) != 1 or layers[0].sensor != "camera":
            raise AgentConfigError(
                "a vehicle that localises by features needs one layer that its camera looks for, not"
                f" {', '.join(layer.name for layer in layers) or 'none'}"
            )
        super().__init__(fix, outbox, "searching")
        self._layer_parameters, self._seed = layers[0], seed
        self.slamcu: WatchedSlamcu | None = None
        self._layer: FeatureLayer | None = None
        self._feature_tiles = feature_tiles
        self._reporter = FeatureReporter(self._new_reports, identity, fix.t_ns, parameters.report.unchanged_m)
        self._before: deque[MotionSample | GnssFix] = deque()
        self._tried_ns = 0
        self._motion_ns = 0
        self._looks: deque[_Taken] = deque()  # whose poses are not final
        self._settled = 0  # looks before these
        self._left_m = 0.0

    def push(self, item: DriveItem) -> Output:
        """Take the next measurement; items come in time order. One that cannot be used is counted and left out."""
        if isinstance(item, ReferencePose) or not self.guard.admits(item):
            return self._output()
        if isinstance(item, GnssFix) and not item.sigma_m > 0:
            self.guard.bad["no-sigma"] += 1  # its noise is not known
            return self._output()
        if self.slamcu is None:
            self._begin(item)
        else:
            self._take(item, self.slamcu)
        self.place.take(item, self._online)
        self.timeline.note(item.t_ns, self.place.health)
        return self._output(self._settle())

    def finish(self) -> Output:
        """The drive has ended: look into what is in doubt, then decide and report everything."""
        if self.slamcu is None or self._layer is None:
            return self._output()
        self.slamcu.finish()
        poses = self._cover(self._settled + len(self._looks))
        for change in self._layer.leave_all():
            self._reporter.add(change, self.place.t_ns, self.place.odometer_m)
        self._reporter.report_all(self.place.t_ns)
        return self._output(poses)

    def account(self) -> dict[str, Any]:
        """What the drive came to, as plain values."""
        slamcu = self.slamcu
        return {
            "layers": {self._layer_parameters.name: dict(self._reporter.counts)},
            "looks": dict(self.counts),
            "health": self.timeline.as_json(),
            "lost": []
            if slamcu is None
            else [{"from_s": x.from_s, "until_s": x.until_s, "test": x.test} for x in slamcu.lost],
            "doubts": 0 if slamcu is None else slamcu.doubts,
        }

    # --- the first pose ---------------------------------------------------------------------------------------------

    def _begin(self, item: DriveItem) -> None:
        """Gather motion and fixes until they give a first pose."""
        if not isinstance(item, MotionSample | GnssFix):
            return
        self._before.append(item)
        while item.t_ns - self._before[0].t_ns > WINDOW_NS:
            self._before.popleft()
        if not isinstance(item, MotionSample) or item.t_ns - self._tried_ns < TRY_EVERY_NS:
            return
        motion = [one for one in self._before if isinstance(one, MotionSample)]
        if item.t_ns - motion[0].t_ns < AFTER_S * 1e9:
            return
        self._tried_ns = item.t_ns
        fixes = [one for one in self._before if isinstance(one, GnssFix)]
        sigma_m = float(np.median([fix.sigma_m for fix in fixes])) if fixes else 0.0
        try:
            first = first_pose_of(
                np.array([one.t_ns for one in motion], np.int64),
                np.array([one.speed_mps for one in motion]),
                np.array([one.yaw_rate_radps for one in motion]),
                np.array([one.t_ns for one in fixes], np.int64),
                np.array([self._enu_m(one) for one in fixes]).reshape(-1, 2),
                sigma_m,
            )
        except BadPose as error:
            self.guard.last_problem = str(error)
            return  # it goes on: a vehicle that stands will start
        layer = self._layer_parameters
        parameters = SlamcuParameters(detection_confidence=layer.detection_confidence)
        sensor = SensorModel(layer.detection_confidence)
        none = MapFeatures.none()
        self.slamcu = WatchedSlamcu(parameters, none, first.pose, first.cov, self._seed, sigma_m, sensor)
        self._layer = FeatureLayer(layer, self.place.frame, self.slamcu)
        self._motion_ns = first.t_ns
        self._before.clear()

    def _enu_m(self, fix: GnssFix) -> tuple[float, float]:
        """East and north of a fix in the map frame."""
        enu = np.asarray(self.place.frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)).reshape(3)
        return float(enu[0]), float(enu[1])

    # --- measurements ----------------------------------------------------------------------------------------------

    def _take(self, item: DriveItem, slamcu: WatchedSlamcu) -> None:
        """Feed the filter."""
        if isinstance(item, MotionSample):
            slamcu.predict((item.t_ns - self._motion_ns) * 1e-9, item.speed_mps, item.yaw_rate_radps)
            self._motion_ns = item.t_ns
        elif isinstance(item, GnssFix):
            slamcu.gnss(*self._enu_m(item), item.sigma_m)
        elif isinstance(item, Detections) and item.layer == self._layer_parameters.name:
            self._look(item, slamcu)

    def _look(self, item: Detections, slamcu: WatchedSlamcu) -> None:
        assert self._layer is not None
        if self._feature_tiles is not None:
            for name, tile in self._feature_tiles.follow(self.place):
                if name == self._layer_parameters.name:
                    self._layer.hold(tile)
        occlusion = Occlusion.of_look(item)
        good = np.flatnonzero((item.range_m > 0) & (item.range_m <= MAX_RANGE_M))
        self._layer.look(look_of(item, good, np.eye(4)), occlusion)
        self._looks.append(_Taken(item.t_ns, slamcu.odometer_m, occlusion))
        self.counts["looks"] += 1
        pose, cov = slamcu.pose()
        health: Health = "lost" if slamcu.is_lost else "degraded" if slamcu.camera_is_wrong else "good"
        cause: Cause = "wrong_pose" if slamcu.is_lost else "mount" if slamcu.camera_is_wrong else "none"
        self._online = self._estimate(item.t_ns, pose, cov, health, cause)

    def _estimate(self, t_ns: int, pose: F64, cov: F64, health: Health, cause: Cause) -> PoseEstimate:
        """A pose in the plane at the height that GNSS has."""
        T, c, s = np.eye(4), np.cos(pose[2]), np.sin(pose[2])
        T[:2, :2] = [[c, -s], [s, c]]
        T[:3, 3] = pose[0], pose[1], self.place.position_map_m[2]
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
        return PoseEstimate(t_ns, T, sigma_m, float(np.sqrt(cov[2, 2])), 1.0, health, cause)

    # --- what is settled --------------------------------------------------------------------------------------------

    def _settle(self) -> tuple[PoseEstimate, ...]:
        """Every so much way: where the vehicle has looked from final poses, and the tiles that these have left."""
        slamcu, layer = self.slamcu, self._layer
        if slamcu is None or layer is None or slamcu.odometer_m - self._left_m < STEP_M:
            return ()
        self._left_m = slamcu.odometer_m
        until = self._settled + sum(look.odometer_m < slamcu.settled_m for look in self._looks)
        poses = self._cover(until)
        here = [one.pose for one in slamcu.path[max(until - 1, 0) :: EVERY_LOOK]]
        if poses and here:
            slamcu.claim()
            reach_m = self._layer_parameters.range_m + MARGIN_M
            points = np.array([(x, y, 0.0) for x, y, _ in here])
            for change in layer.leave(points, reach_m):
                self._reporter.add(change, poses[-1].t_ns, self.place.odometer_m)
            self._reporter.report(layer.tiles, poses[-1].t_ns, self.place.odometer_m)
        return poses

    def _cover(self, until: int) -> tuple[PoseEstimate, ...]:
        """Take the looks up to one as they were at final poses; those of stretches that were given up do not count."""
        slamcu, layer = self.slamcu, self._layer
        assert slamcu is not None
        assert layer is not None
        poses = []
        for number in range(self._settled, until):
            taken, at = self._looks.popleft(), slamcu.path[number]
            given_up = any(lost.gives_up(at.t_s, at.t_s) for lost in slamcu.lost)
            if not given_up:
                layer.cover(at.pose, taken.occlusion)
            health: Health = "lost" if given_up else "good"
            poses.append(self._estimate(taken.t_ns, at.pose, at.cov, health, "wrong_pose" if given_up else "none"))
        self._settled = until
        return tuple(poses)
