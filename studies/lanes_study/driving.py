"""A street with its paint, its HD map of before, and what one drive of one vehicle reports of its borders."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.deploy.lane_edits import map_pieces
from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig, DriveSimulation, SensorErrors
from gnd.fleet_sim.markings import FloatArray, Paint, PaintedBorder, paint_of, road_intensity
from gnd.fleet_sim.markings_camera import LaneCamera, SeenBorders, border_looks
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.trajectory import gauss_markov
from gnd.fleet_sim.world import State
from gnd.gnd_map.features import prior
from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.schemas.drive import Scan
from gnd.schemas.features import FeatureReport
from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.lanelet2_export import write_lanelet2
from gnd.tile_store.feature_io.lanelet2_import import read_lanelet2
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions, MapFeature
from gnd.vehicle_agent.features.lanes.lane_mapper import MARKINGS, LaneMapper
from gnd.vehicle_agent.features.lanes.looks import BorderLook
from gnd.vehicle_agent.features.lanes.paint import paint_look
from gnd.vehicle_agent.report.feature_report import FeatureReporter
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportList

SOURCE: Final = "hd"
MAP_SIGMA_M: Final = 0.05
"""How far off the HD map's borders are, each."""
POSE_M: Final = 0.04
"""What stays of a pose's error with a drive; the vehicle claims 0.03."""
SIGMA_POSE_M: Final = 0.03
_POSE_SLOW_M: Final = 0.015
_YAW_RAD: Final = 1e-3
_EVERY: Final = 2
_SLICE_NS: Final = 1_000_000
_STREAM: Final = 1610
_HOUR_NS: Final = 3_600_000_000_000
_MINUTE_NS: Final = 60_000_000_000


@dataclass(frozen=True, slots=True)
class LaneTask:
    """A street and how its vehicles see it.

    Attributes:
        seed: of the street.
        sensor: LiDAR of all vehicles; "camera": none has one.
        length_m: of the street.
        wet: the road is wet.
        camera_off_m: how far left the cameras are off beyond what they know, all alike.
        changes: share of the borders that are painted anew.
    """

    seed: int
    sensor: str = "VLP-16"
    length_m: float = 200.0
    wet: bool = False
    camera_off_m: float = 0.0
    changes: float = 0.3

    @property
    def paint(self) -> Paint:
        """The paint of the street."""
        return paint_of(street(self.seed, StreetOptions(length_m=self.length_m, edit_share=0.0)), self.changes)


def hd_map(paint: Paint) -> FeatureFile:
    """The Lanelet2 map of the street before: its borders a little off, two lanes between them."""
    rng = np.random.default_rng([paint.world.seed, _STREAM, 1])
    options = ImportOptions(trust_latlon=True)
    features = [_map_border(paint, k, one, float(rng.normal(0.0, MAP_SIGMA_M))) for k, one in enumerate(paint.before)]
    names = {one.name: k + 1 for k, one in enumerate(paint.before)}
    n = len(names) // 3
    tags = (("location", "urban"), ("one_way", "yes"), ("subtype", "road"))
    lanes = [
        MapLane(
            f"{line}-{k}", Border(names[f"border-{a}-{k}"], ahead), Border(names[f"border-{b}-{k}"], ahead), (), tags
        )
        for k in range(n)
        for line, a, b, ahead in (("right", 1, 0, True), ("left", 1, 2, False))
    ]
    document, _ = write_lanelet2(features, lanes=lanes)
    return read_lanelet2(document, "hd.osm", SOURCE, options)


def _map_border(paint: Paint, k: int, one: PaintedBorder, off_m: float) -> MapFeature:
    line = paint.line_map_m(one, 10.0)
    t = (line[-1] - line[0])[:2] / np.hypot(*(line[-1] - line[0])[:2])
    lat, lon, height = paint.world.frame.geodetic_from_enu(line + off_m * np.array([-t[1], t[0], 0.0]))
    cov = np.array([0.01, 0.0, 0.0, 0.01, 0.0, 0.01])
    tags = (("subtype", one.marking), ("type", "line_thin"))
    return MapFeature(k + 1, "lane_boundary", "lanes", lat, lon, height, cov, prior(0.95), tags, one.name)


@dataclass(frozen=True, slots=True)
class LaneDrive:
    """What a drive reports with the HD map's borders at hand and without any map, and what it counted."""

    with_map: tuple[FeatureReport, ...]
    fresh: tuple[FeatureReport, ...]
    counts: Mapping[str, Any]


def lane_drive(task: LaneTask, vehicle: int, state: State = "after") -> LaneDrive:
    """Drive a street once, every second vehicle the other way.

    Args:
        task: the street.
        vehicle: whose drive.
        state: of the street.
    """
    paint = task.paint
    mapper = LaneMapper(paint.world.frame, SIGMA_POSE_M)
    for tile in map_pieces(hd_map(paint).features).values():
        mapper.hold(tile)
    watch(task, paint, vehicle, state, mapper)
    with_map = _reports(task, vehicle, mapper)
    counts = dict(mapper.counts) | {"camera_off_m": mapper.camera_off_m}
    mapper.let_go()
    return LaneDrive(with_map, _reports(task, vehicle, mapper), counts)


