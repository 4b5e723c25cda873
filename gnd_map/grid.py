"""GND voxels: every tile cut into nx x ny columns of equal angles and into floors of 1 m of ellipsoidal height (GND,
Figure 2).

nx = ceil(width), ny = ceil(height) of the tile in metres at its middle latitude: nominally 1 m, never larger, always
dividing the tile. One integer a voxel at every latitude: row-major from the south-west, half a floor subtracted, floors
stacked up and down from sea level:

    voxel_id = floor·nx·ny + iy·nx + ix - (nx·ny) // 2

In Figure 2 (nx, ny = 31, 39) the sea-level floor runs from -604 to 604. The rule lives in geodetic coordinates, so
tiles meet without gaps. `GridFrame` is the same grid over a whole stretch of road, in one metric frame. See
docs/frames.md.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I32, I64, check_array, points_3d
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.geodesy import (
    LocalFrame,
    enu_axes,
    meridian_radius_m,
    normal_radius_m,
)
from gnd.gnd_map.tile_id import (
    LAT_TILES,
    LON_TILES,
    TILE_RAD,
    TileId,
    deinterleave,
    geodetic_of_tile_coordinates,
    interleave,
    tile_coordinates,
)

VOXEL_M = 1.0
MAX_HEIGHT_M = 100_000.0  # keeps every voxel id inside int32 with room to spare
_EDGE = 1e-9  # of a tile (40 nm): rounding of positions on a tile's edge


def divisions(lat_index: npt.ArrayLike) -> tuple[I64, I64]:
    """Voxels a tile has along longitude and latitude, (nx, ny) int64 arrays, for latitude indices."""
    lat, _ = geodetic_of_tile_coordinates(0.0, np.asarray(lat_index) + 0.5)
    width_m = normal_radius_m(lat) * np.cos(lat) * TILE_RAD
    height_m = meridian_radius_m(lat) * TILE_RAD
    nx, ny = np.ceil(width_m / VOXEL_M), np.ceil(height_m / VOXEL_M)
    return np.maximum(nx, 1.0).astype(np.int64), np.maximum(ny, 1.0).astype(np.int64)


@lru_cache(maxsize=1)
def _divisions_table() -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """(nx, ny) of every latitude index, at most 39; one table, so that no two callers round differently."""
    nx, ny = divisions(np.arange(LAT_TILES))
    return nx.astype(np.uint8), ny.astype(np.uint8)


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """The voxels of one tile. Make it with `VoxelGrid.of`."""

    tile: TileId
    nx: int
    """Columns along longitude."""
    ny: int
    """Rows along latitude."""
    dx_m: float
    """Width of a voxel at the tile's middle latitude on the ellipsoid."""
    dy_m: float
    """Depth of a voxel on the ellipsoid."""
    dz_m: float = VOXEL_M
    """Height of a floor."""

    @staticmethod
    def of(tile: TileId) -> "VoxelGrid":
        """The grid of a tile (cached)."""
        return _grid_of_tile(tile)

    @property
    def frame(self) -> LocalFrame:
        """The tile's frame: ENU at its centre on the ellipsoid."""
        return LocalFrame.of_tile(self.tile)

    def voxel_id(self, ix: npt.ArrayLike, iy: npt.ArrayLike, floor: npt.ArrayLike) -> I32:
        """Ids (int32) of voxels at column ix (from west), row iy (from south) and floor (from sea level).

        Raises:
            TileError: a column or row is not in the tile, or a floor is beyond 100 km.
        """
        i, j, k = (np.asarray(x, dtype=np.int64) for x in (ix, iy, floor))
        _check_range("ix", i, 0, self.nx - 1)
        _check_range("iy", j, 0, self.ny - 1)
        _check_range("floor", k, -int(MAX_HEIGHT_M), int(MAX_HEIGHT_M))
        return join_voxel_id(i, j, k, self.nx, self.ny)

    def unravel(self, voxel_id: npt.ArrayLike) -> tuple[I64, I64, I64]:
        """Column ix, row iy and floor (int64) of voxel ids; the inverse of `voxel_id`."""
        return split_voxel_id(voxel_id, self.nx, self.ny)

    def voxel_of(self, lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, height_m: npt.ArrayLike) -> I32:
        """Ids (int32) of the voxels that hold positions in this tile. A voxel owns its west, south and lower face.

        Raises:
            TileError: a position lies outside the tile, or a height beyond 100 km.
            GeodesyError: a position does not exist.
        """
        u, v = tile_coordinates(lat_rad, lon_rad)
        part_x = _wrapped(u - (self.tile.lon_index + 0.5)) + 0.5
        part_y = v - self.tile.lat_index
        _check_range("fraction of longitude in the tile", part_x, -_EDGE, 1.0 + _EDGE)
        _check_range("fraction of latitude in the tile", part_y, -_EDGE, 1.0 + _EDGE)
        ix = np.clip(np.floor(self.nx * part_x), 0, self.nx - 1)
        iy = np.clip(np.floor(self.ny * part_y), 0, self.ny - 1)
        return self.voxel_id(ix, iy, np.floor(np.asarray(height_m, dtype=np.float64) / VOXEL_M))

    def centre_geodetic(self, voxel_id: npt.ArrayLike) -> tuple[F64, F64, F64]:
        """Latitude, longitude (radians) and ellipsoidal height (metres) of voxel centres."""
        ix, iy, floor = self.unravel(voxel_id)
        u = self.tile.lon_index + (ix + 0.5) / self.nx
        lat, lon = geodetic_of_tile_coordinates(u, self.tile.lat_index + (iy + 0.5) / self.ny)
        return lat, lon, np.asarray((floor + 0.5) * VOXEL_M, dtype=np.float64)

    def centre_m(self, voxel_id: npt.ArrayLike) -> F64:
        """(..., 3) voxel centres in metres in the tile's frame (ENU at its centre on the ellipsoid)."""
        return self.frame.enu_from_geodetic(*self.centre_geodetic(voxel_id))


