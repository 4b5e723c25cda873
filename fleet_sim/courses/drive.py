"""A drive over a course as a stream of what the sensors give, with the faults that it is about."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import sqrt, tau
from typing import Final

import numpy as np

from gnd.fleet_sim.courses.company import movers_of
from gnd.fleet_sim.courses.course import DrivenCourse
from gnd.fleet_sim.courses.foliage import Foliage
from gnd.fleet_sim.courses.motion import CourseMotion
from gnd.fleet_sim.drives import EPOCH_NS, SensorErrors
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.lidar import Lidar, column_poses
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import MODELS, LidarModel
from gnd.fleet_sim.trajectory import gauss_markov
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan

_NS_PER_S: Final = 1_000_000_000
_LEAD_S: Final = 0.2
_MOTION_HZ: Final = 50
_REFERENCE_HZ: Final = 100
_GNSS_HZ: Final = 10


@dataclass(frozen=True, slots=True)
class CourseConfig:
    """Who drives a course.

    Attributes:
        sensor: model name, one of `sensors.MODELS`.
        seed: everything random of this drive.
        errors: of the sensors, beside the course's faults.
        scans: at most so many, None for the whole ride.
    """

    sensor: str
    seed: int = 0
    errors: SensorErrors = field(default_factory=SensorErrors)
    scans: int | None = None

    def __post_init__(self) -> None:
        if self.sensor not in MODELS:
            raise DriveSimError(f"unknown sensor {self.sensor!r}, known are {', '.join(MODELS)}")

    @property
    def model(self) -> LidarModel:
        """The sensor's data sheet."""
        return MODELS[self.sensor]

    @property
    def T_vehicle_lidar(self) -> F64:
        """Mounting pose as the vehicle should know it, float64 (4, 4)."""
        T = np.eye(4)
        T[:3, 3] = self.model.mount_m
        return T


