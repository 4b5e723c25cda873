"""Spinning LiDARs after their data sheets, and one revolution of them through a scene.

The lidar frame is x forward, y left, z up. A revolution starts and ends behind the sensor and turns clockwise seen
from above, as Velodyne's do. Every shot leaves from where the moving sensor is at that instant, so that the points
carry the distortion of the true motion; coordinates are those of the lidar frame *at the shot's own time*, as real
drivers publish them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import radians, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_sim.errors import SceneError
from fleet_sim.raycast import FloatArray, IntArray, Scene, cast_sweep
from fleet_sim.shapes import reflectivity_of

_NS_PER_S: Final = 1_000_000_000
_POINT_STEP_M: Final = 1.0 / 512
"""Points are rounded to about 2 mm, the distance resolution of both sensors, which also halves the recordings."""


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A spinning LiDAR.

    Attributes:
        name: model name as written into recordings.
        elevations_rad: elevation of each beam in the order of firing, up positive.
        cycle_ns: time between two firings of the same beam.
        shot_ns: time between two beams.
        rate_hz: revolutions a second.
        range_min_m, range_max_m: nearer and farther returns are not given.
        range_sigma_m: standard deviation of the range.
        loss: probability that any return is lost.
        dark_m: range at which a surface of reflectivity 0.1, met head-on, is still always seen.
    """

    name: str
    elevations_rad: tuple[float, ...]
    cycle_ns: int
    shot_ns: int
    rate_hz: float = 10.0
    range_min_m: float = 1.0
    range_max_m: float = 100.0
    range_sigma_m: float = 0.03
    loss: float = 0.01
    dark_m: float = 100.0

    def __post_init__(self) -> None:
        if len(self.elevations_rad) * self.shot_ns > self.cycle_ns:
            raise SceneError(f"{self.name}: {len(self.elevations_rad)} shots do not fit into {self.cycle_ns} ns")

    @property
    def columns(self) -> int:
        """Firing cycles in a revolution."""
        return self.period_ns // self.cycle_ns

    @property
    def period_ns(self) -> int:
        """Time of a revolution [ns]."""
        return round(_NS_PER_S / self.rate_hz)

    @property
    def rings(self) -> NDArray[np.uint8]:
        """Rank of each beam from the lowest up, uint8 (beams,), in the order of firing."""
        return np.argsort(np.argsort(self.elevations_rad)).astype(np.uint8)

    def shot_times_ns(self) -> NDArray[np.int64]:
        """Return the time of each shot after the start of the revolution, int64 (columns, beams) [ns]."""
        columns, beams = np.arange(self.columns), np.arange(len(self.elevations_rad))
        return (columns[:, None] * self.cycle_ns + beams * self.shot_ns).astype(np.int64)

    def directions(self) -> FloatArray:
        """Return the unit direction of each shot, float64 (columns, beams, 3), lidar frame at the time of the shot."""
        azimuth = tau / 2 - tau * self.shot_times_ns() / self.period_ns
        elevation = np.array(self.elevations_rad)
        flat = np.cos(elevation)
        up = np.broadcast_to(np.sin(elevation), azimuth.shape)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)


