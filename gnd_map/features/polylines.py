"""Points and polylines of the Earth in tiles: cut at the borders of tiles, joined again, checked for crossing itself.

A polyline is straight in latitude and longitude between its vertices; over a tile of 38 m that differs from a straight
line in space by less than a hundredth of a millimetre.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I64, check_array
from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features.feature import CUT_END, CUT_START, Feature
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import LON_TILES, TileId, geodetic_of_tile_coordinates, tile_coordinates

Piece = tuple[TileId, F64, int]
"""Tile, points (N, 3) in its ENU frame, cuts."""
_SAME: Final = 1e-12
"""Points nearer to each other, as a share of their segment, are one."""
_MAX_PIECES: Final = 100_000
_ROWS: Final = 64
"""So many segments at a time are compared with all later ones: memory stays at some megabytes."""
MAX_PAIRS: Final = 65_536
"""Pairs of segments of a polyline whose boxes meet, each of which is looked at for a crossing. A lane has little more
of them than segments; 4,096 points in one place would have 8 million, 2 s of CPU."""
_ONE_DIRECTION: Final = 1e-12
_ON_LINE_M: Final = 1e-9


def points_in_tile(tile: TileId, lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, height_m: npt.ArrayLike) -> F64:
    """(N, 3) positions in the ENU frame of a tile, metres."""
    return np.atleast_2d(LocalFrame.of_tile(tile).enu_from_geodetic(lat_rad, lon_rad, height_m))


def geodetic_in_tile(tile: TileId, points_m: F64) -> tuple[F64, F64, F64]:
    """Latitude, longitude (radians) and ellipsoidal height, each (N,), of points (N, 3) in a tile's ENU frame."""
    return LocalFrame.of_tile(tile).geodetic_from_enu(np.atleast_2d(points_m))


def cut_polyline(lat_rad: F64, lon_rad: F64, height_m: F64) -> list[Piece]:
    """The pieces of a polyline in the tiles that it runs through, in order.

    Args:
        lat_rad: (N,), N >= 1; a polyline of one vertex is a point.
        lon_rad: (N,).
        height_m: (N,) ellipsoidal.

    Returns:
        Of each piece its tile, its points (M, 3) in that tile's ENU frame, and `CUT_START`, `CUT_END` where its first,
        its last vertex was made by the cut. `join_pieces` undoes it.

    Raises:
        FeatureError: no vertex, values that are not finite, or more than 100,000 pieces.
        GeodesyError: a latitude beyond a pole.
    """
    for name, values in (("lat_rad", lat_rad), ("lon_rad", lon_rad), ("height_m", height_m)):
        check_array(name, values, np.float64, (len(lat_rad),))
    if not len(lat_rad):
        raise FeatureError("a polyline without vertices has no place")
    u, v = tile_coordinates(lat_rad, lon_rad)
    if (np.abs(np.diff(u)) > LON_TILES / 2).any():  # over 180 degrees the short way round
        u = np.unwrap(u, period=LON_TILES)
    line = np.column_stack([u, v, height_m])
    if len(line) == 1:
        return [_piece(line, 0)]
    return [_piece(vertices, cuts) for vertices, cuts in _runs(line)]


def _piece(vertices: F64, cuts: int) -> Piece:
    middle = (vertices[0] + vertices[1]) / 2 if len(vertices) > 1 else vertices[0]
    lat, lon = geodetic_of_tile_coordinates(middle[0], middle[1])
    tile = TileId.from_geodetic(float(lat), float(lon))
    return (
        tile,
        points_in_tile(tile, *geodetic_of_tile_coordinates(vertices[:, 0], vertices[:, 1]), vertices[:, 2]),
        cuts,
    )


def _runs(line: F64) -> list[tuple[F64, int]]:
    """The vertices between crossings of tile borders, with the cuts at either end; `line` in tile coordinates."""
    runs: list[tuple[F64, int]] = []
    run, cuts = [line[0]], 0
    for number, (start, end) in enumerate(pairwise(line), 1):
        for share in _crossings(start, end):
            border = start + share * (end - start)
            runs.append((np.array([*run, border]), cuts | CUT_END))
            run, cuts = [border], CUT_START
        run.append(end)
        if _on_border(end) and number < len(line) - 1:  # the two pieces share a vertex of the polyline's own
            runs.append((np.array(run), cuts))
            run, cuts = [end], 0
        if len(runs) >= _MAX_PIECES:
            raise FeatureError(f"a polyline runs through more than {_MAX_PIECES} tiles")
    return [*runs, (np.array(run), cuts)]


def _crossings(start: F64, end: F64) -> list[float]:
    """Where between two vertices (exclusively) a border of tiles is crossed, as shares of the way, ascending."""
    found: list[float] = []
    for axis in (0, 1):
        low, high = sorted((float(start[axis]), float(end[axis])))
        if high - low > _MAX_PIECES:
            raise FeatureError(f"a segment of a polyline runs through {high - low:.0f} tiles")
        lines = np.arange(np.floor(low) + 1, np.ceil(high))
        found += ((lines - start[axis]) / (end[axis] - start[axis])).tolist() if len(lines) else []
    inside = sorted(share for share in found if _SAME < share < 1 - _SAME)
    return [share for i, share in enumerate(inside) if i == 0 or share - inside[i - 1] > _SAME]


def _on_border(vertex: F64) -> bool:
    return bool((vertex[:2] == np.floor(vertex[:2])).any())


