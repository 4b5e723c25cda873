"""Simulated drives: what a vehicle's sensors give along a street, written as MCAP in the form of recorded drives."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import radians, sqrt
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.camera import Sightings, SignCamera, look_times_ns, looks_of, sightings
from gnd.fleet_sim.cars import MAX_STAY_H, Stays, parked_cars
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.lidar import Lidar, column_poses
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensing import BEAMS, WEATHERS, Beams, Disturbance, Weather
from gnd.fleet_sim.sensors import MODELS, LidarModel
from gnd.fleet_sim.stage import Stage
from gnd.fleet_sim.traffic import Traffic, movers_of
from gnd.fleet_sim.trajectory import Direction, DrivingStyle, gauss_markov, lane_motion
from gnd.fleet_sim.world import State, World
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import Detections, DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter

_NS_PER_S: Final = 1_000_000_000
_NS_PER_H: Final = 3_600 * _NS_PER_S
EPOCH_NS: Final = 1_570_838_400 * _NS_PER_S
"""12 October 2019, 00:00 UTC, the day of the GND paper's 38 drives (section 7.1)."""
Labels = Callable[[int, NDArray[np.bool_]], None]
"""Takes the time of a scan [ns] and which of its points move, bool (N,)."""
_LEAD_S: Final = 0.2
_MOTION_HZ: Final = 50
_REFERENCE_HZ: Final = 100


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Errors of the vehicle's own sensors; each drive draws its own (standard deviations).

    Attributes:
        wheel_scale: error of the wheel's radius, as a share.
        wheel_mps: white noise of the wheel speed.
        gyro_bias_radps: constant error of the yaw rate.
        gyro_radps: white noise of the yaw rate.
        gnss_m: horizontal error of the GNSS (root mean square of both axes together), slowly varying.
        gnss_correlation_s: its time constant.
        gnss_white_m: white noise of each axis on top.
        mount_m: error of the LiDAR's mounting position against what the drive's header says, each axis.
        mount_rad: error of its mounting angle, each axis.
    """

    wheel_scale: float = 0.005
    wheel_mps: float = 0.02
    gyro_bias_radps: float = radians(0.1)
    gyro_radps: float = radians(0.1)
    gnss_m: float = 2.5
    gnss_correlation_s: float = 40.0
    gnss_white_m: float = 0.2
    mount_m: float = 0.003
    mount_rad: float = radians(0.02)

    def __post_init__(self) -> None:
        bad = [name for name in self.__slots__ if getattr(self, name) < 0]
        if bad or self.gnss_correlation_s == 0:
            raise DriveSimError(f"sensor errors must not be negative: {bad or 'gnss_correlation_s is 0'}")


PERFECT: Final = SensorErrors(0.0, 0.0, 0.0, 0.0, 0.0, 40.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """What a simulated drive is like.

    Attributes:
        vehicle: pseudonym written into the recording.
        sensor: model name, one of `sensors.MODELS`.
        state: the world's state that it drives through.
        direction: +1 along the street, -1 against it.
        seed: everything random of this drive.
        cruise_mps: speed once under way; None: as usual in the world.
        car_share: share of parking slots and bays that are taken; None: as usual in the world.
        scans: at most so many scans, None for the whole street.
        gnss_hz: rate of the GNSS.
        errors: of the vehicle's sensors.
        start_ns: UTC of the first scan.
        traffic: moving cars and people; none by default.
        mount_height_m: height of the LiDAR over the road, None for the usual one of the model.
        camera: a camera that detects traffic signs; None for none.
        weather: rain disturbs the LiDAR, see `gnd.fleet_sim.sensing`.
        beams: "real" ones have a width.
        stay_h: parked cars stay for so many hours on the average, and two drives through a world meet the same ones
            if the time between them is short; 0: every drive meets others.
    """

    vehicle: str
    sensor: str
    state: State = "after"
    direction: Direction = 1
    seed: int = 0
    cruise_mps: float | None = None
    car_share: float | None = None
    scans: int | None = None
    gnss_hz: int = 10
    errors: SensorErrors = field(default_factory=SensorErrors)
    start_ns: int = EPOCH_NS
    traffic: Traffic = field(default_factory=Traffic)
    mount_height_m: float | None = None
    camera: SignCamera | None = None
    weather: Weather = "clear"
    beams: Beams = "ideal"
    stay_h: float = 0.0

    def __post_init__(self) -> None:
        if self.sensor not in MODELS:
            raise DriveSimError(f"unknown sensor {self.sensor!r}, known are {', '.join(MODELS)}")
        if self.direction not in (1, -1):
            raise DriveSimError(f"direction must be 1 or -1, got {self.direction}")
        if self.weather not in WEATHERS or self.beams not in BEAMS:
            raise DriveSimError(f"unknown weather {self.weather!r} or beams {self.beams!r}: {WEATHERS}, {BEAMS}")
        if not 0.0 <= self.stay_h <= MAX_STAY_H:
            raise DriveSimError(f"stay_h must be in 0 … {MAX_STAY_H:g}, got {self.stay_h}")
        if not 1 <= self.gnss_hz <= _MOTION_HZ:
            raise DriveSimError(f"gnss_hz must be in 1 … {_MOTION_HZ}, got {self.gnss_hz}")

    @property
    def model(self) -> LidarModel:
        """The sensor's data sheet."""
        return MODELS[self.sensor]

    @property
    def T_vehicle_lidar(self) -> NDArray[np.float64]:
        """Mounting pose as the vehicle knows it, float64 (4, 4): the model's place, level, looking ahead."""
        x, y, z = self.model.mount_m
        T = np.eye(4)
        T[:3, 3] = x, y, z if self.mount_height_m is None else self.mount_height_m
        return T