def _interleaved(low_deg: float, step_deg: float, beams: int) -> tuple[float, ...]:
    """Velodyne's order of firing: lowest beam, middle beam, second lowest, second of the upper half, ..."""
    angles = [low_deg + step_deg * i for i in range(beams)]
    pairs = zip(angles[: beams // 2], angles[beams // 2 :], strict=True)
    return tuple(radians(angle) for pair in pairs for angle in pair)


# VLP-16 user manual 63-9243: 16 beams, ±15° by 2°, 55.296 µs a cycle, 2.304 µs a shot, ±3 cm, 100 m.
VLP16: Final = LidarModel(
    name="VLP-16", elevations_rad=_interleaved(-15.0, 2.0, 16), cycle_ns=55_296, shot_ns=2_304, range_sigma_m=0.03
)
# HDL-32E user manual 63-9113: 32 beams, +10.67° … -30.67° by 1.33°, 46.08 µs a cycle, 1.152 µs a shot, ±2 cm, 100 m.
HDL32E: Final = LidarModel(
    name="HDL-32E", elevations_rad=_interleaved(-92 / 3, 4 / 3, 32), cycle_ns=46_080, shot_ns=1_152, range_sigma_m=0.02
)
MODELS: Final = {model.name: model for model in (VLP16, HDL32E)}


@dataclass(frozen=True, slots=True)
class Sweep:
    """The returns of one revolution in the order of firing.

    Attributes:
        points_lidar_m: float32 (N, 3), lidar frame at each point's own time.
        t_offset_ns: uint32 (N,), time after the start of the revolution.
        ring: uint8 (N,), beam from the lowest up.
    """

    points_lidar_m: NDArray[np.float32]
    t_offset_ns: NDArray[np.uint32]
    ring: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Hits:
    """What the shots of a revolution met, before noise and loss.

    Attributes:
        range_m: float64 (columns, beams), inf where nothing was met.
        primitive: int32 (columns, beams), index into the scene, -1 where nothing was met.
        incidence: float64 (columns, beams), cosine between shot and surface normal.
    """

    range_m: FloatArray
    primitive: IntArray
    incidence: FloatArray


class Lidar:
    """A LiDAR model with its firing table computed once."""

    def __init__(self, model: LidarModel) -> None:
        self.model = model
        self._directions = model.directions()
        self._times = model.shot_times_ns()
        self._rings = np.broadcast_to(model.rings, self._times.shape)

    def hits(self, scene: Scene, T_map_lidar: FloatArray) -> Hits:
        """Cast the shots of one revolution.

        Args:
            scene: what stands there.
            T_map_lidar: float64 (columns + 1, 4, 4), true poses at the start of each firing cycle, and of the next
                revolution.

        Raises:
            SceneError: wrong number of poses, or the sensor is outside the scene.
        """
        expected = (self.model.columns + 1, 4, 4)
        if T_map_lidar.shape != expected:
            raise SceneError(f"{self.model.name} needs poses {expected}, got {T_map_lidar.shape}")
        T_street_lidar = scene.A_street_map @ T_map_lidar[:, 0:3, :]
        scene.check_inside(T_street_lidar[:, :, 3])
        share = self.model.shot_ns / self.model.cycle_ns
        poses = np.ascontiguousarray(T_street_lidar, dtype=np.float64)
        return Hits(*cast_sweep(poses, self._directions, share, self.model.range_max_m, *scene.arrays()))

    def sweep(self, scene: Scene, T_map_lidar: FloatArray, rng: np.random.Generator) -> Sweep:
        """Take one revolution with range noise and lost returns; arguments and errors as `hits`."""
        hits = self.hits(scene, T_map_lidar)
        noisy = hits.range_m + self.model.range_sigma_m * rng.standard_normal(hits.range_m.shape)
        seen = self._seen(scene, hits, rng) & (noisy >= self.model.range_min_m) & (noisy <= self.model.range_max_m)
        points = self._directions[seen] * noisy[seen][:, None]
        points = np.round(points / _POINT_STEP_M) * _POINT_STEP_M
        return Sweep(points.astype(np.float32), self._times[seen].astype(np.uint32), self._rings[seen])

    def _seen(self, scene: Scene, hits: Hits, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Draw which returns come back.

        The echo falls with reflectivity x cos(incidence) / range² (Lambert); it fades over ±10 % of the limit.
        """
        bright = reflectivity_of(scene.packed, hits.primitive) * hits.incidence
        limit = self.model.dark_m * np.sqrt(bright / 0.1)
        chance = np.clip((1.1 * limit - hits.range_m) / (0.2 * limit + 1e-9), 0.0, 1.0) * (1.0 - self.model.loss)
        return np.asarray((hits.primitive >= 0) & (rng.random(hits.range_m.shape) < chance))


def column_poses(model: LidarModel, t_start_s: float, pose_at: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return what `Lidar.hits` needs, from a function of time (K,) [s] to true poses T_map_lidar (K, 4, 4)."""
    firing = np.arange(model.columns + 1, dtype=np.float64)
    return pose_at(t_start_s + firing * (model.cycle_ns / _NS_PER_S))
