"""What moving cars and people have to know of the drive that they appear in."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Shape
from gnd.fleet_sim.trajectory import Motion
from gnd.fleet_sim.world import World

FloatArray = NDArray[np.float64]

STEP_S: Final = 0.02
"""Tracks are sampled this often."""
_LEAD_S: Final = 0.5
_EGO_MIDDLE_M: Final = 1.4
"""Middle of the vehicle that measures, ahead of its rear axle."""
_EYE_M: Final = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A drive as its traffic sees it.

    Attributes:
        world: the street.
        shapes: everything that stands on it, parked cars too.
        scene: the same, to find the ground.
        motion: how the vehicle that measures moves; its time 0 is the first scan.
        duration_s: how long.
        seed: of the drive.
    """

    world: World
    shapes: tuple[Shape, ...]
    scene: Scene
    motion: Motion
    duration_s: float
    seed: int

    def times_s(self) -> FloatArray:
        """Return when tracks are sampled, float64 (S,) [s]: every STEP_S, from before the first scan past the last."""
        return np.arange(-_LEAD_S, self.duration_s + _LEAD_S + STEP_S, STEP_S)

    def ego_m(self) -> tuple[FloatArray, FloatArray]:
        """Return street x and y of the middle of the vehicle that measures at those times, float64 (S,) each [m]."""
        x, y, _ = self.motion.on_path(self.times_s())
        return x + self.motion.direction * _EGO_MIDDLE_M, y

    def ground_m(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height of the ground under points (S,) of the street [m], found by rays down from 1 m."""
        eye = np.stack([x, y, _EYE_M + self.world.relief_m(x)], axis=1)
        down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
        drop, _ = self.scene.cast(self.world.map_of_street(eye), down, 5.0)
        return np.where(np.isfinite(drop), eye[:, 2] - drop, self.world.relief_m(x))