def simulate_drive(
    world: World, config: DriveConfig, path: Path, on_scan: Callable[[int, int], None] | None = None
) -> Path:
    """Simulate one drive and write it; the file appears complete or not at all.

    Args:
        world: the street.
        config: vehicle, sensor and style.
        path: the MCAP file to write.
        on_scan: told (scans done, scans in all) now and then.

    Returns:
        The path.

    Raises:
        DriveSimError: the configuration cannot be driven.
        DriveError: the file cannot be written.
    """
    simulation = DriveSimulation(world, config)
    with DriveWriter(path, simulation.header()) as writer:
        for item in simulation.items():
            writer.add(item)
            if on_scan is not None and isinstance(item, Scan):
                on_scan((item.t_ns - config.start_ns) // config.model.period_ns + 1, simulation.scans)
    return path


class DriveSimulation:
    """One drive through a world, as a stream of what the sensors give.

    Attributes:
        motion: the true motion; its time 0 is `config.start_ns`.
        scans: number of LiDAR sweeps.
        movers: what moves there besides, None if nothing does; its times are those of the motion.
    """

    def __init__(self, world: World, config: DriveConfig) -> None:
        self._config = config
        self._world = world
        self._rng = np.random.default_rng([config.seed, world.seed])
        style = DrivingStyle.drawn(self._rng, world.cruise_mps if config.cruise_mps is None else config.cruise_mps)
        self.motion, duration_s = lane_motion(world, style, config.direction)
        whole = int(duration_s * config.model.rate_hz)
        self.scans = whole if config.scans is None else min(whole, config.scans)
        if self.scans < 1:
            raise DriveSimError(f"a drive needs at least one scan, got {self.scans} ({duration_s:.2f} s of street)")
        share = world.parking if config.car_share is None else config.car_share
        since_h = (config.start_ns - EPOCH_NS) / _NS_PER_H
        cars = parked_cars(world, config.state, share, config.seed, Stays(config.stay_h, since_h))
        shapes = (*world.shapes(config.state), *cars)
        self._scene = Scene.build(shapes, world.A_street_map)
        stage = Stage(world, shapes, self._scene, self.motion, self._seconds, config.seed)
        self.movers = movers_of(config.traffic, stage)
        self._lidar = Lidar(config.model)
        self._T_vehicle_lidar_true = self._drawn_mount()
        seed = (config.seed, world.seed)
        disturbance = Disturbance(world, config.state, config.weather, config.beams, seed)
        self._disturbance = disturbance if disturbance.acts else None

    @property
    def _seconds(self) -> float:
        return self.scans / self._config.model.rate_hz

    def header(self) -> DriveHeader:
        """Return the header of the recording; its mount is the one that the vehicle believes in."""
        c = self._config
        return DriveHeader(
            drive_id=f"{c.vehicle}-{c.state}-{c.seed}",
            vehicle=c.vehicle,
            sensor_model=c.sensor,
            anchor=self._world.frame,
            T_vehicle_lidar=c.T_vehicle_lidar,
            source=f"fleet_sim, world seed {self._world.seed}, state {c.state}, drive seed {c.seed}",
        )

    def items(self, on_labels: Labels | None = None) -> Iterator[DriveItem]:
        """Yield everything that the sensors give, in time order.

        Args:
            on_labels: for evaluation only, told right before each scan is yielded: its time [ns], and which of its
                points lie on something that moves while the scan is taken, bool (N,). Never part of a recording.
        """
        small: list[DriveItem] = [*self._motion_samples(), *self._gnss_fixes(), *self._reference_poses()]
        small += self._camera_looks()
        small.sort(key=lambda item: item.t_ns)
        position, period_ns = 0, self._config.model.period_ns
        for index in range(self.scans):
            t_ns = self._config.start_ns + index * period_ns
            while position < len(small) and small[position].t_ns < t_ns:
                yield small[position]
                position += 1
            yield self._scan(t_ns, on_labels)
        yield from small[position:]

    def _drawn_mount(self) -> NDArray[np.float64]:
        errors, T = self._config.errors, np.eye(4)
        T[:3, :3] = exp_so3(errors.mount_rad * self._rng.standard_normal(3))
        T[:3, 3] = errors.mount_m * self._rng.standard_normal(3)
        return np.asarray(self._config.T_vehicle_lidar @ T)

    def _scan(self, t_ns: int, on_labels: Labels | None) -> Scan:
        t_s = (t_ns - self._config.start_ns) / _NS_PER_S
        T_map_lidar = column_poses(
            self._config.model, t_s, lambda t: self.motion.T_map_vehicle(t) @ self._T_vehicle_lidar_true
        )
        sweep = self._lidar.sweep(self._scene, T_map_lidar, self._rng, self.movers, t_s, disturbance=self._disturbance)
        if on_labels is not None:
            on_labels(t_ns, self._moving(sweep.primitive, t_s + 0.5 / self._config.model.rate_hz))
        return Scan(t_ns, sweep.points_lidar_m, sweep.t_offset_ns, sweep.ring.astype(np.uint16))

    def _moving(self, primitive: NDArray[np.int32], t_s: float) -> NDArray[np.bool_]:
        """Return which points lie on a mover that is under way at an instant, from what they lie on."""
        base = len(self._scene.packed)
        if self.movers is None:
            return np.zeros(len(primitive), dtype=np.bool_)
        moves = np.concatenate([self.movers.under_way(t_s), [False]])
        return np.asarray(moves[np.where(primitive >= base, primitive - base, -1)])

    def _times(self, rate_hz: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times of a sensor, a little longer than the scans: UTC [ns], time of the drive [s]."""
        step_ns = _NS_PER_S // rate_hz
        first, last = -round(_LEAD_S * rate_hz), round((self._seconds + _LEAD_S) * rate_hz)
        offset_ns = np.arange(first, last + 1, dtype=np.int64) * step_ns
        return self._config.start_ns + offset_ns, offset_ns / _NS_PER_S

    def _motion_samples(self) -> list[MotionSample]:
        errors, rng = self._config.errors, self._rng
        t_ns, t_s = self._times(_MOTION_HZ)
        speed, yaw_rate = self.motion.speed_and_yaw_rate(t_s)
        scale, bias = 1.0 + errors.wheel_scale * rng.standard_normal(), errors.gyro_bias_radps * rng.standard_normal()
        speed = scale * speed + errors.wheel_mps * rng.standard_normal(len(t_s))
        yaw_rate = yaw_rate + bias + errors.gyro_radps * rng.standard_normal(len(t_s))
        return [MotionSample(*row) for row in zip(t_ns.tolist(), speed.tolist(), yaw_rate.tolist(), strict=True)]

    def _gnss_fixes(self) -> list[GnssFix]:
        errors, rng = self._config.errors, self._rng
        t_ns, t_s = self._times(self._config.gnss_hz)
        axis_m = errors.gnss_m / sqrt(2.0) * np.array([1.0, 1.0, 1.5])
        step_s = 1.0 / self._config.gnss_hz
        slow = [gauss_markov(rng, len(t_s), step_s, sigma, errors.gnss_correlation_s) for sigma in axis_m]
        offset = np.stack(slow, axis=1) + errors.gnss_white_m * rng.standard_normal((len(t_s), 3))
        where = self.motion.T_map_vehicle(t_s)[:, :3, 3] + offset
        lat, lon, height = self._world.frame.geodetic_from_enu(where)
        sigma_m = max(errors.gnss_m, 0.01)
        rows = zip(t_ns.tolist(), lat.tolist(), lon.tolist(), height.tolist(), strict=True)
        return [GnssFix(*row, sigma_m) for row in rows]

    def _camera_looks(self) -> list[Detections]:
        """What the camera reports; its chance is of a stream of its own."""
        camera = self._config.camera
        if camera is None:
            return []
        times_ns = self._config.start_ns + look_times_ns(camera, self._seconds)
        return looks_of(camera, self.sightings(camera), times_ns, (self._config.seed, self._world.seed))

    def sightings(self, camera: SignCamera) -> Sightings:
        """Return which signs a camera could see at its looks; for evaluation only."""
        t_s = look_times_ns(camera, self._seconds) / _NS_PER_S
        return sightings(camera, self._world, self._config.state, self._scene, self.movers, self.motion, t_s)

    def _reference_poses(self) -> list[ReferencePose]:
        t_ns, t_s = self._times(_REFERENCE_HZ)
        poses = self.motion.T_map_vehicle(t_s)
        return [ReferencePose(t, T) for t, T in zip(t_ns.tolist(), poses, strict=True)]
