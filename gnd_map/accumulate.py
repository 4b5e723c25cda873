"""Points into voxels: moments and occupied sub-cells of every voxel that a point falls into. The one rule for map and
vehicle.

A voxel holds a Gaussian when at least N_MIN_CELLS of its 10 x 10 x 10 sub-cells are occupied: raw counts depend on the
sensor and on how slowly it passed, occupied cells hardly do. The moments use all points.

Voxels are found through an open-addressing hash that grows; a voxel costs about 240 bytes. Points in any tile of the
grid's band of latitude are taken, whether or not the grid frame was made for that tile; points outside the band are
counted in `ignored`.
"""

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I32, I64, U8, points_3d
from gnd.gnd_map.gaussian import Gaussians, Moments, full_matrices, six_entries
from gnd.gnd_map.geodesy import enu_axes
from gnd.gnd_map.grid import MAX_HEIGHT_M, GridFrame, tile_axes
from gnd.gnd_map.jit import bare, bare_inlined
from gnd.gnd_map.near_grid import expansion_about, grid_near, near_grid_of
from gnd.gnd_map.tile_id import TileId

N_MIN_CELLS = 20
CELLS_A_SIDE = 10
_WORDS = 16  # 1024 bits for 1000 sub-cells
_SPAN = 1 << 20  # voxels around the frame's origin that a key can name, each way
_FIRST_VOXELS = 1 << 12
_EMPTY = -1


class VoxelAccumulator:
    """Collects points of one grid frame; how points are split over calls changes results by less than 1 µm."""

    def __init__(self, grid_frame: GridFrame) -> None:
        self.grid_frame = grid_frame
        self.ignored = 0
        """Points so far that lie outside the grid's band of latitude, 100 km up or down, or about 1000 km away."""
        first, last = grid_frame.lat_index_range
        origin = np.floor(grid_frame.grid_of(np.zeros((1, 3)))[0]).astype(np.int64)
        low = np.array([origin[0] - _SPAN, max(first * grid_frame.ny, origin[1] - _SPAN), int(-MAX_HEIGHT_M)])
        high = np.array([origin[0] + _SPAN, min((last + 1) * grid_frame.ny, origin[1] + _SPAN), int(MAX_HEIGHT_M)])
        self._key_origin = np.array([origin[0] - _SPAN, origin[1] - _SPAN, -_SPAN])
        self._bounds = np.stack([low, high])
        self._used = 0
        self._table = np.full(2 * _FIRST_VOXELS, _EMPTY, dtype=np.int32)
        self._key = np.empty(_FIRST_VOXELS, dtype=np.int64)
        self._count = np.zeros(_FIRST_VOXELS, dtype=np.int64)
        self._cells = np.zeros(_FIRST_VOXELS, dtype=np.int32)
        self._bits = np.zeros((_FIRST_VOXELS, _WORDS), dtype=np.uint64)
        self._sums = np.zeros((_FIRST_VOXELS, 9))

    def __len__(self) -> int:
        """Voxels with at least one point."""
        return self._used

    def add(self, points_map_m: npt.ArrayLike) -> None:
        """Take points (N, 3), metres, map frame.

        Raises:
            ShapeError: wrong shape, or a point that is not finite; nothing is taken then.
        """
        self.add_grid(grid_near(self.grid_frame, points_3d("points_map_m", points_map_m)))

    def add_grid(self, g: F64) -> None:
        """Take points whose grid coordinates (N, 3) are known, C-contiguous float64 and finite."""
        done = 0
        while done < len(g):
            if self._used >= len(self._key):
                self._grow()
            done, self._used, ignored = _accumulate(
                g, done, self._bounds, self._key_origin, self._used, self._table, self._key, self._count, self._cells,
                self._bits, self._sums,
            )  # fmt: skip
            self.ignored += ignored

    def add_marked(self, points_map_m: F64, marks: U8) -> None:
        """As `add`, of the points (N, 3), C-contiguous float64, whose mark (N,) is not 0; nothing is copied."""
        near, done = expansion_about(self.grid_frame, points_map_m, marks), 0
        if near is None:
            self.add(points_map_m[marks != 0])
            return
        while done < len(points_map_m):
            if self._used >= len(self._key):
                self._grow()
            done, self._used, ignored = _accumulate_marked(
                points_map_m, marks, *near, done, self._bounds, self._key_origin, self._used, self._table, self._key,
                self._count, self._cells, self._bits, self._sums,
            )  # fmt: skip
            self.ignored += ignored

    def _grow(self) -> None:
        """Room for twice as many voxels."""
        self._resize(np.arange(self._used), 2 * len(self._key))

    def _resize(self, rows: I64, room: int) -> None:
        """Keep only these rows, in this order, with room for `room`."""
        self._used = len(rows)
        self._key, self._count, self._cells, self._bits, self._sums = (
            np.concatenate([old[rows], np.zeros((room - len(rows), *old.shape[1:]), old.dtype)])
            for old in (self._key, self._count, self._cells, self._bits, self._sums)
        )
        self._table = np.full(2 * room, _EMPTY, dtype=np.int32)
        _rehash(self._table, self._key, self._used)

    def moments(self) -> tuple[I32, Moments]:
        """All voxels with points: integer grid coordinates (M, 3) int32 and their moments, sorted by gx, gy, gz."""
        key = self._key[: self._used]
        order = np.argsort(key)
        g = _split_key(key[order]) + self._key_origin
        sums = self._sums[: self._used][order]
        in_metres = _tile_axes_in_metres(self.grid_frame, g)
        total = np.einsum("nij,nj->ni", in_metres, sums[:, :3])
        outer = in_metres @ full_matrices(sums[:, 3:]) @ np.swapaxes(in_metres, 1, 2)
        count, cells = self._count[: self._used][order], self._cells[: self._used][order]
        return g.astype(np.int32), Moments(count, cells, total, six_entries(outer))

    def occupied(self) -> tuple[I32, npt.NDArray[np.uint64]]:
        """All voxels with points: integer grid coordinates (M, 3) int32 and their sub-cells (M, 16) uint64, sorted.

        Bit (z * 10 + y) * 10 + x, counted from the lowest of the first word, says whether that sub-cell holds a point.
        """
        key = self._key[: self._used]
        order = np.argsort(key)
        return (_split_key(key[order]) + self._key_origin).astype(np.int32), self._bits[: self._used][order]

    def finish(self, n_min_cells: int = N_MIN_CELLS) -> dict[TileId, Gaussians]:
        """The Gaussians of all voxels with at least `n_min_cells` occupied sub-cells, by tile, in Morton order.

        The accumulator stays as it is and may take more points.
        """
        g, moments = self.moments()
        dense = np.flatnonzero(moments.cells >= n_min_cells)
        return gaussians_by_tile(self.grid_frame, g[dense], moments.take(dense))

    def pop(self, tiles: Collection[TileId], n_min_cells: int = N_MIN_CELLS) -> dict[TileId, Gaussians]:
        """As `finish`, but of `tiles` only, and all their voxels are forgotten: bounded memory on a long drive."""
        g, moments = self.moments()
        morton, _ = self.grid_frame.tile_voxel_of(g)
        going = np.isin(morton, [tile.morton for tile in tiles])
        staying = np.argsort(self._key[: self._used])[~going]
        self._resize(np.sort(staying), max(_FIRST_VOXELS, 1 << len(staying).bit_length()))
        dense = np.flatnonzero(going & (moments.cells >= n_min_cells))
        return gaussians_by_tile(self.grid_frame, g[dense], moments.take(dense))


