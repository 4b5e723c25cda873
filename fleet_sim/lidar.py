"""One sweep of a LiDAR through a scene.

Every shot leaves from where the moving sensor is at that instant, so that the points carry the distortion of the true
motion; coordinates are those of the lidar frame *at the shot's own time*, as real drivers publish them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.courses.foliage import Foliage
from gnd.fleet_sim.errors import SceneError
from gnd.fleet_sim.movers import Movers
from gnd.fleet_sim.ray_kernels import FloatArray, IntArray, cast_sweep
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.return_kernels import ReturnRules, fill_returns
from gnd.fleet_sim.sensing import Disturbance, SweepShots
from gnd.fleet_sim.sensors import LidarModel
from gnd.fleet_sim.shapes import REFLECTIVITY

_NS_PER_S: Final = 1_000_000_000
_POINT_STEP_M: Final = 1.0 / 512
"""Points are rounded to about 2 mm, the distance resolution of Velodyne's sensors, which also halves the recordings."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """The returns of one sweep in the order of firing.

    Attributes:
        points_lidar_m: float32 (N, 3), lidar frame at each point's own time.
        t_offset_ns: uint32 (N,), time after the start of the sweep.
        ring: uint8 (N,), beam from the lowest up.
        primitive: int32 (N,), what each point lies on, for evaluation: index into the scene, the movers' after that,
            then the foliage's volumes.
    """

    points_lidar_m: NDArray[np.float32]
    t_offset_ns: NDArray[np.uint32]
    ring: NDArray[np.uint8]
    primitive: IntArray


@dataclass(frozen=True, slots=True)
class Hits:
    """What the shots of a sweep met, before noise and loss.

    Attributes:
        range_m: float64 (columns, beams), inf where nothing was met.
        primitive: int32 (columns, beams), index into the scene, the movers' after that, -1 where nothing was met.
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
        self._shares = model.shares
        self._times = model.shot_times_ns().astype(np.uint32)
        self._rings = np.ascontiguousarray(np.broadcast_to(model.rings, self._times.shape))

    def hits(
        self,
        scene: Scene,
        T_map_lidar: FloatArray,
        movers: Movers | None = None,
        t_s: float = 0.0,
        foliage: Foliage | None = None,
    ) -> Hits:
        """Cast the shots of one sweep.

        Args:
            scene: what stands there.
            T_map_lidar: float64 (columns + 1, 4, 4), true poses at the start of each firing cycle, and at the
                end of the last.
            movers: what moves there.
            t_s: time of the first firing cycle in the movers' time [s].
            foliage: leaves that let rays through; their volumes count after the movers' primitives.

        Raises:
            SceneError: wrong number of poses, or the sensor is outside the scene.
        """
        expected = (self.model.columns + 1, 4, 4)
        if T_map_lidar.shape != expected:
            raise SceneError(f"{self.model.name} needs poses {expected}, got {T_map_lidar.shape}")
        T_street_lidar = scene.A_street_map @ T_map_lidar[:, 0:3, :]
        scene.check_inside(T_street_lidar[:, :, 3])
        poses = np.ascontiguousarray(T_street_lidar, dtype=np.float64)
        shape = self._times.shape
        met = np.empty(shape), np.empty(shape, np.int32), np.empty(shape)
        cast_sweep(poses, self._directions, self._shares, self.model.range_max_m, *scene.arrays(), *met)
        shots, cycle_s = (poses, self._directions, self._shares), self.model.cycle_ns / _NS_PER_S
        turn_rad, base = tau * cycle_s * self.model.rate_hz, len(scene.packed)
        if movers is not None:
            movers.meet(shots, self.model.range_max_m, (t_s, cycle_s, turn_rad), base, met)
            base += len(movers.packed)
        if foliage is not None:
            foliage.meet(shots, self.model.range_max_m, (t_s, turn_rad), base, met)
        return Hits(*met)

    def sweep(
        self,
        scene: Scene,
        T_map_lidar: FloatArray,
        rng: np.random.Generator,
        movers: Movers | None = None,
        t_s: float = 0.0,
        foliage: Foliage | None = None,
        disturbance: Disturbance | None = None,
    ) -> Sweep:
        """Take one sweep with range noise and lost returns; arguments and errors as `hits`.

        `disturbance`: what glass, weather and the width of the beams do.
        """
        hits = self.hits(scene, T_map_lidar, movers, t_s, foliage)
        packed = np.concatenate([part.packed for part in (scene, movers, foliage) if part is not None])
        if disturbance is not None:
            poses = np.ascontiguousarray(scene.A_street_map @ T_map_lidar[:, 0:3, :], dtype=np.float64)
            shots = SweepShots(poses, self._directions, self._shares, self.model.range_max_m)
            disturbance.disturb(scene, packed, shots, t_s, (hits.range_m, hits.primitive, hits.incidence))
        drawn = rng.standard_normal(hits.range_m.shape), rng.random(hits.range_m.shape)
        return self._returns(hits, drawn, packed[:, REFLECTIVITY].copy())

    def _returns(self, hits: Hits, drawn: tuple[FloatArray, FloatArray], reflectivity: FloatArray) -> Sweep:
        """What comes back, with noise and loss as they are drawn (columns, beams)."""
        m, shots = self.model, hits.range_m.size
        rules = ReturnRules(
            m.range_sigma_m, m.range_min_m, m.range_max_m, m.dark_m, 1.0 - m.loss, m.range_step_m, _POINT_STEP_M
        )
        points, t_offset_ns = np.empty((shots, 3), np.float32), np.empty(shots, np.uint32)
        ring, primitive = np.empty(shots, np.uint8), np.empty(shots, np.int32)
        met, table = (hits.range_m, hits.primitive, hits.incidence), (self._directions, self._times, self._rings)
        n = fill_returns(met, drawn, reflectivity, table, rules, points, t_offset_ns, ring, primitive)
        return Sweep(points[:n], t_offset_ns[:n], ring[:n], primitive[:n])


def column_poses(model: LidarModel, t_start_s: float, pose_at: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return what `Lidar.hits` needs, from a function of time (K,) [s] to true poses T_map_lidar (K, 4, 4)."""
    firing = np.arange(model.columns + 1, dtype=np.float64)
    return pose_at(t_start_s + firing * (model.cycle_ns / _NS_PER_S))
