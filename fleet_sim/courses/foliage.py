"""Leaves that let rays through: crowns and hedges in which a ray meets a leaf with a probability a metre.

Such a thing has no surface. Where its points lie changes from scan to scan, and some rays pass to what stands behind.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from math import isfinite, sin
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.ray_kernels import BLOCK_COLUMNS, FloatArray, IntArray, cast_leaves
from gnd.fleet_sim.shapes import Ball, pack

_LEAF: Final = 0.45
_WIDE_RAD: Final = 0.5


@dataclass(frozen=True, slots=True)
class Leaves:
    """A porous volume in the street frame.

    Attributes:
        x_m, y_m, z_m: its middle.
        half_x_m, half_y_m, half_z_m: half axes of the ellipsoid, half edges of the box.
        per_m: leaves that a ray meets on a metre of way, on the average: exp(-per_m * d) of the rays pass d metres.
        box: an upright box (hedge) instead of an ellipsoid (crown).
    """

    x_m: float
    y_m: float
    z_m: float
    half_x_m: float
    half_y_m: float
    half_z_m: float
    per_m: float
    box: bool = False

    def __post_init__(self) -> None:
        if not all(isfinite(value) for value in astuple(self)):
            raise DriveSimError(f"{self}: every number must be finite")
        if min(self.half_x_m, self.half_y_m, self.half_z_m, self.per_m) <= 0.0:
            raise DriveSimError(f"{self}: sizes and leaves a metre must be positive")


class Foliage:
    """All leaves of a course, ready for sweeps.

    Attributes:
        packed: float64 (V, 13), a stand-in for each volume, which carries the leaves' reflectivity.
    """

    def __init__(self, leaves: Sequence[Leaves], seed: int) -> None:
        """Take at least one volume; `seed` decides which leaf each shot meets.

        Raises:
            DriveSimError: there is none.
        """
        if not leaves:
            raise DriveSimError("foliage needs at least one volume, got none")
        self._volumes = np.array([astuple(one) for one in leaves], dtype=np.float64)
        self._seed = seed
        self.packed = pack([Ball(one.x_m, one.y_m, one.z_m, one.half_x_m, _LEAF) for one in leaves])

    def meet(
        self,
        shots: tuple[FloatArray, FloatArray, FloatArray],
        range_m: float,
        timing: tuple[float, float],
        base: int,
        hits: tuple[FloatArray, IntArray, FloatArray],
    ) -> None:
        """Let the shots of a sweep meet leaves: `hits` change where one is met before what was met so far.

        Args:
            shots: poses (columns + 1, 3, 4), directions (columns, beams, 3), shares (beams,), as to `cast_sweep`.
            range_m: hits beyond it are misses.
            timing: time of the sweep [s], which makes its leaves others than those of the next; turn in a cycle [rad].
            base: number of the first volume among the primitives.
            hits: what was met so far.
        """
        t_s, turn_rad = timing
        poses, directions, _ = shots
        lean = float(np.linalg.norm(poses[:, 0:2, 2], axis=1).max())
        up = float(np.abs(directions[0, :, 2]).max())
        leaning = 2.0 * lean * up / max((1.0 - up * up) ** 0.5, 1e-3)
        wide, narrow = (_sine(columns * turn_rad + leaning) for columns in (BLOCK_COLUMNS, 1))
        seed = np.random.SeedSequence([self._seed, round(t_s * 1e6) % 2**48]).generate_state(1, np.uint64)[0]
        cast_leaves(*shots, range_m, self._volumes, (wide, narrow), base, seed, *hits)


def _sine(fan_rad: float) -> float:
    return sin(fan_rad) if fan_rad < _WIDE_RAD else 1.0


def crown(x: float, y: float, base: float, rng: np.random.Generator, per_m: float) -> Leaves:
    """Return the crown of a tree that stands at a place on ground of height `base`."""
    wide, high = rng.uniform(1.6, 2.6), rng.uniform(1.4, 2.2)
    return Leaves(x, y, base + rng.uniform(4.2, 5.0), wide, wide, high, per_m)


def hedge(x0: float, x1: float, y: float, base: float, rng: np.random.Generator, per_m: float) -> Leaves:
    """Return a hedge along the street."""
    half_z, half_y = rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.6)
    return Leaves(0.5 * (x0 + x1), y, base + half_z, 0.5 * abs(x1 - x0), half_y, half_z, per_m, box=True)
