"""Where a drive has looked: the cells of each tile in which it would have confirmed a feature had there been one.

A fleet can forget a feature, and reject a false one, only when vehicles report where they looked and saw nothing.
Each tile has 8 x 8 cells of some 4 m (`gnd.schemas.feature_change.cell_of`): eight bytes.
"""

from math import cos, hypot, sin
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId, geodetic_of_tile_coordinates, tile_coordinates
from gnd.schemas.feature_change import GRID
from gnd.vehicle_agent.features.view import Occlusion, SensorView

LOOKS: Final = 4
LOOK_STEP_M: Final = 1.0
_BASE_M: Final = 100.0
"""Cells are laid by a linear map about the vehicle, measured over this length and within it exact to a millimetre."""


class Coverage:
    """Counts for the cells around the vehicle from how many places they were in view.

    Args:
        frame: the map frame.
        view: of the sensor.
        height_m: of the features looked for, above the vehicle's origin.
        looks: from so many places a feature in a cell would have been in view and not hidden, or it does not count.
        step_m: places are so far apart.
    """

    def __init__(
        self, frame: LocalFrame, view: SensorView, height_m: float, looks: int = LOOKS, step_m: float = LOOK_STEP_M
    ) -> None:
        self._frame, self._view, self._height_m, self._least, self._step_m = frame, view, height_m, looks, step_m
        self._looks: dict[TileId, I32] = {}
        self._looked_at: tuple[float, float] | None = None

    @property
    def tiles(self) -> list[TileId]:
        """The tiles of which any cell was in view, sorted."""
        return sorted(self._looks)

    def look(self, x_m: float, y_m: float, heading_rad: float, occlusion: Occlusion | None) -> bool:
        """Count what is in view from here; False when the vehicle has hardly moved since it last counted.

        Args:
            x_m: map frame.
            y_m: map frame.
            heading_rad: counter-clockwise from the map frame's x axis.
            occlusion: what hides features here; None = nothing.
        """
        before = self._looked_at
        if before is not None and hypot(x_m - before[0], y_m - before[1]) < self._step_m:
            return False
        self._looked_at = x_m, y_m
        for tile, cells in self._in_view(x_m, y_m, heading_rad, occlusion).items():
            np.add.at(self._looks.setdefault(tile, np.zeros(GRID * GRID, np.int32)), cells, 1)
        return True

    def viewed(self, tile: TileId) -> int:
        """The mask of `gnd.schemas.features.FeatureChange.viewed`."""
        looks = self._looks.get(tile)
        if looks is None:
            return 0
        return sum(1 << int(cell) for cell in np.flatnonzero(looks >= self._least))

    def touched(self, tile: TileId) -> bool:
        """Whether any of the tile's cells was in view."""
        return tile in self._looks

    def forget(self, tile: TileId) -> None:
        """The tile was reported."""
        self._looks.pop(tile, None)

    def _in_view(self, x_m: float, y_m: float, heading_rad: float, occlusion: Occlusion | None) -> dict[TileId, I64]:
        cells, ahead_m, left_m = self._around(x_m, y_m, heading_rad)
        range_m, bearing_rad = np.hypot(ahead_m, left_m), np.arctan2(left_m, ahead_m)
        seen = self._view.inside(range_m, bearing_rad)
        if occlusion is not None:
            edge, height = np.zeros(int(seen.sum())), np.full(int(seen.sum()), self._height_m)
            seen[seen] = occlusion.clear(range_m[seen], bearing_rad[seen], edge, height)
        return _by_tile(cells[seen])

    def _around(self, x_m: float, y_m: float, heading_rad: float) -> tuple[I64, F64, F64]:
        """Cells within range, (N, 2) global column and row, and where their middles lie: metres ahead and left."""
        here, per_m = self._linear(x_m, y_m)
        m_per_cell = np.linalg.inv(per_m)
        reach = np.abs(per_m).sum(axis=1) * self._view.range_m
        first, last = np.floor(here - reach).astype(np.int64), np.floor(here + reach).astype(np.int64)
        columns, rows = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1))
        cells = np.stack([columns.ravel(), rows.ravel()], axis=1)
        away = (cells + 0.5 - here) @ m_per_cell.T
        c, s = cos(heading_rad), sin(heading_rad)
        return cells, c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]

    def _linear(self, x_m: float, y_m: float) -> tuple[F64, F64]:
        """Cell coordinates (2,) of a point of the map frame, and their derivative (2, 2) by its x and y."""
        points = np.array([[x_m, y_m, 0.0], [x_m + _BASE_M, y_m, 0.0], [x_m, y_m + _BASE_M, 0.0]])
        lat, lon, _ = self._frame.geodetic_from_enu(points)
        u, v = tile_coordinates(lat, lon)
        grid = np.stack([u, v], axis=1) * GRID
        return grid[0], (grid[1:] - grid[0]).T / _BASE_M


def _by_tile(cells: I64) -> dict[TileId, I64]:
    """Numbers of cells within their tile (row · 8 + column), by tile."""
    tiles, numbers = cells // GRID, cells % GRID
    found: dict[TileId, I64] = {}
    for column, row in np.unique(tiles, axis=0).tolist():
        mine = (tiles[:, 0] == column) & (tiles[:, 1] == row)
        lat, lon = geodetic_of_tile_coordinates(column + 0.5, row + 0.5)
        found[TileId.from_geodetic(float(lat), float(lon))] = numbers[mine, 1] * GRID + numbers[mine, 0]
    return found