def _reports(task: LaneTask, vehicle: int, mapper: LaneMapper) -> tuple[FeatureReport, ...]:
    """What is told, as the cloud reads it."""
    start_ns = EPOCH_NS + vehicle * _HOUR_NS
    who = Identity(f"car-{vehicle}", f"lanes-{task.seed}-{vehicle}", task.sensor, MARKINGS.name)
    outbox = ReportList()
    reporter = FeatureReporter(outbox, who, start_ns, 1e9)
    for change in mapper.leave_all():
        reporter.add(change, start_ns, 0.0)
    reporter.report_all(start_ns + _MINUTE_NS)
    return tuple(FeatureReport.decode(one.body) for one in outbox.reports)


def watch(task: LaneTask, paint: Paint, vehicle: int, state: State, mapper: LaneMapper) -> None:
    """Drive once and show the mapper all that is seen."""
    sensor = "VLP-16" if task.sensor == "camera" else task.sensor
    config = DriveConfig(
        f"car-{vehicle}", sensor, state, 1 if vehicle % 2 == 0 else -1, seed=vehicle,
        errors=SensorErrors(mount_m=0.0, mount_rad=0.0), start_ns=EPOCH_NS + vehicle * _HOUR_NS,
    )  # fmt: skip
    simulation = DriveSimulation(paint.world, config)
    poses = _Poses(simulation, vehicle, paint.world.seed)
    rng = np.random.default_rng([vehicle, paint.world.seed, _STREAM])
    camera = LaneCamera()
    t_s = np.arange(0.0, simulation.scans / config.model.rate_hz, 1.0 / camera.rate_hz)
    looks = border_looks(camera, paint, state, t_s, simulation.motion.T_map_vehicle(t_s), vehicle)
    scans = (item for item in simulation.items() if isinstance(item, Scan)) if task.sensor != "camera" else ()
    for number, scan in enumerate(scans):
        if number % _EVERY == 0:
            points, intensity, at_s = _seen(scan, simulation, config, paint, state, task, rng)
            while looks and looks[0].t_s < at_s:
                _show(mapper, looks.pop(0), task, poses)
            mapper.see_paint(paint_look(points, intensity, scan.ring), poses.believed(at_s))
    for look in looks:
        _show(mapper, look, task, poses)


def _show(mapper: LaneMapper, look: SeenBorders, task: LaneTask, poses: "_Poses") -> None:
    xy = look.xy_m + np.array([0.0, task.camera_off_m])
    mapper.see_borders(BorderLook(xy, look.line, look.markings, look.colours), poses.believed(look.t_s))  # type: ignore[arg-type]


def _seen(
    scan: Scan,
    simulation: DriveSimulation,
    config: DriveConfig,
    paint: Paint,
    state: State,
    task: LaneTask,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, float]:
    """Points in the vehicle frame at the scan's start, how bright they are, and that time."""
    t0 = (scan.t_ns - config.start_ns) * 1e-9
    part = scan.t_offset_ns // _SLICE_NS
    slices = np.arange(int(part.max(initial=0)) + 1, dtype=np.float64)
    T = simulation.motion.T_map_vehicle(t0 + 1e-9 * _SLICE_NS * (slices + 0.5))
    T_map_lidar = T @ config.T_vehicle_lidar
    own = T_map_lidar[part]
    points = np.einsum("nij,nj->ni", own[:, :3, :3], scan.points_m.astype(np.float64)) + own[:, :3, 3]
    intensity = road_intensity(paint, state, points, own[:, :3, 3], rng, task.wet)
    back = T_inverse(simulation.motion.T_map_vehicle(np.array([t0])))[0]
    return points @ back[:3, :3].T + back[:3, 3], intensity, t0


class _Poses:
    """The poses that a vehicle believes: off to the side by a part that stays and one that comes and goes."""

    def __init__(self, simulation: DriveSimulation, vehicle: int, seed: int) -> None:
        rng = np.random.default_rng([vehicle, seed, _STREAM, 2])
        self._motion, self._stays = simulation.motion, POSE_M * rng.standard_normal()
        self._slow, self._yaw = gauss_markov(rng, 2000, 0.1, _POSE_SLOW_M, 5.0), _YAW_RAD * rng.standard_normal()

    def believed(self, t_s: float) -> FloatArray:
        """(4, 4) at a time."""
        off = self._stays + self._slow[min(int(10 * t_s), len(self._slow) - 1)]
        T = np.eye(4)
        T[:3, :3], T[1, 3] = exp_so3(np.array([0.0, 0.0, self._yaw])), off
        return np.asarray(self._motion.T_map_vehicle(np.array([t_s]))[0] @ T)
