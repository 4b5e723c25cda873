"""Windows along the way of a drive: the frame of each, and the piece of the grid that its middle answers to."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.features.lane_pieces import LanePiece, lane_pieces
from gnd.gnd_map.geodesy import LocalFrame
from gnd.vehicle_agent.features.lanes.fitting import HALF_WINDOW_M

_STEP_M: Final = 1.0
_FIT_M: Final = 12.0
_SIDE_M: Final = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class LaneWindow:
    """A stretch of the way.

    Attributes:
        cell: of the way's own piece, see `LanePiece.cell`.
        along_m: of its middle, metres since the drive began.
        origin_m: (3,) map frame.
        heading_rad: counter-clockwise from the map frame's x axis.
        bend_per_m: the way itself is d = bend s².
        rise: of the way, metres a metre.
    """

    cell: tuple[int, int]
    along_m: float
    origin_m: F64
    heading_rad: float
    bend_per_m: float
    rise: float

    def own(self, xy_m: F64) -> tuple[F64, F64]:
        """(N,) ahead and (N,) to the left, the way's bend taken out, of points (N, 2 or 3) of the map frame."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        x, y = (xy_m[:, :2] - self.origin_m[:2]).T
        ahead, left = c * x + s * y, c * y - s * x
        return ahead, left - self.bend_per_m * ahead**2

    def rows(self, xy_m: F64) -> tuple[I64, F64, F64]:
        """Rows of the points in the window, and their ahead and left."""
        ahead, left = self.own(xy_m)
        rows = np.flatnonzero((np.abs(ahead) < HALF_WINDOW_M) & (np.abs(left) < _SIDE_M))
        return rows, ahead[rows], left[rows]

    def line_in_map(self, ahead_m: F64, left_m: F64, above_m: float) -> F64:
        """(N, 3) places in the map frame of places in the window."""
        left_m = left_m + self.bend_per_m * ahead_m**2
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        x, y = c * ahead_m - s * left_m, s * ahead_m + c * left_m
        return np.asarray(self.origin_m + np.column_stack([x, y, self.rise * ahead_m + above_m]))

    def piece_of(self, frame: LocalFrame, line_m: F64) -> LanePiece | None:
        """The piece beside the window's middle of a line (N, 3) of the map frame."""
        pieces = lane_pieces(*frame.geodetic_from_enu(line_m))
        return next((one for one in pieces if one.cell == self.cell), None)


def windows_along(frame: LocalFrame, way_m: F64) -> list[LaneWindow]:
    """The windows of a way (N, 3) in the map frame, in order; none of a way that is too short."""
    way_m = _resampled(way_m)
    if len(way_m) < 2 * HALF_WINDOW_M / _STEP_M:
        return []
    along = np.arange(len(way_m), dtype=np.float64) * _STEP_M
    pieces = lane_pieces(*frame.geodetic_from_enu(way_m))
    return [_window(way_m, along, piece.cell, 0.5 * sum(piece.along_m)) for piece in pieces]


def _resampled(way_m: F64) -> F64:
    if len(way_m) < 2:
        return way_m
    step = np.hypot(*np.diff(way_m[:, :2], axis=0).T)
    kept = np.concatenate([[True], step > 1e-6])
    length = np.concatenate([[0.0], np.cumsum(step)])[kept]
    at = np.arange(0.0, length[-1], _STEP_M)
    return np.column_stack([np.interp(at, length, column[kept]) for column in way_m.T])


def _window(way_m: F64, along: F64, cell: tuple[int, int], at_m: float) -> LaneWindow:
    """The frame that a parabola through the way about its place gives."""
    near = np.abs(along - at_m) <= _FIT_M
    s = along[near] - at_m
    A = np.column_stack([np.ones_like(s), s, s * s])
    (x0, x1, x2), (y0, y1, y2), (z0, z1, _) = np.linalg.lstsq(A, way_m[near], rcond=None)[0].T
    heading = float(np.arctan2(y1, x1))
    bend = float(np.cos(heading) * y2 - np.sin(heading) * x2)
    return LaneWindow(cell, at_m, np.array([x0, y0, z0]), heading, bend, float(z1))


class SeenGround:
    """From how many scans each square metre of the road was seen.

    Args:
        xy_m: of each scan, (G, 2 or 3) map frame.
    """

    def __init__(self, xy_m: list[F64]) -> None:
        keys = [np.unique(_key(xy[:, :2])) for xy in xy_m if len(xy)]
        every = np.concatenate(keys) if keys else np.zeros(0, np.int64)
        self._keys, self._count = np.unique(every, return_counts=True)

    def scans(self, xy_m: F64) -> I64:
        """(N,) scans that saw the road at places (N, 2 or 3)."""
        if not len(self._keys):
            return np.zeros(len(xy_m), np.int64)
        key = _key(xy_m[:, :2])
        row = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        return np.where(self._keys[row] == key, self._count[row], 0)

    def places(self, least: int) -> F64:
        """(N, 2) middles of the square metres that at least so many scans saw."""
        key = self._keys[self._count >= least]
        cells = np.column_stack([key // _ROW - _HALF_ROW, key % _ROW - _HALF_ROW])
        return np.asarray((cells + 0.5) * CELL_M, np.float64)


CELL_M: Final = 1.0
_ROW: Final = 1 << 24
_HALF_ROW: Final = _ROW // 2


def _key(xy_m: F64) -> I64:
    cell: NDArray[np.int64] = np.floor(xy_m / CELL_M).astype(np.int64) + _HALF_ROW
    return np.asarray(cell[:, 0] * _ROW + cell[:, 1])