def join_pieces(pieces: Sequence[tuple[TileId, Feature]]) -> tuple[F64, F64, F64]:
    """The vertices of a polyline from its pieces: latitude, longitude (radians) and ellipsoidal height, each (N,).

    Raises:
        FeatureError: pieces of several polylines, or one is missing or comes twice.
    """
    ordered = sorted(pieces, key=lambda one: one[1].part)
    ids, parts = {feature.feature_id for _, feature in ordered}, [feature.part for _, feature in ordered]
    if len(ids) != 1 or parts != list(range(len(parts))):
        raise FeatureError(f"parts {parts[:20]} of {len(ids)} polylines are not all the pieces of one")
    columns = [
        geodetic_in_tile(tile, _own_vertices(feature)) for tile, feature in ordered if len(_own_vertices(feature))
    ]
    lat, lon, height = (np.concatenate(column) for column in zip(*columns, strict=True))
    return lat, lon, height


def _own_vertices(feature: Feature) -> F64:
    """The vertices of a piece that are the polyline's; one shared with the piece before belongs to that one."""
    first = 1 if feature.cuts & CUT_START or feature.part > 0 else 0
    last = len(feature.points_m) - (1 if feature.cuts & CUT_END else 0)
    return feature.points_m[first:last]


def pieces_of(feature: Feature, lat_rad: F64, lon_rad: F64, height_m: F64) -> list[tuple[TileId, Feature]]:
    """A feature laid along positions of the Earth, cut into tiles; its own points are replaced, part and cuts set.

    The covariance is taken as it is: frames of neighbouring tiles differ in direction by less than 10 µrad.
    """
    cut = cut_polyline(lat_rad, lon_rad, height_m)
    return [
        (tile, replace(feature, points_m=points, part=number, cuts=cuts))
        for number, (tile, points, cuts) in enumerate(cut)
    ]


def check_simple_polyline(name: str, points_m: F64) -> None:
    """Refuse a polyline that crosses, touches or runs back over itself, seen from above (its ends may meet: a loop).

    Args:
        name: what to call it in the message.
        points_m: (N, 2) or (N, 3); a vertex that repeats the one before counts once.

    Raises:
        FeatureError: says which segments meet, and where; more segments lie over each other than are looked at.
    """
    xy = np.asarray(points_m, dtype=np.float64)[:, :2]
    kept = np.flatnonzero(np.concatenate([[True], (np.diff(xy, axis=0) != 0.0).any(axis=1)]))
    pair = _first_meeting(xy[kept])
    if pair is not None:
        i, k = kept[pair[0]], kept[pair[1]]
        x, y = xy[i]
        raise FeatureError(
            f"{name} crosses itself: segments {i} and {k} of {len(xy) - 1} meet near ({x:.2f}, {y:.2f}) m"
        )


def _first_meeting(line: F64) -> tuple[int, int] | None:
    """The first two segments of a polyline (N, 2) that meet where they should not; None: it is simple."""
    start, step = line[:-1], np.diff(line, axis=0)
    low, high = np.minimum(line[:-1], line[1:]), np.maximum(line[:-1], line[1:])
    is_loop = len(line) > 2 and np.array_equal(line[0], line[-1])
    pairs = 0
    for first in range(0, len(step), _ROWS):
        i, j = _boxes_meeting(low[first:], high[first:])
        pairs += len(i)
        if pairs > MAX_PAIRS:
            raise FeatureError(
                f"more than {MAX_PAIRS} pairs of {len(step)} segments lie in one place: too many to look for crossings"
            )
        i, j = i + first, j + first
        meets = _meeting(start[i], step[i], start[j], step[j])
        meets &= (j > i + 1) | ((step[i] * step[j]).sum(axis=1) < 0.0) & _parallel(step[i], step[j])
        meets &= ~((i == 0) & (j == len(step) - 1)) | (not is_loop) | (len(step) < 3)
        if meets.any():
            at = int(np.argmax(meets))
            return int(i[at]), int(j[at])
    return None


def _boxes_meeting(low: F64, high: F64) -> tuple[I64, I64]:
    """Pairs i < j of boxes with corners (N, 2) that have a point in common; only the first `_ROWS` boxes as i."""
    (x_low, y_low), (x_high, y_high) = low.T, high.T
    rows = slice(_ROWS)
    x_meet = np.less_equal.outer(x_low[rows], x_high) & np.greater_equal.outer(x_high[rows], x_low)
    i, j = np.nonzero(x_meet)
    later = (j > i) & (y_low[i] <= y_high[j]) & (y_high[i] >= y_low[j])
    return i[later], j[later]


def _meeting(p: F64, r: F64, q: F64, s: F64) -> npt.NDArray[np.bool_]:
    """(N,) whether the segments p → p + r and q → q + s, each (N, 2), have a point in common."""
    across, apart, parallel = _cross(r, s), q - p, _parallel(r, s)
    safe = np.where(parallel, 1.0, across)
    t, u = _cross(apart, s) / safe, _cross(apart, r) / safe
    crosses = ~parallel & (np.maximum(np.abs(t - 0.5), np.abs(u - 0.5)) <= 0.5 + _SAME)
    length2 = (r * r).sum(axis=1)
    on_line = parallel & (np.abs(_cross(apart, r)) <= _ON_LINE_M * np.sqrt(length2))
    a = (apart * r).sum(axis=1) / length2
    b = a + (s * r).sum(axis=1) / length2
    return np.asarray(crosses | on_line & (np.minimum(a, b) <= 1 + _SAME) & (np.maximum(a, b) >= -_SAME))


def _parallel(r: F64, s: F64) -> npt.NDArray[np.bool_]:
    """(N,) whether vectors (N, 2) have one direction, or opposite ones."""
    lengths = np.hypot(*r.T) * np.hypot(*s.T)
    return np.asarray(np.abs(_cross(r, s)) <= _ONE_DIRECTION * lengths)


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
