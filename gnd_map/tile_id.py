"""GND tiles: the Earth cut into 2^20 x 2^19 equal angles, numbered by Morton codes (GND, Figure 2; recovered and
verified there).

A tile spans 360°/2^20 on each axis. Its longitude index counts from 180° west on the even bits (least significant
first), its latitude index from the south pole on the odd bits. Written as 20 base-4 digits (2·latitude bit + longitude
bit, most significant first) in four chunks of five, a prefix is a region: about 1250 km / 39 km / 1.2 km (a `District`)
/ 38 m (a tile).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.geodesy import check_geodetic, ecef_from_geodetic, meridian_radius_m, normal_radius_m

LON_TILES = 1 << 20
LAT_TILES = 1 << 19
TILE_RAD = 2.0 * np.pi / LON_TILES
_DISTRICT_SHIFT = 10  # the last five base-4 digits
TILES_OF_DISTRICT = 1 << _DISTRICT_SHIFT
_PATH = re.compile(r"[01][0-3]{4}(/[0-3]{5}){3}")
_DISTRICT_PATH = re.compile(r"[01][0-3]{4}(/[0-3]{5}){2}")
_CHUNKS = tuple(map("".join, product("0123", repeat=5)))
_MAX_COVER = 1_000_000
_SAMPLE_M = 5.0  # a corridor is covered by circles this far apart


def tile_coordinates(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike) -> tuple[F64, F64]:
    """Continuous tile coordinates (u east from 180° W, v north from the south pole); their floors are the indices.

    Raises:
        GeodesyError: not finite, or a latitude beyond a pole.
    """
    check_geodetic(lat_rad, lon_rad)
    u = (np.asarray(lon_rad, dtype=np.float64) / (2.0 * np.pi) + 0.5) * LON_TILES
    v = (np.asarray(lat_rad, dtype=np.float64) / (2.0 * np.pi) + 0.25) * LON_TILES
    return u, v


def geodetic_of_tile_coordinates(u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[F64, F64]:
    """Latitude and longitude in radians of continuous tile coordinates; the inverse of `tile_coordinates`."""
    lon = (np.asarray(u, dtype=np.float64) / LON_TILES - 0.5) * (2.0 * np.pi)
    lat = (np.asarray(v, dtype=np.float64) / LON_TILES - 0.25) * (2.0 * np.pi)
    return np.clip(lat, -np.pi / 2, np.pi / 2), lon


def interleave(lon_index: npt.ArrayLike, lat_index: npt.ArrayLike) -> I64:
    """Morton codes (int64) of index arrays."""
    return _spread(np.asarray(lon_index, dtype=np.int64)) | (_spread(np.asarray(lat_index, dtype=np.int64)) << 1)


def deinterleave(morton: npt.ArrayLike) -> tuple[I64, I64]:
    """Longitude and latitude indices (int64) of Morton codes."""
    code = np.asarray(morton, dtype=np.int64)
    return _gather(code), _gather(code >> 1)


def _spread(x: I64) -> I64:
    """Put bit k of a 20-bit number on bit 2k."""
    x = (x | (x << 16)) & 0x0000FFFF0000FFFF
    x = (x | (x << 8)) & 0x00FF00FF00FF00FF
    x = (x | (x << 4)) & 0x0F0F0F0F0F0F0F0F
    x = (x | (x << 2)) & 0x3333333333333333
    return (x | (x << 1)) & 0x5555555555555555


def _gather(x: I64) -> I64:
    """Put bit 2k on bit k: the inverse of `_spread`."""
    x = x & 0x5555555555555555
    x = (x | (x >> 1)) & 0x3333333333333333
    x = (x | (x >> 2)) & 0x0F0F0F0F0F0F0F0F
    x = (x | (x >> 4)) & 0x00FF00FF00FF00FF
    x = (x | (x >> 8)) & 0x0000FFFF0000FFFF
    return (x | (x >> 16)) & 0x00000000FFFFFFFF


def morton_of(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike) -> I64:
    """Morton codes (int64, shape as broadcast) of the tiles that hold the positions.

    A tile owns its south and west edge; longitude wraps at 180°, the north pole belongs to the northernmost row.

    Raises:
        GeodesyError: not finite, or a latitude beyond a pole.
    """
    u, v = tile_coordinates(lat_rad, lon_rad)
    lon_index = np.floor(u).astype(np.int64) % LON_TILES
    return interleave(lon_index, np.minimum(np.floor(v).astype(np.int64), LAT_TILES - 1))


@dataclass(frozen=True, slots=True, order=True)
class TileId:
    """One tile of the Earth; ordered along the Morton curve."""

    morton: int
    """0 … 2^39 - 1."""

    def __post_init__(self) -> None:
        if not isinstance(self.morton, int):
            raise TileError(f"tile id: expected int, got {type(self.morton).__name__} {self.morton!r}")
        if not 0 <= self.morton < LON_TILES * LAT_TILES:
            raise TileError(f"tile id {self.morton} is not in 0 … {LON_TILES * LAT_TILES - 1}")

    @classmethod
    def from_indices(cls, lon_index: int, lat_index: int) -> "TileId":
        """The tile at these indices.

        Raises:
            TileError: an index does not exist.
        """
        if not (0 <= lon_index < LON_TILES and 0 <= lat_index < LAT_TILES):
            raise TileError(f"tile indices ({lon_index}, {lat_index}) are not below ({LON_TILES}, {LAT_TILES})")
        return cls(int(interleave(lon_index, lat_index)))

    @classmethod
    def from_geodetic(cls, lat_rad: float, lon_rad: float) -> "TileId":
        """The tile that holds the position. Raises GeodesyError where there is none."""
        return cls(int(morton_of(lat_rad, lon_rad)))

    @classmethod
    def from_path(cls, path: str) -> "TileId":
        """The tile of a path such as "13033/03021/23031/22102".

        Raises:
            TileError: it is no path of a tile.
        """
        if not _PATH.fullmatch(path):
            raise TileError(f"{path!r:.80} is no tile path: four chunks of five digits 0-3, the first digit 0 or 1")
        return cls(int(path.replace("/", ""), 4))

    @property
    def lon_index(self) -> int:
        """East from 180° W: 0 … 2^20 - 1."""
        return int(deinterleave(self.morton)[0])

    @property
    def lat_index(self) -> int:
        """North from the south pole: 0 … 2^19 - 1."""
        return int(deinterleave(self.morton)[1])

    @property
    def path(self) -> str:
        """Four chunks of five base-4 digits."""
        return _path_of(self.morton)

    @property
    def district(self) -> "District":
        """The district of about 1.2 km that holds this tile."""
        return District(self.path[:17])

    @property
    def south_west_rad(self) -> tuple[float, float]:
        """(latitude, longitude) of the south-west corner."""
        return self._corner_rad(0.0)

    @property
    def north_east_rad(self) -> tuple[float, float]:
        """(latitude, longitude) of the north-east corner."""
        return self._corner_rad(1.0)

    @property
    def centre_rad(self) -> tuple[float, float]:
        """(latitude, longitude) of the centre."""
        return self._corner_rad(0.5)

    def neighbours(self) -> tuple["TileId", ...]:
        """The tiles around this one, sorted: 8, wrapping at the date line; 5 in the rows that touch a pole."""
        lon, lat = self.lon_index, self.lat_index
        steps = [(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1) if (i, j) != (0, 0) and 0 <= lat + j < LAT_TILES]
        return tuple(sorted(TileId.from_indices((lon + i) % LON_TILES, lat + j) for i, j in steps))

    def _corner_rad(self, part: float) -> tuple[float, float]:
        lat, lon = geodetic_of_tile_coordinates(self.lon_index + part, self.lat_index + part)
        return float(lat), float(lon)

    def __str__(self) -> str:
        return self.path


@lru_cache(maxsize=1 << 15)
def _path_of(morton: int) -> str:
    return "/".join(_CHUNKS[morton >> shift & 1023] for shift in (30, 20, 10, 0))


@dataclass(frozen=True, slots=True, order=True)
class District:
    """1024 tiles (32 x 32, about 1.2 km) that share the first fifteen digits of their paths: one change message."""

    path: str
    """Three chunks of five base-4 digits: "13033/03021/23031"."""

    def __post_init__(self) -> None:
        if not isinstance(self.path, str) or not _DISTRICT_PATH.fullmatch(self.path):
            raise TileError(
                f"{self.path!r:.80} is no district: three chunks of five digits 0-3, the first digit 0 or 1"
            )

    @property
    def first_morton(self) -> int:
        """Morton code of the south-west tile; the district's tiles are this code and the 1023 after it."""
        return int(self.path.replace("/", ""), 4) << _DISTRICT_SHIFT

    @property
    def centre_rad(self) -> tuple[float, float]:
        """(latitude, longitude) of the centre."""
        lon, lat = deinterleave(self.first_morton)
        centre_lat, centre_lon = geodetic_of_tile_coordinates(int(lon) + 16.0, int(lat) + 16.0)
        return float(centre_lat), float(centre_lon)

    def contains(self, tile: TileId) -> bool:
        """Whether the tile lies in this district."""
        return tile.morton >> _DISTRICT_SHIFT == self.first_morton >> _DISTRICT_SHIFT

    def tiles(self) -> Iterator[TileId]:
        """The 1024 tiles in Morton order."""
        return (TileId(self.first_morton + k) for k in range(1 << _DISTRICT_SHIFT))

    def __str__(self) -> str:
        return self.path


