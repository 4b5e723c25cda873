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
COVERED: Final = 0.8
"""Share of the columns of a strip of road from which on the map covers it ..."""
BARE: Final = 0.3
"""... and up to which the map has no road there. What lies between is a thin map: of few scans, or of few layers."""
AROUND_M: Final = 15.0
HELD: Final = 0.5
"""A road that returns nothing, such as wet asphalt, is on no map. So nothing is bare where the map holds this share of
the columns about the vehicle in which its scan finds something."""
LEAST_BARE_M: Final = 10.0
"""Way in one piece without a road on the map from which on a survey is worth its bytes."""
BACK_M: Final = 30.0
"""A survey ends once the map has covered the road for so long a way: its submaps there lie on the map."""
THIN_BACK_M: Final = 60.0
"""It ends, too, when nothing was bare for so long, on a map that is thin and never covers the road."""
VAIN_M: Final = 100.0
"""A survey that has not become worth its bytes on so long a way is given up."""
LOOK_EVERY_M: Final = 2.0
_STEP_M: Final = 1.0
_LEAST_POINTS: Final = 5
"""Of a scan in a column: a single one is no thing."""
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
        return self._share_of(self._columns(p.reshape(-1, 3) + p_map_m))

    def share_held(self, p_map_m: F64, seen_map_m: F64) -> float | None:
        """Share of the columns about a place in which points (N, 3) of a scan lie that hold a Gaussian; None: see
        `share`, or nothing is seen.
        """
        near = np.hypot(*(seen_map_m[:, :2] - p_map_m[:2]).T) < AROUND_M
        columns, points = np.unique(self._columns(seen_map_m[near]), axis=0, return_counts=True)
        seen = columns[points >= _LEAST_POINTS]
        return self._share_of(seen) if len(seen) else None

    def _columns(self, p_map_m: F64) -> NDArray[np.int64]:
        g = np.floor(self.local_map.grid_frame.grid_of(p_map_m)).astype(np.int64)
        return np.asarray(g[:, :2] - self.local_map.window_origin_g[:2])

    def _share_of(self, columns: NDArray[np.int64]) -> float | None:
        best = self._seen_from_above()
        inside = ((columns >= 0) & (columns < best.shape)).all(axis=1)
        found = best[columns[inside, 0], columns[inside, 1]]
        known = found >= EMPTY
        if known.sum() < _KNOWN * len(columns):
            return None
        return float((found[known] > EMPTY).mean())

    def _seen_from_above(self) -> NDArray[np.int32]:
        """(nx, ny): a Gaussian's row, `EMPTY`, or `UNKNOWN`."""
        if self._best is None or self._generation != self.local_map.generation:
            index = self.local_map.index
            self._best = index.max(axis=2) if index.size else np.empty((0, 0), np.int32)
            self._generation = self.local_map.generation
        return self._best


@dataclass(slots=True)
class WayOffTheMap:
    """What a survey has seen of the map under it, look by look.

    Attributes:
        looked_m: way of the last look.
        bare_m: way without a road on the map, in all.
        is_worth: such a way in one piece was long enough.
    """

    looked_m: float = 0.0
    bare_m: float = 0.0
    is_worth: bool = False
    _in_one_m: float = 0.0
    _covered_m: float = 0.0
    _since_bare_m: float = 0.0

    def is_due(self, way_m: float) -> bool:
        """Whether it is time to look again."""
        return way_m - self.looked_m >= LOOK_EVERY_M

    def look(self, way_m: float, share: float | None, held: float | None) -> None:
        """Take what the map has at `way_m` from the survey's begin: its share of the road, and of what is seen about
        it; None: not known.
        """
        step_m, self.looked_m = way_m - self.looked_m, way_m
        if share is None:
            return
        is_bare = share <= BARE and (held is None or held < HELD)
        self.bare_m += step_m if is_bare else 0.0
        self._in_one_m = self._in_one_m + step_m if is_bare else 0.0
        self._since_bare_m = 0.0 if is_bare else self._since_bare_m + step_m
        self._covered_m = self._covered_m + step_m if share >= COVERED else 0.0
        self.is_worth |= self._in_one_m >= LEAST_BARE_M

    @property
    def is_vain(self) -> bool:
        """Whether the survey is to be given up."""
        return not self.is_worth and self.looked_m >= VAIN_M

    @property
    def is_back(self) -> bool:
        """Whether the map has the road again."""
        return self._covered_m >= BACK_M or self._since_bare_m >= THIN_BACK_M
