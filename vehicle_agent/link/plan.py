"""The download plan: which tiles the vehicle will need, when, and which of them the link can bring in time.

The vehicle is taken to drive straight on at its speed. A tile is needed from when it is near until it is left behind;
what is needed soonest comes first, and what would arrive only after it was left behind is not asked for at all.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId, deinterleave, geodetic_of_tile_coordinates

SLOWEST_MPS = 3.0
"""A vehicle that stands may start: what is ahead keeps its order."""
SMALLEST_BATCH_BYTES, LARGEST_BATCH_BYTES = 4_096, 131_072


@dataclass(frozen=True, slots=True)
class VehicleCourse:
    """Where the vehicle is and where it goes, horizontally in the map frame."""

    x_m: float
    y_m: float
    heading_rad: float | None
    """Direction of motion from the x axis (east) to the y axis; None = not known."""
    speed_mps: float
    """0 or more."""

    @property
    def here_m(self) -> F64:
        """Position (2,)."""
        return np.array([self.x_m, self.y_m])

    @property
    def velocity_mps(self) -> F64:
        """(2,), at least `SLOWEST_MPS` fast; zeros where the heading is not known."""
        if self.heading_rad is None:
            return np.zeros(2)
        direction = np.array([math.cos(self.heading_rad), math.sin(self.heading_rad)])
        return max(self.speed_mps, SLOWEST_MPS) * direction

    @property
    def patience(self) -> float:
        """By what a slower vehicle than `velocity_mps` says stays longer; infinite where it stands."""
        return max(SLOWEST_MPS / self.speed_mps, 1.0) if self.speed_mps > 0 else math.inf


@dataclass(frozen=True, slots=True, order=True)
class Need:
    """When one tile is needed; sorted by that."""

    from_s: float
    """0 = now."""
    distance_m: float
    """From the vehicle, now."""
    tile_id: TileId
    until_s: float
    """When it is left behind; infinite where nobody knows."""


def needs(frame: LocalFrame, tiles: Sequence[TileId], course: VehicleCourse, near_m: float) -> list[Need]:
    """When the vehicle comes within `near_m` of each tile and leaves it, soonest first.

    Near is measured to the tile's edges, each by itself: at its corners a tile is near up to 1.4 times as far.
    """
    low_m, high_m = tile_boxes_m(frame, tiles)
    away_m = np.hypot(*np.maximum(0.0, np.maximum(low_m - course.here_m, course.here_m - high_m)).T)
    from_s, until_s = _crossing_s(low_m - near_m - course.here_m, high_m + near_m - course.here_m, course.velocity_mps)
    columns = zip(from_s.tolist(), away_m.tolist(), tiles, (until_s * course.patience).tolist(), strict=True)
    return sorted(Need(*one) for one in columns)


def tile_boxes_m(frame: LocalFrame, tiles: Sequence[TileId]) -> tuple[F64, F64]:
    """South-west and north-east corners (N, 2) of tiles in a frame of at most a few kilometres, to about 1 cm."""
    east, north = deinterleave(np.array([tile.morton for tile in tiles], np.int64))
    steps = np.array([0.0, 1.0])  # to the south-west corner, and to the north-east one
    lat, lon = geodetic_of_tile_coordinates(east[:, None] + steps, north[:, None] + steps)
    enu = frame.enu_from_geodetic(lat.ravel(), lon.ravel(), np.zeros(2 * len(tiles)))
    ends = np.asarray(enu)[:, :2].reshape(-1, 2, 2)
    return ends[:, 0], ends[:, 1]


def _crossing_s(low_m: F64, high_m: F64, velocity_mps: F64) -> tuple[F64, F64]:
    """When a point that starts at the origin is inside each box (N, 2): from (N,) >= 0, until (N,); inf = never."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        a, b = low_m / velocity_mps, high_m / velocity_mps
    beside = velocity_mps == 0.0  # along this axis the point stays: inside for ever or never
    inside = (low_m <= 0.0) & (high_m >= 0.0)
    enter = np.where(beside, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=1)
    leave = np.where(beside, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=1)
    never = (enter > leave) | (leave <= 0.0)
    return np.where(never, np.inf, np.maximum(enter, 0.0)), np.where(never, np.inf, leave)


def in_time(
    planned: Iterable[Need], size_bytes: Callable[[TileId], float], rate_byte_s: float, delay_s: float
) -> list[Need]:
    """Those that a link of that rate brings, one after the other, before they are left behind."""
    kept, arrival_s = [], 2.0 * delay_s
    for need in planned:
        sent_s = size_bytes(need.tile_id) / rate_byte_s
        if arrival_s + sent_s <= need.until_s:
            arrival_s += sent_s
            kept.append(need)
    return kept


def batch_bytes(rate_byte_s: float, batch_s: float) -> int:
    """How much one answer may hold: what the link carries in `batch_s`, so that a more urgent one waits no longer."""
    return int(min(max(rate_byte_s * batch_s, SMALLEST_BATCH_BYTES), LARGEST_BATCH_BYTES))
