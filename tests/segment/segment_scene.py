"""A street in plain numpy: ground, house fronts, a parked car, and boxes that move; scans of it with labels."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays

START_NS = 1_570_838_400_000_000_000
HOUSES = ((-60.0, 9.0, 120.0, 10.0, 9.0), (-60.0, -10.0, 45.0, -9.0, 9.0), (-8.0, -10.0, 120.0, -9.0, 6.0))
PARKED = (8.0, 5.2, 12.4, 7.0, 1.5)
POLE = (6.0, -6.1, 6.2, -5.9, 5.0)


@dataclass(frozen=True)
class Sensor:
    """Elevations in degrees, shots a turn, height over the road, field of view ahead."""

    elevations: np.ndarray
    shots: int = 900
    height_m: float = 1.9
    view_deg: float = 360.0
    rate_hz: float = 10.0


SENSORS = {
    "16 layers": Sensor(np.arange(-15.0, 16.0, 2.0)),
    "32 layers": Sensor(np.linspace(-30.0, 10.0, 32)),
    "4 layers ahead": Sensor(np.array([-1.2, -0.4, 0.4, 1.2]), shots=1440, height_m=0.6, view_deg=145.0, rate_hz=25.0),
}


@dataclass(frozen=True)
class Mover:
    """A box: length, width and height, centre at time t; it floats 0.2 m over the ground."""

    size_m: tuple[float, float, float]
    at: Callable[[float], tuple[float, float]]

    def box(self, t_s: float) -> tuple[float, float, float, float, float]:
        """x0, y0, x1, y1, top at a time."""
        (x, y), (length, width, height) = self.at(t_s), self.size_m
        return x - length / 2, y - width / 2, x + length / 2, y + width / 2, height


def meet(o: np.ndarray, d: np.ndarray, box: tuple[float, ...], bottom: float) -> np.ndarray:
    """Range at which rays enter a box, inf where they do not."""
    low, high = np.array([box[0], box[1], bottom]), np.array([box[2], box[3], box[4]])
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - o) / d, (high - o) / d
    enter, leave = np.nanmax(np.minimum(a, b), axis=1), np.nanmin(np.maximum(a, b), axis=1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def scans(
    sensor: Sensor,
    movers: tuple[Mover, ...],
    seconds: float = 3.0,
    speed_mps: float = 6.0,
    noise: tuple[float, float] = (0.0, 0.0),
) -> Iterator[tuple[RefinedScan, np.ndarray]]:
    """Scans along the street with their true labels; `noise`: standard deviations of the poses, m and degrees."""
    rng = np.random.default_rng(5)
    for k in range(int(seconds * sensor.rate_hz)):
        yield sweep(sensor, movers, k, speed_mps, noise, rng)


def sweep(
    sensor: Sensor, movers: tuple[Mover, ...], k: int, speed_mps: float, noise: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[RefinedScan, np.ndarray]:  # fmt: skip
    """One turn: each shot from where the sensor is at that instant, 2 cm of range noise."""
    part = np.arange(sensor.shots) / sensor.shots
    azimuth = np.pi - 2 * np.pi * part
    ahead = np.abs(azimuth) <= np.radians(sensor.view_deg / 2)
    azimuth, t_s = azimuth[ahead], (k + part[ahead]) / sensor.rate_hz
    elevation = np.radians(sensor.elevations)
    flat = np.cos(elevation)[None, :, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)[:, None]
    up = np.broadcast_to(np.sin(elevation)[None, :, None], (*flat.shape[:2], 1))
    d = np.concatenate([flat, up], axis=2).reshape(-1, 3)
    o = np.zeros((len(azimuth), len(elevation), 3))
    o[..., 0], o[..., 2] = (speed_mps * t_s)[:, None], sensor.height_m
    o, middle_s = o.reshape(-1, 3), (k + 0.5) / sensor.rate_hz
    with np.errstate(divide="ignore"):
        standing = np.where(d[:, 2] < 0, -o[:, 2] / d[:, 2], np.inf)
    for box in (*HOUSES, PARKED, POLE):
        standing = np.minimum(standing, meet(o, d, box, -0.1))
    moving = np.full(len(d), np.inf)
    for mover in movers:
        moving = np.minimum(moving, meet(o, d, mover.box(middle_s), 0.2))
    r, label = np.minimum(standing, moving), moving < standing
    seen = r < 80.0
    o, d, r = o[seen], d[seen], r[seen]
    points = o + d * (r + rng.normal(0, 0.02, len(r)))[:, None]
    E = np.eye(4)
    E[:3, :3] = exp_so3(np.radians(noise[1]) * rng.standard_normal(3))
    E[:3, 3] = noise[0] * rng.standard_normal(3)
    T = np.eye(4)
    T[0, 3] = speed_mps * middle_s
    turned = T @ E @ np.linalg.inv(T)
    points, o = (p @ turned[:3, :3].T + turned[:3, 3] for p in (points, o))
    t_ns = START_NS + int(middle_s * 1e9)
    estimate = PoseEstimate(t_ns, turned @ T, 0.02, 0.001, 0.9, "good")
    return RefinedScan(t_ns, PlacedRays(points, o), estimate), label[seen]
