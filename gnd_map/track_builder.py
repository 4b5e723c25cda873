"""The track of a report, from the scans that counted."""

from collections.abc import Iterable
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.errors import TrackError
from gnd.gnd_map.geodesy import LocalFrame, meridian_radius_m, normal_radius_m
from gnd.gnd_map.tile_id import LON_TILES, TILE_RAD, District, TileId, tile_coordinates
from gnd.gnd_map.track import HEIGHT_UNIT_M, LEVEL_DEG, LEVELS, SECTORS, STEPS, Track, TrackPiece, TrackView

Mask: TypeAlias = npt.NDArray[np.bool_]

REACH_M: Final = 60.0
"""Scans from farther away say nothing about a tile."""
GAP_M: Final = 5.0
"""Scans farther apart than this do not belong to one piece."""
TOLERANCE_M: Final = 0.5
"""Vertices are left out where the line stays so near to them."""
_RAYS_OF_A_SCAN: Final = 512
_ELEVATIONS: Final = 256
_RANGES: Final = 256
_NEARLY_ALL: Final = 0.98
_STRAY: Final = 0.002  # of the rays are left out at either end


class TrackBuilder:
    """Collects the scans that count, and gives the track of those that saw certain tiles.

    Args:
        frame: the map frame that the scans come in.
    """

    def __init__(self, frame: LocalFrame) -> None:
        self._frame = frame
        self._t_ns: list[int] = []
        self._origins: list[F64] = []
        self._elevations = np.zeros(_ELEVATIONS, np.int64)
        self._sectors = np.zeros(SECTORS, np.int64)
        self._ranges = np.zeros(_RANGES, np.int64)
        self._scans = self._rays = 0

    def __len__(self) -> int:
        return len(self._t_ns)

    def add_scan(self, t_ns: int, points_map_m: F64, origins_map_m: F64, T_map_vehicle: F64) -> None:
        """Take a scan that counts.

        Args:
            t_ns: its time, never before that of the scan before.
            points_map_m: (N, 3) float64 hits in the map frame; a scan without any is left out.
            origins_map_m: (N, 3) or (3,) float64, the sensor.
            T_map_vehicle: (4, 4) float64, the vehicle; its x axis points ahead, its z axis up.
        """
        if not len(points_map_m):
            return
        origins = np.broadcast_to(origins_map_m, points_map_m.shape)
        self._t_ns.append(t_ns)
        self._origins.append(np.array(origins[len(origins) // 2], np.float64))  # a view would keep the whole scan
        self._scans, self._rays = self._scans + 1, self._rays + len(points_map_m)
        step = 1 + len(points_map_m) // _RAYS_OF_A_SCAN | 1  # odd: layers come in powers of two
        self._look((points_map_m[::step] - origins[::step]) @ T_map_vehicle[:3, :3])

    def _look(self, rays: F64) -> None:
        """Count where rays (N, 3), vehicle axes, go."""
        flat_m = np.hypot(rays[:, 0], rays[:, 1])
        elevation = np.degrees(np.arctan2(rays[:, 2], flat_m)) / LEVEL_DEG
        azimuth = np.arctan2(rays[:, 1], rays[:, 0]) / (2.0 * np.pi) % 1.0
        range_m = np.hypot(flat_m, rays[:, 2])
        self._elevations += _counts(np.round(elevation) + _ELEVATIONS // 2, _ELEVATIONS)
        self._sectors += _counts(azimuth * SECTORS, SECTORS)
        self._ranges += _counts(np.ceil(range_m), _RANGES)

    def track(self, district: District, tiles: Iterable[TileId], since_ns: int = 0) -> Track:
        """The track of the scans that were near enough to see any of the tiles.

        Args:
            district: of the tiles.
            tiles: of the report.
            since_ns: earlier scans are left out.

        Raises:
            TrackError: no scan was near them, or more than a track can hold.
        """
        known = np.flatnonzero(np.array(self._t_ns, np.int64) >= since_ns)
        if len(known):
            origins = np.stack([self._origins[k] for k in known.tolist()])
            g = self._relative(district, origins)
            metres = _metres_a_unit(district)
            near = np.flatnonzero(_near(g * metres, np.array([_corner(district, t) for t in tiles]), metres))
            if len(near):
                return Track(district, self._view(), _pieces(g[near], near, metres))
        raise TrackError(f"none of {len(known)} scans was within {REACH_M:g} m of the tiles of district {district}")

    def forget_before(self, t_ns: int) -> None:
        """Drop the scans before a time; what the sensor looks like is kept."""
        first = int(np.searchsorted(np.array(self._t_ns, np.int64), t_ns))
        del self._t_ns[:first], self._origins[:first]

    def _relative(self, district: District, origins_map_m: F64) -> F64:
        """(N, 3) positions in units of `track`, not yet rounded."""
        lat, lon, height_m = self._frame.geodetic_from_enu(origins_map_m)
        u, v = tile_coordinates(lat, lon)
        corner = TileId(district.first_morton)
        east = np.remainder(u - corner.lon_index + LON_TILES // 2, LON_TILES) - LON_TILES // 2
        return np.column_stack([STEPS * east, STEPS * (v - corner.lat_index), height_m / HEIGHT_UNIT_M])

    def _view(self) -> TrackView:
        quantiles = np.linspace(_STRAY, 1.0 - _STRAY, LEVELS)
        at = np.searchsorted(np.cumsum(self._elevations), quantiles * self._elevations.sum())
        half = self._sectors > 0.5 * np.median(self._sectors[self._sectors > 0])
        reach = int(np.searchsorted(np.cumsum(self._ranges), _NEARLY_ALL * self._ranges.sum()))
        return TrackView(
            levels=tuple((at - _ELEVATIONS // 2).tolist()),
            sectors=int((half * (1 << np.arange(SECTORS))).sum()),
            rays_log2=min(round(4.0 * float(np.log2(self._rays / self._scans))), 96),
            range_m=min(max(reach, 1), 255),
        )


def _counts(values: F64, n: int) -> I64:
    return np.bincount(np.clip(values.astype(np.int64), 0, n - 1), minlength=n)


def _metres_a_unit(district: District) -> F64:
    """(3,) metres that a unit makes east, north and up in the middle of the district."""
    lat, _ = district.centre_rad
    east = float(normal_radius_m(lat) * np.cos(lat)) * TILE_RAD / STEPS
    return np.array([east, float(meridian_radius_m(lat)) * TILE_RAD / STEPS, HEIGHT_UNIT_M])


def _corner(district: District, tile: TileId) -> tuple[int, int]:
    """South-west corner of a tile in units."""
    first = TileId(district.first_morton)
    return (tile.lon_index - first.lon_index) * STEPS, (tile.lat_index - first.lat_index) * STEPS


def _near(position_m: F64, corners: I64, metres: F64) -> Mask:
    """(N,) whether each position (N, 3) is within reach of any of the tiles, given by their corners (M, 2)."""
    near = np.zeros(len(position_m), np.bool_)
    for corner in corners:
        low, high = corner * metres[:2], (corner + STEPS) * metres[:2]
        outside = np.maximum(0.0, np.maximum(low - position_m[:, :2], position_m[:, :2] - high))
        near |= np.hypot(outside[:, 0], outside[:, 1]) <= REACH_M
    return near


def _pieces(g: F64, number: I64, metres: F64) -> tuple[TrackPiece, ...]:
    """The polylines through positions (N, 3) in units; `number` (N,) tells which scans follow each other."""
    step_m = np.linalg.norm(np.diff(g, axis=0) * metres, axis=1)
    cut = np.flatnonzero((np.diff(number) > 1) | (step_m > GAP_M)) + 1
    return tuple(_piece(part, metres) for part in np.split(g, cut))


def _piece(g: F64, metres: F64) -> TrackPiece:
    vertices = np.round(g[_kept(g * metres)]).astype(np.int32)
    moved = np.concatenate([[True], (np.diff(vertices, axis=0) != 0).any(axis=1)])
    return TrackPiece(np.ascontiguousarray(vertices[moved]), len(g))


def _kept(p_m: F64) -> I64:
    """Indices of the points (N, 3) that a line within `TOLERANCE_M` of all needs (Douglas and Peucker 1973)."""
    kept, open_spans = {0, len(p_m) - 1}, [(0, len(p_m) - 1)]
    while open_spans:
        first, last = open_spans.pop()
        if last - first < 2:
            continue
        off_m = _distance_m(p_m[first + 1 : last], p_m[first], p_m[last])
        worst = first + 1 + int(np.argmax(off_m))
        if off_m.max() > TOLERANCE_M:
            kept.add(worst)
            open_spans += [(first, worst), (worst, last)]
    return np.array(sorted(kept), np.int64)


def _distance_m(p: F64, a: F64, b: F64) -> F64:
    """(N,) distances of points (N, 3) to the line from a to b."""
    along = b - a
    t = np.clip((p - a) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(p - a - t[:, None] * along, axis=1))
