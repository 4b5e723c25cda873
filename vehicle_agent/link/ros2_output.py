"""What a vehicle knows, back on ROS 2: its pose, its health, the map around it and the changes that it reports.

| topic | type | |
|---|---|---|
| /gnd/pose | geometry_msgs/PoseWithCovarianceStamped | newest pose in the frame `gnd_map`, a sweep; none while lost |
| /gnd/health | diagnostic_msgs/DiagnosticArray | good, degraded or lost, and why; once a second of the drive |
| /gnd/origin | sensor_msgs/NavSatFix | where `gnd_map` is anchored (latched): east, north, up there |
| /gnd/map | sensor_msgs/PointCloud2 | means of the Gaussians around, when they have changed (latched) |
| /gnd/changes | sensor_msgs/PointCloud2 | what a report says has changed, x, y, z and its class, as it is decided |
"""

import logging
from typing import Any, Final

import numpy as np

from gnd.fleet_bus.errors import BusError
from gnd.fleet_bus.ros2 import LATCHED_QOS, RosNode, RosPublisher, RosQos, RosTopic
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import GnssFix
from gnd.schemas.keys import ROOT
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.pipeline import Output, Pipeline, VehiclePipeline
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.sources.ros2_messages import (
    CLOUD,
    DIAGNOSTICS,
    FIX,
    NS_PER_S,
    POSE,
    cloud_message,
    encode,
    fix_message,
    header,
    pose_message,
    type_hash,
)

MAP_FRAME: Final = "gnd_map"
NEWS_QOS: Final = RosQos(depth=10)
EVERY_NS: Final = NS_PER_S
"""Health is told as often as this, and a map that has changed."""
CHANGE_PREFIX: Final = f"{ROOT}/change/ndt"
_LEVELS: Final = {"good": 0, "degraded": 1, "lost": 2}  # diagnostic_msgs/DiagnosticStatus
_log = logging.getLogger(__name__)
_XYZ: Final = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]


class Ros2Output:
    """Publishes what a pipeline gives, on a node of the vehicle's own graph.

    Args:
        node: of the vehicle.
        pipeline: whose map is shown; of one without LiDAR only pose and health are.
    """

    def __init__(self, node: RosNode, pipeline: VehiclePipeline) -> None:
        self._node = node
        self._map: LocalMap | None = pipeline.local_map if isinstance(pipeline, Pipeline) else None
        self._pose = self._publisher("/gnd/pose", POSE)
        self._health = self._publisher("/gnd/health", DIAGNOSTICS)
        self._changes = self._publisher("/gnd/changes", CLOUD)
        self._held = self._publisher("/gnd/map", CLOUD, LATCHED_QOS)
        self._origin = self._publisher("/gnd/origin", FIX, LATCHED_QOS)
        self._posed_ns = self._told_ns = 0
        self._shown = -1
        frame = pipeline.place.frame
        at = GnssFix(pipeline.place.t_ns, frame.lat_rad, frame.lon_rad, frame.height_m, 0.0)
        self._put(self._origin, fix_message(at, MAP_FRAME))

    def take(self, output: Output, place: Place) -> None:
        """Publish what is new in the output of a measurement."""
        online = output.online
        if online is not None and online.health != "lost" and online.t_ns > self._posed_ns:
            self._posed_ns = online.t_ns
            covariance = _covariance(online.T_map_vehicle, online.covariance, online.sigma_m, online.sigma_rad)
            self._put(self._pose, pose_message(online.t_ns, MAP_FRAME, online.T_map_vehicle, covariance))
        for report in output.reports:
            if report.key.startswith(CHANGE_PREFIX):
                self._show_changes(ChangeReport.decode(report.body), place.frame)
        if place.t_ns >= self._told_ns + EVERY_NS:
            self._told_ns = place.t_ns
            self._show_health(output, place)
            self._show_map(place.t_ns)

    def _show_health(self, output: Output, place: Place) -> None:
        values = {"cause": output.cause, "odometer_m": f"{place.odometer_m:.1f}", "speed_mps": f"{place.speed_mps:.2f}"}
        if output.online is not None:
            values |= {
                "sigma_m": f"{output.online.sigma_m:.3f}",
                "matching_ratio": f"{output.online.matching_ratio:.2f}",
            }
        status = {
            "level": _LEVELS[output.health],
            "name": "gnd: localisation",
            "message": output.health if output.cause == "none" else f"{output.health}: {output.cause}",
            "hardware_id": self._node.name,
            "values": [{"key": key, "value": value} for key, value in values.items()],
        }
        self._put(self._health, encode(DIAGNOSTICS, {"header": header(place.t_ns, ""), "status": [status]}))

    def _show_map(self, t_ns: int) -> None:
        if self._map is None or self._map.generation == self._shown:
            return
        self._shown = self._map.generation
        points = np.zeros(len(self._map.mean_map_m), np.dtype(_XYZ))
        _fill(points, self._map.mean_map_m)
        self._put(self._held, cloud_message(t_ns, MAP_FRAME, points))

    def _show_changes(self, report: ChangeReport, frame: LocalFrame) -> None:
        parts = []
        for change in report.tiles:
            grid = VoxelGrid.of(change.tile)
            in_tile_m = grid.centre_m(change.changed.voxel_id) + change.changed.mean_m
            mean_m = transform(frame.T_self_other(grid.frame), in_tile_m)
            part = np.zeros(len(mean_m), np.dtype([*_XYZ, ("class", "u1")]))
            _fill(part, mean_m)
            part["class"] = change.change_class
            parts.append(part)
        if any(len(part) for part in parts):
            self._put(self._changes, cloud_message(report.last_ns, MAP_FRAME, np.concatenate(parts)))

    def _publisher(self, name: str, type_name: str, qos: RosQos = NEWS_QOS) -> RosPublisher:
        return self._node.publisher(RosTopic(name, type_name, type_hash(type_name)), qos)

    def _put(self, publisher: RosPublisher, message: bytes) -> None:
        try:
            publisher.put(message)
        except BusError as error:  # a lost router stops no drive
            _log.info("%s: not published: %s", publisher.topic.name, error)


def _fill(points: Any, mean_m: F64) -> None:
    for axis, name in enumerate("xyz"):
        points[name] = mean_m[:, axis]


def _covariance(T_map_vehicle: F64, covariance: F64 | None, sigma_m: float, sigma_rad: float) -> F64:
    """(6, 6) of position, then rotation, in the map's axes, from one of rotation, then position, in the vehicle's."""
    if covariance is None:
        return np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
    turned = np.zeros((6, 6))
    turned[:3, 3:] = turned[3:, :3] = T_map_vehicle[:3, :3]
    return np.asarray(turned @ covariance @ turned.T)
