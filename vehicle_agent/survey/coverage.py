"""Where the map has a road: columns with a Gaussian, along a strip in the direction of driving."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.local_map import EMPTY, LocalMap

HALF_WIDTH_M: Final = 2.0
HERE_M: Final = (-3.0, 5.0)
AHEAD_M: Final = (5.0, 30.0)
"""Stretches of the strip, from the vehicle, along its heading."""
_STEP_M: Final = 1.0
_KNOWN: Final = 0.8
"""So many columns of a stretch must belong to tiles of which it is known whether the map has them."""


@dataclass(slots=True)
class RoadCoverage:
    """Looks at the local map from above; looks anew when its tiles have changed."""

    local_map: LocalMap
    _generation: int = -1
    _best: NDArray[np.int32] | None = None

    def share(self, p_map_m: F64, heading_rad: float, stretch_m: tuple[float, float]) -> float | None:
        """Share of the columns of a stretch that hold a Gaussian; None where the tiles are not here yet."""
        along, across = np.meshgrid(
            np.arange(stretch_m[0], stretch_m[1] + _STEP_M / 2, _STEP_M),
            np.arange(-HALF_WIDTH_M, HALF_WIDTH_M + _STEP_M / 2, _STEP_M),
        )
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        p = np.stack([cos * along - sin * across, sin * along + cos * across, np.zeros_like(along)], axis=-1)
        best = self._seen_from_above()
        g = np.floor(self.local_map.grid_frame.grid_of(p.reshape(-1, 3) + p_map_m)).astype(np.int64)
        at = g[:, :2] - self.local_map.window_origin_g[:2]
        inside = ((at >= 0) & (at < best.shape)).all(axis=1)
        found = best[at[inside, 0], at[inside, 1]]
        known = found >= EMPTY
        if known.sum() < _KNOWN * len(at):
            return None
        return float((found[known] > EMPTY).mean())

    def _seen_from_above(self) -> NDArray[np.int32]:
        """(nx, ny): a Gaussian's row, `EMPTY`, or `UNKNOWN`."""
        if self._best is None or self._generation != self.local_map.generation:
            index = self.local_map.index
            self._best = index.max(axis=2) if index.size else np.empty((0, 0), np.int32)
            self._generation = self.local_map.generation
        return self._best