@lru_cache(maxsize=65536)
def _grid_of_tile(tile: TileId) -> VoxelGrid:
    table_x, table_y = _divisions_table()
    nx, ny = int(table_x[tile.lat_index]), int(table_y[tile.lat_index])
    lat, _ = tile.centre_rad
    width_m = float(normal_radius_m(lat) * np.cos(lat)) * TILE_RAD
    return VoxelGrid(tile, nx, ny, width_m / nx, float(meridian_radius_m(lat)) * TILE_RAD / ny)


def join_voxel_id(ix: I64, iy: I64, floor: I64, nx: int, ny: int) -> I32:
    """The rule of the module's head, unchecked."""
    return np.asarray(floor * (nx * ny) + iy * nx + ix - (nx * ny) // 2).astype(np.int32)


def split_voxel_id(voxel_id: npt.ArrayLike, nx: int, ny: int) -> tuple[I64, I64, I64]:
    """Column, row and floor (int64) of voxel ids in a grid of nx x ny."""
    floor, rest = np.divmod(np.asarray(voxel_id, dtype=np.int64) + (nx * ny) // 2, nx * ny)
    return rest % nx, rest // nx, floor


def _check_range(name: str, values: npt.NDArray[np.generic], low: float, high: float) -> None:
    if values.size and not ((values >= low) & (values <= high)).all():  # type: ignore[operator]
        raise TileError(f"{name}: {values.min()} … {values.max()} is not in {low} … {high}")


def _wrapped(du: npt.ArrayLike) -> F64:
    """Differences of tile coordinates along longitude, the short way round: in [-2^19, 2^19)."""
    return np.remainder(np.asarray(du) + 0.5 * LON_TILES, LON_TILES) - 0.5 * LON_TILES


def zones(tiles: Iterable[TileId]) -> dict[tuple[int, int], tuple[TileId, ...]]:
    """Tiles grouped by their (nx, ny), sorted: one `GridFrame` fits one group. A zone is a band of latitude, often 100
    km and more wide.
    """
    groups: dict[tuple[int, int], list[TileId]] = {}
    for tile in sorted(tiles):
        grid = VoxelGrid.of(tile)
        groups.setdefault((grid.nx, grid.ny), []).append(tile)
    return {key: tuple(group) for key, group in sorted(groups.items())}


@dataclass(frozen=True, slots=True)
class GridFrame:
    """The voxels of a stretch of road in one metric frame, the map frame (ENU, `frame`).

    Global grid coordinates g = (gx, gy, gz): gx = lon_index·nx + ix, gy = lat_index·ny + iy, gz = floor, continuous
    inside a voxel, so voxel (i, j, k) is [i, i+1) x [j, j+1) x [k, k+1). Along longitude they are unwrapped around the
    frame's origin: past the date line gx runs on below 0 or above 2^20·nx.
    """

    frame: LocalFrame
    """The map frame."""
    nx: int
    """Voxels a tile along longitude, the same for all tiles here."""
    ny: int
    """Voxels a tile along latitude."""
    tiles: tuple[TileId, ...] = field(repr=False)
    """The tiles that the frame was made for, sorted."""

    @classmethod
    def around(cls, frame: LocalFrame, tiles: Iterable[TileId]) -> "GridFrame":
        """The grid of `tiles` in the map frame `frame`.

        Raises:
            TileError: no tiles, tiles of more than one (nx, ny): split them with `zones`, or on both hemispheres.
        """
        groups = zones(set(tiles))
        if len(groups) != 1:
            found = ", ".join(f"{nx} x {ny} in {len(group)} tiles" for (nx, ny), group in groups.items())
            raise TileError(f"a grid frame needs tiles of one kind, got {found or 'no tiles'}; group them with zones()")
        ((nx, ny), group) = next(iter(groups.items()))
        first, last = _band(group[0].lat_index)
        _check_range("latitude index of the tiles", np.array([tile.lat_index for tile in group]), first, last)
        return cls(frame, nx, ny, group)

    @property
    def lat_index_range(self) -> tuple[int, int]:
        """First and last latitude index of the band around the tiles in which (nx, ny) holds."""
        return _band(self.tiles[0].lat_index)

    @property
    def u_origin(self) -> float:
        """Continuous tile coordinate of the frame's origin along longitude; gx is unwrapped around it."""
        return _u_of(self.frame)

    def grid_of(self, points_map_m: npt.ArrayLike) -> F64:
        """(N, 3) exact grid coordinates of points (N, 3) in metres in the map frame.

        Raises:
            ShapeError: wrong shape or not finite.
        """
        lat, lon, height = self.frame.geodetic_from_enu(points_3d("points_map_m", points_map_m))
        return self.grid_of_geodetic(lat, lon, height)

    def grid_of_geodetic(self, lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, height_m: npt.ArrayLike) -> F64:
        """(N, 3) grid coordinates of geodetic positions (N,)."""
        u, v = tile_coordinates(lat_rad, lon_rad)
        u = self.u_origin + _wrapped(u - self.u_origin)
        height = np.asarray(height_m, dtype=np.float64) / VOXEL_M
        return np.stack(np.broadcast_arrays(u * self.nx, v * self.ny, height), axis=-1)

    def geodetic_of_grid(self, g: npt.ArrayLike) -> tuple[F64, F64, F64]:
        """Latitude, longitude (unwrapped, radians) and height (metres) of grid coordinates (..., 3)."""
        grid = np.asarray(g, dtype=np.float64)
        lat, lon = geodetic_of_tile_coordinates(grid[..., 0] / self.nx, grid[..., 1] / self.ny)
        return lat, lon, grid[..., 2] * VOXEL_M

    def map_of_grid(self, g: npt.ArrayLike) -> F64:
        """(..., 3) points in metres in the map frame of grid coordinates (..., 3); the inverse of `grid_of`."""
        return self.frame.enu_from_geodetic(*self.geodetic_of_grid(g))

    def centre_map_m(self, g: npt.NDArray[np.integer]) -> F64:
        """(N, 3) centres, in metres in the map frame, of voxels at integer grid coordinates (N, 3)."""
        return self.map_of_grid(np.asarray(g) + 0.5)

    def tile_voxel_of(self, g: npt.NDArray[np.integer]) -> tuple[I64, I32]:
        """Morton codes (N,) int64 and voxel ids (N,) int32 of integer grid coordinates (N, 3).

        Raises:
            TileError: a voxel lies outside the band of latitude in which this grid holds, or beyond 100 km of height.
        """
        grid = np.asarray(g, dtype=np.int64)
        check_array("g", grid, np.int64, (None, 3))
        lon_index, ix = np.divmod(grid[:, 0], self.nx)
        lat_index, iy = np.divmod(grid[:, 1], self.ny)
        _check_range("latitude index of the grid", lat_index, *self.lat_index_range)
        _check_range("floor", grid[:, 2], -MAX_HEIGHT_M, MAX_HEIGHT_M)
        return interleave(lon_index % LON_TILES, lat_index), join_voxel_id(ix, iy, grid[:, 2], self.nx, self.ny)

    def grid_of_voxel(self, tile: TileId, voxel_id: npt.ArrayLike) -> I64:
        """(N, 3) integer grid coordinates of voxels (N,) of a tile; the inverse of `tile_voxel_of`.

        Raises:
            TileError: the tile has other voxels than this grid.
        """
        grid = VoxelGrid.of(tile)
        if (grid.nx, grid.ny) != (self.nx, self.ny):
            raise TileError(
                f"tile {tile} has {grid.nx} x {grid.ny} voxels, this grid {self.nx} x {self.ny}; see zones()"
            )
        ix, iy, floor = grid.unravel(voxel_id)
        centre = tile.lon_index + 0.5
        lon_index = round(self.u_origin + float(_wrapped(centre - self.u_origin)) - 0.5)
        return np.stack([lon_index * self.nx + ix, tile.lat_index * self.ny + iy, floor], axis=-1)

    def metres_per_step(self, g: npt.ArrayLike) -> F64:
        """(..., 3) metres east, north and up that one step of gx, gy, gz makes at grid coordinates (..., 3)."""
        lat, _, height = self.geodetic_of_grid(g)
        east = (normal_radius_m(lat) + height) * np.cos(lat) * (TILE_RAD / self.nx)
        north = (meridian_radius_m(lat) + height) * (TILE_RAD / self.ny)
        return np.stack([east, north, np.full_like(east, VOXEL_M)], axis=-1)

    def affine(self, p_map_m: npt.ArrayLike) -> tuple[F64, F64]:
        """A (3, 3) and b (3,): grid coordinates g = A @ p + b near the point `p_map_m` (3,) of the map frame.

        The tangent of the exact map. At the distance d each coordinate is off by at most d²/(2·R·cos lat): below 1 mm
        within 100 m up to 38° of latitude, 1.2 mm at 49°, 1.6 mm at 60°. Rays stay straight under it; `near_grid` is
        the curved version.
        """
        p = np.asarray(p_map_m, dtype=np.float64)
        check_array("p_map_m", p, np.float64, (3,))
        g = self.grid_of(p[None, :])[0]
        lat, lon, _ = self.geodetic_of_grid(g)
        R_map_local = self.frame.R_ecef_enu.T @ enu_axes(lat, lon)
        A = (R_map_local / self.metres_per_step(g)).T
        return A, g - A @ p


@lru_cache(maxsize=1024)
def _u_of(frame: LocalFrame) -> float:
    return float(tile_coordinates(frame.lat_rad, frame.lon_rad)[0])


@lru_cache(maxsize=1024)
def _band(lat_index: int) -> tuple[int, int]:
    """First and last latitude index around `lat_index` with its (nx, ny)."""
    nx, ny = _divisions_table()
    other = np.flatnonzero((nx != nx[lat_index]) | (ny != ny[lat_index]))
    after = int(np.searchsorted(other, lat_index))
    first = int(other[after - 1]) + 1 if after > 0 else 0
    return first, int(other[after]) - 1 if after < len(other) else LAT_TILES - 1


def tile_axes(morton: npt.ArrayLike) -> F64:
    """R_ecef_tile (..., 3, 3): the ENU axes of tiles at their centres."""
    lon_index, lat_index = deinterleave(morton)
    return enu_axes(*geodetic_of_tile_coordinates(lon_index + 0.5, lat_index + 0.5))