def covering_circle(lat_rad: float, lon_rad: float, radius_m: float) -> tuple[TileId, ...]:
    """The tiles within `radius_m` of a position (on the ellipsoid), sorted.

    Raises:
        TileError: the radius is negative or more than a million tiles would be needed (near a pole).
        GeodesyError: the position does not exist.
    """
    codes = _cover(np.array([lat_rad]), np.array([lon_rad]), radius_m)
    return tuple(TileId(int(code)) for code in codes)


def covering_corridor(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, half_width_m: float) -> tuple[TileId, ...]:
    """The tiles within `half_width_m` of a track (N,), (N,) whose points are joined by straight lines, sorted.

    Consecutive points may be any distance apart; a few tiles just beyond the edge (at most 0.1 m at 30 m) may be
    included.

    Raises:
        TileError: no points, a negative width, or more than a million tiles.
        GeodesyError: a position does not exist.
    """
    lat, lon = (
        np.atleast_1d(np.asarray(lat_rad, dtype=np.float64)),
        np.atleast_1d(np.asarray(lon_rad, dtype=np.float64)),
    )
    if lat.ndim != 1 or lat.shape != lon.shape or lat.size == 0:
        raise TileError(
            f"corridor: latitudes {lat.shape} and longitudes {lon.shape} must be equally many, at least one"
        )
    check_geodetic(lat, lon)
    codes = _cover(*_densified(lat, lon), float(np.hypot(half_width_m, 0.5 * _SAMPLE_M)))
    return tuple(TileId(int(code)) for code in codes)


