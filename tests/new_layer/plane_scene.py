"""A short drive in the plane with known truth: a lamp-lined road, looks, fixes and lanes, noise as asked for."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import Detections, LaneLook, MotionTrack
from gnd.vehicle_agent.features.mapping.dead_reckoning import composed, relative
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive, GnssFixes
from gnd.vehicle_agent.features.mapping.sensors import DriveSensors, GnssReceiver, WheelsAndGyro

T0_NS = 1_700_000_000_000_000_000


class Truth(NamedTuple):
    t_ns: np.ndarray
    pose: F64
    features: F64
    lanes: tuple[F64, ...]

    def at(self, t_ns: np.ndarray) -> F64:
        return np.stack([np.interp(t_ns, self.t_ns, column) for column in self.pose.T], axis=1)


@dataclass(frozen=True)
class Noise:
    """Standard deviations; nothing is off by default."""

    scale: float = 0.0
    wheel: float = 0.0
    bias: float = 0.0
    gyro: float = 0.0
    gnss: float = 0.0
    tau_s: float = 12.0
    white: float = 0.0
    range_m: float = 0.0
    bearing: float = 0.0
    lane_m: float = 0.0
    lane_rad: float = 0.0
    miss: float = 0.0
    held_share: float = 0.0
    held_rad: float = 0.0


PAPER = Noise(
    0.005, 0.02, np.radians(0.1), np.radians(0.1), 2.12, 12.0, 0.05, 1.0, np.radians(2.5), 1.0, np.radians(2.5), 0.1
)


@dataclass(frozen=True)
class Scene:
    """seconds of driving at speed along a road that bends with curvature amplitude `bend`."""

    seconds: float = 16.0
    speed: float = 10.0
    bend: float = 0.02
    look_hz: int = 5
    features: F64 = field(default_factory=lambda: np.array([[20.0, 8.0], [50.0, -7.0], [85.0, 9.0], [120.0, -8.0]]))

    def truth(self) -> Truth:
        """Features are given by way and offset to the left."""
        n = round(self.seconds * 50) + 1
        t = np.arange(n) / 50.0
        yaw = self.bend * self.speed * 3.0 * (1.0 - np.cos(t / 3.0)) + 0.4
        middle = 0.5 * (yaw[1:] + yaw[:-1])
        steps = self.speed / 50.0 * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        xy = np.cumsum(np.concatenate([[[3.0, -2.0]], steps]), axis=0)
        t_ns = T0_NS + (t * 1e9).round().astype(np.int64)
        pose = np.column_stack([xy, yaw])
        return Truth(t_ns, pose, self._beside(pose, t), tuple(_offset(pose, d) for d in (-5.25, -1.75, 1.75)))

    def _beside(self, pose: F64, t: F64) -> F64:
        at = np.stack([np.interp(self.features[:, 0] / self.speed, t, column) for column in pose.T], axis=1)
        return composed(at, np.column_stack([np.zeros(len(at)), self.features[:, 1], np.zeros(len(at))]))[:, :2]


def _offset(pose: F64, left_m: float) -> F64:
    """A lane beside the way, going on straight for 60 m at either end."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    line = pose[:, :2] + left_m * np.stack([-s, c], axis=1)
    more = np.arange(1.0, 61.0)[:, None]
    before = line[0] - more[::-1] * [c[0], s[0]]
    return np.concatenate([before, line, line[-1] + more * [c[-1], s[-1]]])


def drive(truth: Truth, noise: Noise, seed: int, look_hz: int = 5, reach_m: float = 45.0) -> FeatureDrive:
    rng = np.random.default_rng(seed)
    return FeatureDrive(
        motion(truth, noise, rng), fixes(truth, noise, rng), looks(truth, noise, rng, look_hz, reach_m),
        lane_looks(truth, noise, rng, look_hz),
    )  # fmt: skip


def motion(truth: Truth, noise: Noise, rng: np.random.Generator) -> MotionTrack:
    dt = np.diff(truth.t_ns) * 1e-9
    # Values at samples whose means over the intervals are exactly the motion in them.
    speed = _from_means(np.hypot(*np.diff(truth.pose[:, :2], axis=0).T) / dt)
    rate = _from_means(np.diff(truth.pose[:, 2]) / dt)
    speed = speed * (1.0 + noise.scale * rng.standard_normal()) + noise.wheel * rng.standard_normal(len(speed))
    rate = rate + noise.bias * rng.standard_normal() + noise.gyro * rng.standard_normal(len(rate))
    return MotionTrack(truth.t_ns, speed, rate)