def gaussians_by_tile(grid_frame: GridFrame, g: I32, moments: Moments) -> dict[TileId, Gaussians]:
    """Gaussians of voxels at integer grid coordinates (M, 3), each once, grouped by tile in Morton order."""
    morton, voxel_id = grid_frame.tile_voxel_of(g)
    order = np.argsort(morton, kind="stable")
    codes, starts = np.unique(morton[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(codes) else []
    return {
        TileId(int(code)): moments.take(rows).to_gaussians(voxel_id[rows])
        for code, rows in zip(codes, groups, strict=True)
    }


def _tile_axes_in_metres(grid_frame: GridFrame, g: I64) -> F64:
    """(M, 3, 3) matrices from offsets in voxel fractions to metres along the axes of the voxel's tile."""
    lat, lon, _ = grid_frame.geodetic_of_grid(g + 0.5)
    morton, _ = grid_frame.tile_voxel_of(g)
    R_tile_local = np.swapaxes(tile_axes(morton), 1, 2) @ enu_axes(lat, lon)
    return np.asarray(R_tile_local * grid_frame.metres_per_step(g + 0.5)[:, None, :])


def _split_key(key: I64) -> I64:
    """(M, 3) coordinates relative to the key origin: 21 bits each."""
    mask = (1 << 21) - 1
    return np.stack([key >> 42, (key >> 21) & mask, key & mask], axis=-1)


@bare_inlined
def _slot_of(table: I32, keys: I64, key: np.int64) -> np.uint64:
    """Slot of the table that holds `key`, or the free one where it belongs (Fibonacci hash, linear probing)."""
    mask = np.uint64(table.shape[0] - 1)
    slot = ((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + np.uint64(1)) & mask
    return slot


@bare
def _rehash(table: I32, keys: I64, used: int) -> None:
    """Fill an empty table with the rows 0 … used-1."""
    for row in range(used):
        table[_slot_of(table, keys, keys[row])] = row


@bare
def _accumulate(
    g: F64,
    start: int,
    bounds: I64,
    key_origin: I64,
    used: int,
    table: I32,
    keys: I64,
    count: I64,
    cells: I32,
    bits: npt.NDArray[np.uint64],
    sums: F64,
) -> tuple[int, int, int]:
    """Add g[start:] until all is done or there is no row left; returns (next point, rows used, points ignored)."""
    ignored = 0
    last_key, row = np.int64(-1), np.int64(-1)
    for i in range(start, g.shape[0]):
        key = _key_of(g[i, 0], g[i, 1], g[i, 2], bounds, key_origin)
        if key < 0:
            ignored += 1
            continue
        if key != last_key:
            row, used = _row_of(key, used, table, keys)
            if row < 0:
                return i, used, ignored
            last_key = key
        _take(
            row, g[i, 0] - np.floor(g[i, 0]), g[i, 1] - np.floor(g[i, 1]), g[i, 2] - np.floor(g[i, 2]),
            count, cells, bits, sums,
        )  # fmt: skip
    return g.shape[0], used, ignored


@bare
def _accumulate_marked(
    points: F64, marks: U8, middle: F64, R_local_map: F64, g_middle: F64, steps: F64, curvature: F64, start: int,
    bounds: I64, key_origin: I64, used: int, table: I32, keys: I64, count: I64, cells: I32,
    bits: npt.NDArray[np.uint64], sums: F64,
) -> tuple[int, int, int]:  # fmt: skip
    """As `_accumulate`, of the marked points from `start` on, whose grid coordinates are found on the way."""
    ignored = 0
    last_key, row = np.int64(-1), np.int64(-1)
    for i in range(start, points.shape[0]):
        if not marks[i]:
            continue
        x, y, z = near_grid_of(
            points[i, 0], points[i, 1], points[i, 2], middle, R_local_map, g_middle, steps, curvature
        )
        key = _key_of(x, y, z, bounds, key_origin)
        if key < 0:
            ignored += 1
            continue
        if key != last_key:
            row, used = _row_of(key, used, table, keys)
            if row < 0:
                return i, used, ignored
            last_key = key
        _take(row, x - np.floor(x), y - np.floor(y), z - np.floor(z), count, cells, bits, sums)
    return points.shape[0], used, ignored


@bare_inlined
def _key_of(x: float, y: float, z: float, bounds: I64, key_origin: I64) -> np.int64:
    """Key of the voxel of grid coordinates; -1 outside `bounds` (2, 3)."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    if (
        fx < bounds[0, 0] or fy < bounds[0, 1] or fz < bounds[0, 2]
        or fx >= bounds[1, 0] or fy >= bounds[1, 1] or fz >= bounds[1, 2]
    ):  # fmt: skip
        return np.int64(-1)
    kx, ky, kz = np.int64(fx) - key_origin[0], np.int64(fy) - key_origin[1], np.int64(fz) - key_origin[2]
    return np.int64((kx << 42) | (ky << 21) | kz)


@bare_inlined
def _row_of(key: np.int64, used: int, table: I32, keys: I64) -> tuple[np.int64, int]:
    """Row of a voxel, made if it has none, and the rows used then; -1 where there is no row left."""
    slot = _slot_of(table, keys, key)
    if table[slot] < 0:
        if used >= keys.shape[0]:
            return np.int64(-1), used
        table[slot] = used
        keys[used] = key
        used += 1
    return np.int64(table[slot]), used


@bare_inlined
def _take(
    row: np.int64,
    px: float,
    py: float,
    pz: float,
    count: I64,
    cells: I32,
    bits: npt.NDArray[np.uint64],
    sums: F64,
) -> None:
    """One point at fractions (0 … 1) of its voxel: mark its sub-cell, add its moments about the voxel's centre."""
    cx, cy, cz = min(int(px * 10.0), 9), min(int(py * 10.0), 9), min(int(pz * 10.0), 9)
    cell = (cz * 10 + cy) * 10 + cx
    word, bit = cell >> 6, np.uint64(1) << np.uint64(cell & 63)
    if not bits[row, word] & bit:
        bits[row, word] |= bit
        cells[row] += 1
    count[row] += 1
    x, y, z = px - 0.5, py - 0.5, pz - 0.5
    s = sums[row]
    s[0] += x
    s[1] += y
    s[2] += z
    s[3] += x * x
    s[4] += x * y
    s[5] += x * z
    s[6] += y * y
    s[7] += y * z
    s[8] += z * z