def _densified(lat: F64, lon: F64) -> tuple[F64, F64]:
    """The track with points at most `_SAMPLE_M` apart."""
    step_m = np.linalg.norm(np.diff(ecef_from_geodetic(lat, lon, 0.0), axis=0), axis=1)
    pieces = np.maximum(1, np.ceil(step_m / _SAMPLE_M)).astype(np.int64)
    start = np.repeat(np.arange(len(pieces)), pieces)
    part = (np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / np.repeat(pieces, pieces)
    turn = np.remainder(np.diff(lon) + np.pi, 2.0 * np.pi) - np.pi  # the short way round, over the date line too
    return np.append(lat[start] + part * np.diff(lat)[start], lat[-1]), np.append(
        lon[start] + part * turn[start], lon[-1]
    )


def _cover(lat: F64, lon: F64, radius_m: float) -> I64:
    """Sorted Morton codes of the tiles within `radius_m` of any of the positions."""
    if not 0.0 <= radius_m < 1.0e6:
        raise TileError(f"radius {radius_m} m is not in 0 … 1000 km")
    u, v = tile_coordinates(lat, lon)
    east, north = _reach(lat, radius_m)
    if (2 * east + 1) * (2 * north + 1) > _MAX_COVER:
        raise TileError(
            f"a radius of {radius_m} m needs {(2 * east + 1) * (2 * north + 1)} tiles, more than {_MAX_COVER}"
        )
    at_once = max(1, _MAX_COVER // ((2 * east + 1) * (2 * north + 1)))
    found = [
        _near(lat[k : k + at_once], lon[k : k + at_once], u[k : k + at_once], v[k : k + at_once], east, north, radius_m)
        for k in range(0, len(lat), at_once)
    ]
    return np.unique(np.concatenate(found))


def _reach(lat: F64, radius_m: float) -> tuple[int, int]:
    """How many tiles east (west) and north (south) a circle of `radius_m` may touch, at the worst latitude."""
    worst = np.minimum(np.abs(lat).max() + radius_m / 6.3e6, np.pi / 2)
    width_m = float(normal_radius_m(worst) * np.cos(worst)) * TILE_RAD
    north = int(radius_m / (float(meridian_radius_m(0.0)) * TILE_RAD)) + 1
    return min(int(min(radius_m / max(width_m, 1e-9), LON_TILES)) + 1, LON_TILES // 2), north


def _near(lat: F64, lon: F64, u: F64, v: F64, east: int, north: int, radius_m: float) -> I64:
    """Morton codes of the tiles around some positions (P,) whose nearest point is within `radius_m`, some twice."""
    wide, high = np.meshgrid(np.arange(-east, east + 1), np.arange(-north, north + 1))
    i = np.floor(u).astype(np.int64)[:, None] + wide.ravel()
    j = np.floor(v).astype(np.int64)[:, None] + high.ravel()
    at, _ = inside = np.nonzero((j >= 0) & (j < LAT_TILES))
    i, j = i[inside], j[inside]
    nearest = geodetic_of_tile_coordinates(np.clip(u[at], i, i + 1), np.clip(v[at], j, j + 1))
    here = ecef_from_geodetic(lat, lon, 0.0)
    distance_m = np.linalg.norm(ecef_from_geodetic(*nearest, 0.0) - here[at], axis=-1)
    near = distance_m <= radius_m + 1e-9
    return interleave(i[near] % LON_TILES, j[near])