def _from_means(means: F64) -> F64:
    values = np.empty(len(means) + 1)
    values[0] = 1.5 * means[0] - 0.5 * means[1]
    for n, mean in enumerate(means):
        values[n + 1] = 2.0 * mean - values[n]
    return values


def fixes(truth: Truth, noise: Noise, rng: np.random.Generator) -> GnssFixes:
    t_ns = truth.t_ns[::50]
    phi, error = np.exp(-1.0 / noise.tau_s), np.empty((len(t_ns), 2))
    error[0] = noise.gnss * rng.standard_normal(2)
    for n in range(1, len(t_ns)):
        error[n] = phi * error[n - 1] + noise.gnss * np.sqrt(1.0 - phi**2) * rng.standard_normal(2)
    return GnssFixes(t_ns, truth.pose[::50, :2] + error + noise.white * rng.standard_normal((len(t_ns), 2)))


def looks(
    truth: Truth, noise: Noise, rng: np.random.Generator, hz: int, reach_m: float, extra: F64 | None = None
) -> tuple[Detections, ...]:
    """`extra`: (E, 3) time [s], range, bearing of false alarms."""
    found = []
    own = np.zeros((len(truth.features), 2))  # what stays with each feature: share of its range, bearing
    if noise.held_share or noise.held_rad:
        own = rng.standard_normal(own.shape) * [noise.held_share, noise.held_rad]
    for t_ns in truth.t_ns[:: 50 // hz]:
        at = np.broadcast_to(truth.at(np.array([t_ns])), (len(truth.features), 3))
        seen = relative(at, np.column_stack([truth.features, np.zeros(len(at))]))[:, :2]
        reach = (np.hypot(*seen.T) < reach_m) & (rng.random(len(seen)) >= noise.miss)
        bearing, range_m = np.arctan2(seen[:, 1], seen[:, 0]) + own[:, 1], np.hypot(*seen.T) * (1.0 + own[:, 0])
        polar = np.column_stack([range_m, bearing])[reach]
        polar = polar + rng.standard_normal(polar.shape) * [noise.range_m, noise.bearing]
        if extra is not None:
            polar = np.concatenate([polar, extra[np.abs(extra[:, 0] - (t_ns - T0_NS) * 1e-9) < 1e-6, 1:]])
        found.append(look(int(t_ns), polar, noise))
    return tuple(found)


def look(t_ns: int, polar: F64, noise: Noise, kind: str = "streetlight") -> Detections:
    n = len(polar)
    return Detections(
        t_ns, "lidar", "streetlights", (kind,) * n, np.abs(polar[:, 0]).astype(np.float32),
        ((polar[:, 1] + np.pi) % (2 * np.pi) - np.pi).astype(np.float32), np.full(n, np.nan, np.float32),
        np.full(n, noise.range_m or 0.1, np.float32), np.full(n, noise.bearing or 0.005, np.float32),
    )  # fmt: skip


def lane_looks(truth: Truth, noise: Noise, rng: np.random.Generator, hz: int) -> tuple[LaneLook, ...]:
    found = []
    for t_ns in truth.t_ns[:: 50 // hz]:
        at = truth.at(np.array([t_ns]))
        lines = [_as_seen(at, lane, noise, rng) for lane in truth.lanes if rng.random() >= noise.miss]
        found.append(LaneLook(int(t_ns), tuple(lines), noise.lane_m or 0.05, noise.lane_rad or 0.002))
    return tuple(found)


def _as_seen(at: F64, lane: F64, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    flat = np.column_stack([lane, np.zeros(len(lane))])
    xy = relative(np.broadcast_to(at, flat.shape), flat)[:, :2]
    xy = xy[(xy[:, 0] > 4.0) & (xy[:, 0] < 45.0) & (np.abs(xy[:, 1]) < 20.0)][::5]
    turn = noise.lane_rad * rng.standard_normal()
    c, s = np.cos(turn), np.sin(turn)
    return (xy @ np.array([[c, s], [-s, c]]) + [0.0, noise.lane_m * rng.standard_normal()]).astype(np.float32)


def sensors(noise: Noise) -> DriveSensors:
    return DriveSensors(
        WheelsAndGyro(noise.scale or 1e-5, noise.wheel or 1e-3, noise.bias or 1e-6, noise.gyro or 1e-4, 1e-5, 0.0),
        GnssReceiver(noise.gnss or 0.01, noise.tau_s, noise.white or 0.01),
    )
