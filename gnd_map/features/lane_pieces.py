"""Lane markings in pieces of equal place: every vehicle cuts a line where the same meridians and parallels cross it.

A tile has 8 x 8 cells (`gnd.schemas.feature_change.GRID`). A line that runs east rather than north is cut at the
meridians between cells, another at the parallels. So two drives that see one line cut it alike but for their error
across it: a piece is a straight line of two vertices, some 3 to 7 m long, whose place across can be measured and whose
place along it is fixed.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, check_array
from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features.polylines import points_in_tile
from gnd.gnd_map.tile_id import LON_TILES, TileId, geodetic_of_tile_coordinates, tile_coordinates

LANE_CELLS: Final = 8
"""Cells of a tile along each axis."""
_MAX_PIECES: Final = 100_000
_OUTSIDE_M: Final = 0.9
"""A piece reaches no farther out of its tile (`gnd.schemas.limits.MAX_FOUND_OUTSIDE_M`)."""


@dataclass(frozen=True, slots=True, eq=False)
class LanePiece:
    """A piece of a line between two neighbouring meridians (parallels) of the grid of cells.

    Attributes:
        tile: that holds its middle.
        points_m: (2, 3) in the tile's ENU frame, from west to east (south to north).
        cell: which meridian (axis 0) or parallel (axis 1) it begins at, counted over the Earth: (axis, number).
        along_m: (2,) where it begins and ends on the line it was cut from, metres from the line's first vertex.
    """

    tile: TileId
    points_m: F64
    cell: tuple[int, int]
    along_m: tuple[float, float]

    @property
    def middle_m(self) -> F64:
        """(3,) its middle."""
        return np.asarray(self.points_m.mean(axis=0))


def lane_pieces(lat_rad: F64, lon_rad: F64, height_m: F64) -> list[LanePiece]:
    """The pieces of a polyline, in its order; what is left over at its ends is in none.

    Args:
        lat_rad: (N,), N >= 2.
        lon_rad: (N,).
        height_m: (N,) ellipsoidal.

    Raises:
        FeatureError: fewer than two vertices, values that are not finite, or a line of more than 100,000 pieces.
    """
    for name, values in (("lat_rad", lat_rad), ("lon_rad", lon_rad), ("height_m", height_m)):
        check_array(name, values, np.float64, (len(lat_rad),))
    if len(lat_rad) < 2:
        raise FeatureError(f"a line of {len(lat_rad)} vertices has no pieces")
    u, v = tile_coordinates(lat_rad, lon_rad)
    line = np.column_stack([np.unwrap(u, period=LON_TILES), v, height_m])
    way_m = _way_m(line)
    found = [piece for axis in (0, 1) for piece in _between(line, way_m, axis)]
    return sorted(found, key=lambda piece: piece.along_m)


def _way_m(line: F64) -> F64:
    """(N,) metres along a line given in tile coordinates."""
    step = np.diff(line[:, :2], axis=0) * _metres(line[0, 1])
    return np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])


def _metres(v: float) -> F64:
    """(2,) metres of a tile's width and height at a row."""
    lat, lon = geodetic_of_tile_coordinates(np.array([0.5, 1.5, 0.5]), np.array([v, v, v + 1.0]))
    xyz = points_in_tile(TileId.from_geodetic(float(lat[0]), float(lon[0])), lat, lon, np.zeros(3))
    return np.array([abs(xyz[1, 0] - xyz[0, 0]), abs(xyz[2, 1] - xyz[0, 1])])


def _between(line: F64, way_m: F64, axis: int) -> list[LanePiece]:
    """Pieces between neighbouring planes of one axis whose direction is rather along that axis."""
    size = _metres(line[0, 1])
    pieces = []
    for (k, a, at), (n, b, to) in pairwise(_crossings(line, way_m, axis)):
        run = np.abs(b - a)[:2] * size
        if abs(n - k) != 1 or not (run[axis] >= run[1 - axis] if axis == 0 else run[1] > run[0]):
            continue
        ends = np.array([a, b] if n > k else [b, a])
        ends = _inside(ends, 1 - axis, float(_OUTSIDE_M / size[1 - axis]))
        middle = ends.mean(axis=0)
        lat, lon = geodetic_of_tile_coordinates(middle[0] % LON_TILES, middle[1])
        tile = TileId.from_geodetic(float(lat), float(lon))
        points_m = points_in_tile(tile, *geodetic_of_tile_coordinates(ends[:, 0], ends[:, 1]), ends[:, 2])
        pieces.append(LanePiece(tile, points_m, (axis, min(k, n)), (at, to)))
    return pieces


def _inside(ends: F64, across: int, margin: float) -> F64:
    """A piece (2, 3) without what reaches farther over the border of its tile beside it."""
    low = np.floor(0.5 * (ends[0, across] + ends[1, across]))
    step = ends[1] - ends[0]
    if abs(step[across]) < margin:
        return ends
    share = np.clip((np.array([low - margin, low + 1.0 + margin]) - ends[0, across]) / step[across], 0.0, 1.0)
    return np.asarray(ends[0] + np.sort(share)[:, None] * step)


def _crossings(line: F64, way_m: F64, axis: int) -> list[tuple[int, F64, float]]:
    """Where the line meets the planes of an axis, in order: number of the plane, place (3,), metres along."""
    cells = line[:, axis] * LANE_CELLS
    if np.abs(np.diff(cells)).sum() > _MAX_PIECES:
        raise FeatureError(f"a line of {np.abs(np.diff(cells)).sum():.0f} pieces, at most {_MAX_PIECES}")
    found: list[tuple[int, F64, float]] = []
    for i in range(len(line) - 1):
        low, high = sorted((cells[i], cells[i + 1]))
        planes = np.arange(np.ceil(low), np.floor(high) + 1)
        for plane in planes if cells[i + 1] >= cells[i] else planes[::-1]:
            share = (plane - cells[i]) / (cells[i + 1] - cells[i]) if high > low else 0.0
            if found and found[-1][0] == int(plane):
                continue
            place = line[i] + share * (line[i + 1] - line[i])
            found.append((int(plane), place, float(way_m[i] + share * (way_m[i + 1] - way_m[i]))))
    return found


def beside(points_m: F64, other_m: F64) -> tuple[float, float]:
    """How a piece lies beside another, seen from above; both (2, 3) in one frame.

    Returns:
        The share of the first that the other lies beside, 0 … 1; and how far left of the first, looking along it, the
        other lies at the middle of that share. (0, inf) where it lies beside none of it.
    """
    along = (points_m[1] - points_m[0])[:2]
    length = float(np.hypot(*along))
    if length < 1e-9:
        return 0.0, np.inf
    t = along / length
    offset = other_m[:, :2] - points_m[0, :2]
    s, d = offset @ t, offset @ np.array([-t[1], t[0]])
    low, high = max(0.0, float(s.min())), min(length, float(s.max()))
    if high <= low or abs(s[1] - s[0]) < 1e-9:
        return 0.0, np.inf
    share = (0.5 * (low + high) - s[0]) / (s[1] - s[0])
    return (high - low) / length, float(d[0] + share * (d[1] - d[0]))


def is_lane_piece(points_m: F64) -> bool:
    """Whether a feature's points are a straight piece of a line: two vertices."""
    return len(points_m) == 2


def left_of(points_m: F64) -> F64:
    """(3,) horizontal unit vector to the left of a piece (2, 3), looking along it."""
    x, y = (points_m[1] - points_m[0])[:2]
    return np.array([-y, x, 0.0]) / max(float(np.hypot(x, y)), 1e-12)