class CourseDrive:
    """One drive over a course.

    Attributes:
        motion: the true motion; its time 0 is the first scan.
        scans: sweeps of the LiDAR, those that never arrive too.
        movers: other vehicles, None if there are none.
    """

    def __init__(self, course: DrivenCourse, config: CourseConfig) -> None:
        self._course, self._config = course, config
        place = course.place
        streams = np.random.default_rng([config.seed, place.world.seed, 0x4A4D]).spawn(5)
        self._motion_rng, self._gnss_rng, self._lidar_rng, self._fault_rng, mount = streams
        sway = tuple(mount.uniform(0.0, tau, 9).tolist())
        self.motion = CourseMotion(place.world, place.ground, place.lane, course.ride, sway)
        whole = int(course.ride.duration_s * config.model.rate_hz)
        self.scans = whole if config.scans is None else min(whole, config.scans)
        if self.scans < 1:
            raise DriveSimError(f"a drive needs at least one scan, got {self.scans} ({course.ride.duration_s:.2f} s)")
        self._scene = Scene.build((*place.world.shapes("after"), *course.parked), place.world.A_street_map)
        self.movers = movers_of(course.company, self.motion)
        leaves = place.foliage.get("after", ())
        self._foliage = Foliage(leaves, config.seed) if leaves else None
        self._lidar = Lidar(config.model)
        off = np.eye(4)
        off[:3, :3] = exp_so3(config.errors.mount_rad * mount.standard_normal(3))
        off[:3, 3] = config.errors.mount_m * mount.standard_normal(3)
        self._T_vehicle_lidar_true: F64 = config.T_vehicle_lidar @ off

    def header(self) -> DriveHeader:
        """Return the header; its mount is the one that the vehicle believes in."""
        c, world = self._config, self._course.place.world
        return DriveHeader(
            drive_id=f"course-{c.seed}",
            vehicle="course",
            sensor_model=c.sensor,
            anchor=world.frame,
            T_vehicle_lidar=self._course.faults.mount(c.T_vehicle_lidar),
            source=f"fleet_sim, {self._course.place.name}, world seed {world.seed}, drive seed {c.seed}",
        )

    def items(self) -> Iterator[DriveItem]:
        """Yield everything that the sensors give, by their own stamps, in time order."""
        small: list[DriveItem] = [*self._motion_samples(), *self._gnss_fixes(), *self._reference_poses()]
        small.sort(key=lambda item: item.t_ns)
        arrives = self._course.faults.arrives(self.scans, self._fault_rng)
        middle_rad = self._course.faults.blocked_at(self._config.model.span_rad, self._fault_rng)
        position, late_ns = 0, round(self._course.faults.scan_clock_s * _NS_PER_S)
        for index in range(self.scans):
            t_ns = EPOCH_NS + index * self._config.model.period_ns
            while position < len(small) and small[position].t_ns < t_ns + late_ns:
                yield small[position]
                position += 1
            if arrives[index]:
                scan = replace(self._scan(t_ns), t_ns=t_ns + late_ns)
                yield self._course.faults.dirty(scan, middle_rad, self._fault_rng)
        yield from small[position:]

    def _scan(self, t_ns: int) -> Scan:
        t_s = (t_ns - EPOCH_NS) / _NS_PER_S
        T_map_lidar = column_poses(
            self._config.model, t_s, lambda t: self.motion.T_map_vehicle(t) @ self._T_vehicle_lidar_true
        )
        sweep = self._lidar.sweep(self._scene, T_map_lidar, self._lidar_rng, self.movers, t_s, self._foliage)
        return Scan(t_ns, sweep.points_lidar_m, sweep.t_offset_ns, sweep.ring.astype(np.uint16))

    def _times_s(self, rate_hz: int) -> F64:
        """Times of a sensor [s], a little longer than the scans."""
        whole_s = self.scans / self._config.model.rate_hz
        return np.arange(-round(_LEAD_S * rate_hz), round((whole_s + _LEAD_S) * rate_hz) + 1) / rate_hz

    def _motion_samples(self) -> list[MotionSample]:
        errors, faults, rng = self._config.errors, self._course.faults, self._motion_rng
        t_s = self._times_s(_MOTION_HZ)
        speed, yaw_rate = self.motion.speed_and_yaw_rate(t_s)
        scale, bias = 1.0 + errors.wheel_scale * rng.standard_normal(), errors.gyro_bias_radps * rng.standard_normal()
        speed = scale * faults.speed_factor(t_s, rng) * speed + errors.wheel_mps * rng.standard_normal(len(t_s))
        yaw_rate = yaw_rate + bias + faults.gyro_bias_radps + errors.gyro_radps * rng.standard_normal(len(t_s))
        stamps = _stamps(t_s + faults.stamp_error_s(t_s))
        return [MotionSample(*row) for row in zip(stamps, speed.tolist(), yaw_rate.tolist(), strict=True)]

    def _gnss_fixes(self) -> list[GnssFix]:
        errors, faults, rng = self._config.errors, self._course.faults, self._gnss_rng
        t_s = self._times_s(_GNSS_HZ)
        axis_m = errors.gnss_m / sqrt(2.0) * np.array([1.0, 1.0, 1.5])
        slow = [gauss_markov(rng, len(t_s), 1.0 / _GNSS_HZ, sigma, errors.gnss_correlation_s) for sigma in axis_m]
        offset = np.stack(slow, axis=1) + errors.gnss_white_m * rng.standard_normal((len(t_s), 3))
        where = self.motion.T_map_vehicle(t_s)[:, :3, 3] + offset + faults.gnss_jumps(t_s, rng)
        lat, lon, height = self._course.place.world.frame.geodetic_from_enu(where)
        rows = zip(_stamps(t_s), lat.tolist(), lon.tolist(), height.tolist(), strict=True)
        fixes = [GnssFix(*row, max(errors.gnss_m, 0.01)) for row in rows]
        return [fix for fix, received in zip(fixes, faults.has_gnss(t_s), strict=True) if received]

    def _reference_poses(self) -> list[ReferencePose]:
        t_s = self._times_s(_REFERENCE_HZ)
        return [ReferencePose(t, T) for t, T in zip(_stamps(t_s), self.motion.T_map_vehicle(t_s), strict=True)]


def _stamps(t_s: F64) -> list[int]:
    stamps: list[int] = (EPOCH_NS + np.round(t_s * _NS_PER_S).astype(np.int64)).tolist()
    return stamps
