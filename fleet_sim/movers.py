"""Things that move while the LiDAR turns: where each is at any instant, and what a sweep sees of them.

A mover is a handful of primitives in a frame of its own (x ahead, y left, z up from the ground under it) that follows a
track: samples of place, heading and stride, straight in between. Each shot of a sweep meets it where it is at that
instant. Movers are no part of a world or of its truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.ray_kernels import BLOCK_COLUMNS, Crowd, FloatArray, IntArray, cast_crowd
from gnd.fleet_sim.shapes import Ball, Shape, pack

STATE: Final = 5
"""A sample of a track: x, y, z [m], yaw [rad], stride [m]."""
STILL_MPS: Final = 0.1
"""A mover slower than this stands."""
_WIDE_RAD: Final = 0.5
"""A column whose shots fan out farther is tried against every mover."""


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """A car or a person.

    Attributes:
        shapes: primitives in its own frame.
        swing: of each primitive, how much of the stride it is shifted ahead (legs and arms; 0 for the rest).
        track: float64 (S, 5): x, y, z [m], yaw [rad, not wrapped], stride [m] in the street frame.
    """

    shapes: tuple[Shape, ...]
    swing: tuple[float, ...]
    track: FloatArray

    def __post_init__(self) -> None:
        if not self.shapes or len(self.swing) != len(self.shapes):
            raise DriveSimError(f"a mover of {len(self.shapes)} primitives has {len(self.swing)} swings")
        if self.track.ndim != 2 or self.track.shape[1] != STATE or len(self.track) < 2:
            raise DriveSimError(f"a track must be (at least 2, {STATE}), got {self.track.shape}")
        if not np.isfinite(self.track).all():
            raise DriveSimError(f"a track must be finite, {int((~np.isfinite(self.track)).sum())} numbers are not")

    def ball(self) -> tuple[float, float]:
        """Return height of the middle and radius of a ball around it that holds every stride [m]."""
        bounds = np.array([shape.bounds() for shape in self.shapes])
        bottom = min(_bottom_m(shape) for shape in self.shapes)
        middle, half = 0.5 * (bottom + bounds[:, 4].max()), 0.5 * (bounds[:, 4].max() - bottom)
        ahead = np.abs(bounds[:, [0, 2]]).max() + np.abs(self.swing).max() * np.abs(self.track[:, 4]).max()
        return float(middle), float(np.sqrt(ahead**2 + np.abs(bounds[:, [1, 3]]).max() ** 2 + half**2))


def _bottom_m(shape: Shape) -> float:
    return shape.z_m - shape.radius_m if isinstance(shape, Ball) else shape.bottom_m


class Movers:
    """All movers of a drive.

    Attributes:
        movers: as given.
        t0_s, step_s: time of the first sample of every track, time between samples.
        packed: float64 (P, 13), primitives of all movers one after the other, as `shapes.pack` lays them out.
    """

    def __init__(self, movers: Sequence[Mover], t0_s: float, step_s: float, reach_m: float) -> None:
        """Take movers whose tracks have the same number of samples, `step_s` apart from `t0_s` on.

        Args:
            movers: at least one.
            t0_s: time of the first sample.
            step_s: time from sample to sample.
            reach_m: movers farther than this from the street's middle, along the street, are not there.

        Raises:
            DriveSimError: no movers, or tracks of different lengths.
        """
        lengths = {len(mover.track) for mover in movers}
        if len(lengths) != 1 or step_s <= 0:
            raise DriveSimError(f"tracks must be of one length and step, got {sorted(lengths)} samples by {step_s} s")
        self.movers, self.t0_s, self.step_s = tuple(movers), t0_s, step_s
        self.packed = pack([shape for mover in movers for shape in mover.shapes])
        first = np.array([0, *accumulate(len(mover.shapes) for mover in movers)], dtype=np.int32)
        tracks = np.ascontiguousarray(np.stack([mover.track for mover in movers]), dtype=np.float64)
        balls = np.array([mover.ball() for mover in movers])
        swing = np.array([s for mover in movers for s in mover.swing])
        centre, radius = balls.T.copy()
        self._owner = np.repeat(np.arange(len(movers)), np.diff(first))
        self._crowd = Crowd(tracks, t0_s, step_s, self.packed.reshape(-1), swing, first, centre, radius, reach_m)

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return all states, float64 (M, K, 5), at times (K,) [s]; the plain twin of `ray_kernels.state_at`."""
        tracks, last = self._crowd.tracks, self._crowd.tracks.shape[1] - 1
        samples = self.t0_s + self.step_s * np.arange(last + 1)
        within = np.clip(t_s, samples[0], samples[-1])
        k = np.clip(np.searchsorted(samples, within, side="right") - 1, 0, last - 1)
        slope = (tracks[:, k + 1] - tracks[:, k]) / (samples[k + 1] - samples[k])[:, None]
        between = slope * (within - samples[k])[:, None] + tracks[:, k]
        return np.asarray(np.where((within == samples[-1])[:, None], tracks[:, -1:], between))

    def under_way(self, t_s: float) -> NDArray[np.bool_]:
        """Return which primitives belong to a mover that moves at an instant, bool (P,)."""
        step = self.at(np.array([t_s - self.step_s, t_s + self.step_s]))
        speed = np.linalg.norm(step[:, 1, :2] - step[:, 0, :2], axis=1) / (2 * self.step_s)
        return np.asarray((speed > STILL_MPS)[self._owner])

    def meet(
        self,
        shots: tuple[FloatArray, FloatArray, FloatArray],
        range_m: float,
        timing: tuple[float, float, float],
        base: int,
        hits: tuple[FloatArray, IntArray, FloatArray],
    ) -> None:
        """Let the shots of a sweep meet the movers: `hits` change where one stands before what was met so far.

        Args:
            shots: poses (columns + 1, 3, 4), directions (columns, beams, 3), shares (beams,), as to `cast_sweep`.
            range_m: hits beyond it are misses.
            timing: time of the first firing cycle [s], time of a cycle [s], turn of the sensor in a cycle [rad].
            base: number of the first of the movers' primitives.
            hits: what `cast_sweep` gave.
        """
        poses, directions, shares = shots
        t_start, cycle_s, turn_rad = timing
        leaning = _leaning_fan_rad(poses, directions)
        spreads = (_sine(BLOCK_COLUMNS * turn_rad + leaning), _sine(turn_rad + leaning))
        cast_crowd(poses, directions, shares, range_m, self._crowd, (t_start, cycle_s), spreads, base, *hits)


def _sine(fan_rad: float) -> float:
    return sin(fan_rad) if fan_rad < _WIDE_RAD else 1.0


def _leaning_fan_rad(poses: FloatArray, directions: FloatArray) -> float:
    """Bound of the azimuth by which a sensor that leans spreads shots of one azimuth but different elevations."""
    lean = float(np.linalg.norm(poses[:, 0:2, 2], axis=1).max())
    up = float(np.abs(directions[0, :, 2]).max())
    return 2.0 * lean * up / max(sqrt(1.0 - up * up), 1e-3)
