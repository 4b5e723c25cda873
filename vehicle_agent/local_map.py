"""The map around the vehicle: a dense window of voxels over the tiles it holds.

One int32 a voxel: a Gaussian's row (>= 0), `EMPTY` where a held tile has none, `UNKNOWN` where no tile is held. Dense
because a ray or a point looks up one address: a typed dict was measured 12 to 17 times slower.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians, full_matrices, six_entries
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.errors import WindowTooLarge

EMPTY = -1
UNKNOWN = -(2**31)
MAX_WINDOW_VOXELS = 48_000_000  # 192 MB of int32: far above a street, far below the machine
FLOORS_BELOW = 3  # room for what is new under ...
FLOORS_ABOVE = 8  # ... and above the Gaussians that the map knows

Touched = Callable[[TileId], bool]
"""Whether there is evidence about a tile: it keeps its version until that is reported."""


@dataclass(frozen=True, slots=True)
class HeldTile:
    """One tile turned into the map frame.

    `box` its columns (see `tile_box`), `g` (N, 3) int32 global voxel coordinates, `mean_map_m` (N, 3) and `cov_m2`
    (N, 6: xx, xy, xz, yy, yz, zz) float64 along the map frame's axes. `absent`: the store has no such tile, so every
    voxel is known to be empty in the map. `made`: what others have made of its Gaussians, see `LocalMap.of_gaussians`.
    """

    tile: Tile
    absent: bool
    box: NDArray[np.int64]
    g: NDArray[np.int32]
    mean_map_m: NDArray[np.float64]
    cov_m2: NDArray[np.float64]
    made: dict[object, F64] = field(default_factory=dict)


class LocalMap:
    """Dense int32 window with the Gaussians of the tiles that were set; rebuilt at the first read after a change.

    Not safe for use by several threads at once: the agent's main thread owns it.
    """

    def __init__(self, grid_frame: GridFrame) -> None:
        self.grid_frame = grid_frame
        self.generation = 0
        self._held: dict[TileId, HeldTile] = {}
        self._floors: tuple[int, int] | None = None
        self._built = -1
        self._derived: dict[object, Any] = {}
        self._clear()

    def set_tile(self, tile: Tile) -> None:
        """Hold `tile`, replacing what was held under its id."""
        self._hold(held_tile(self.grid_frame, tile))

    def set_absent(self, tile_id: TileId) -> None:
        """Hold the knowledge that the store has no such tile: empty everywhere, version 0."""
        self._hold(held_tile(self.grid_frame, Tile(tile_id, 0, Gaussians.empty()), absent=True))

    def remove_tile(self, tile_id: TileId) -> None:
        """Forget a tile; its voxels become `UNKNOWN`. Not held: nothing happens."""
        if self._held.pop(tile_id, None) is not None:
            self.generation += 1

    def cover_floors(self, low: int, high: int) -> None:
        """Make the window reach at least the floors `low` ... `high` (where the map alone shows too little)."""
        floors = (low, high) if self._floors is None else (min(low, self._floors[0]), max(high, self._floors[1]))
        if floors != self._floors:
            self._floors = floors
            self.generation += 1

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile that is held (version 0 when absent in the store), or None."""
        held = self._held.get(tile_id)
        return None if held is None else held.tile

    def is_absent(self, tile_id: TileId) -> bool:
        """True when the store is known to have no such tile."""
        held = self._held.get(tile_id)
        return held is not None and held.absent

    @property
    def tiles(self) -> tuple[TileId, ...]:
        """The ids held, sorted."""
        return tuple(sorted(self._held))

    @property
    def tile_rows(self) -> dict[TileId, slice]:
        """Which rows of the Gaussian columns are a tile's, in the order of its voxel ids."""
        self._build()
        return self._tile_rows

    @property
    def index(self) -> NDArray[np.int32]:
        """(nx, ny, nz) int32: row of the Gaussian, `EMPTY` or `UNKNOWN`. Do not write."""
        self._build()
        return self._index

    @property
    def window_origin_g(self) -> NDArray[np.int64]:
        """(3,) int64: global voxel coordinates of index [0, 0, 0]."""
        self._build()
        return self._origin_g

    @property
    def mean_map_m(self) -> NDArray[np.float64]:
        """(M, 3) means, map frame, metres."""
        self._build()
        return self._mean

    @property
    def cov_m2(self) -> NDArray[np.float64]:
        """(M, 6) covariances xx, xy, xz, yy, yz, zz along the map frame's axes, square metres."""
        self._build()
        return self._cov

    @property
    def count(self) -> int:
        """M, the number of Gaussians held."""
        self._build()
        return len(self._mean)

    @property
    def derived(self) -> dict[object, Any]:
        """What others have made of the map as it is now, by key of their own; forgotten when it changes, so that nobody
        keeps a window of before.
        """
        self._build()
        return self._derived

    def of_gaussians(self, key: object, make: Callable[[F64], F64]) -> F64:
        """(M, ...) what `make` makes of covariances (N, 6), Gaussian by Gaussian; of each tile that is held once.

        Args:
            key: of what is made.
            make: gives (N, ...).
        """
        self._build()
        for held in self._held.values():
            if key not in held.made:
                held.made[key] = make(held.cov_m2)
        return np.concatenate([self._held[tile_id].made[key] for tile_id in self._tile_rows] or [make(self._cov)])

    def box_of(self, tile_id: TileId, origin_g: NDArray[np.int64] | None = None) -> tuple[slice, slice]:
        """The tile's columns along x and y in a window at `origin_g` (3,), by default in `index`."""
        origin = self.window_origin_g if origin_g is None else origin_g
        held = self._held.get(tile_id)
        low, high = (tile_box(self.grid_frame, tile_id) if held is None else held.box) - origin[:2]
        return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))

    def _hold(self, held: HeldTile) -> None:
        self._held[held.tile.tile_id] = held
        self.generation += 1

    def _clear(self) -> None:
        self._index = np.empty((0, 0, 0), np.int32)
        self._origin_g = np.zeros(3, np.int64)
        self._mean = np.empty((0, 3))
        self._cov = np.empty((0, 6))
        self._tile_rows: dict[TileId, slice] = {}

    def _build(self) -> None:
        if self._built == self.generation:
            return
        self._built = self.generation
        self._derived.clear()
        if not self._held:
            self._clear()
            return
        held = [self._held[t] for t in self.tiles]
        self._origin_g, shape = self._extent(held)
        self._index = np.empty((0, 0, 0), np.int32)  # two windows are never held at once
        self._index = np.full(shape, UNKNOWN, np.int32)
        self._mean = np.concatenate([h.mean_map_m for h in held])
        self._cov = np.concatenate([h.cov_m2 for h in held])
        self._tile_rows = {}
        self._place(held)

    def _place(self, held: list[HeldTile]) -> None:
        first = 0
        for one in held:
            tile_id, n = one.tile.tile_id, len(one.g)
            (x0, y0), (x1, y1) = one.box - self._origin_g[:2]
            self._index[x0:x1, y0:y1] = EMPTY
            at = one.g - self._origin_g
            self._index[at[:, 0], at[:, 1], at[:, 2]] = np.arange(first, first + n, dtype=np.int32)
            self._tile_rows[tile_id] = slice(first, first + n)
            first += n

    def _extent(self, held: list[HeldTile]) -> tuple[NDArray[np.int64], tuple[int, int, int]]:
        """Origin and shape of the box of all held tiles, with room above and below."""
        boxes = np.array([h.box for h in held])
        low, high = self._floor_range(held)
        origin = np.array([*boxes[:, 0].min(axis=0), low])
        shape = np.array([*boxes[:, 1].max(axis=0), high + 1]) - origin
        if int(np.prod(shape)) > MAX_WINDOW_VOXELS:
            raise WindowTooLarge(
                f"{len(held)} tiles span {shape[0]} x {shape[1]} x {shape[2]} voxels; the limit is {MAX_WINDOW_VOXELS}."
                " Remove tiles that were left behind."
            )
        return origin, (int(shape[0]), int(shape[1]), int(shape[2]))

    def _floor_range(self, held: list[HeldTile]) -> tuple[int, int]:
        spans = [(int(h.g[:, 2].min()) - FLOORS_BELOW, int(h.g[:, 2].max()) + FLOORS_ABOVE) for h in held if len(h.g)]
        if self._floors is not None:
            spans.append(self._floors)
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0, 0)


def tile_box(grid_frame: GridFrame, tile_id: TileId) -> NDArray[np.int64]:
    """((x0, y0), (x1, y1)) int64: the tile's columns in global voxel coordinates, upper bound exclusive."""
    south_west = VoxelGrid.of(tile_id).voxel_id([0], [0], [0])
    low = grid_frame.grid_of_voxel(tile_id, south_west)[0, :2]
    return np.stack([low, low + np.array([grid_frame.nx, grid_frame.ny])])


def held_tile(grid_frame: GridFrame, tile: Tile, *, absent: bool = False) -> HeldTile:
    """Turn a tile's columns (voxel centres, tile ENU axes) into the map frame."""
    gaussians = tile.gaussians
    T_map_tile = grid_frame.frame.T_self_other(LocalFrame.of_tile(tile.tile_id))
    R_map_tile = T_map_tile[:3, :3]
    p_tile = VoxelGrid.of(tile.tile_id).centre_m(gaussians.voxel_id) + gaussians.mean_m
    return HeldTile(
        tile=tile,
        absent=absent,
        box=tile_box(grid_frame, tile.tile_id),
        g=np.asarray(grid_frame.grid_of_voxel(tile.tile_id, gaussians.voxel_id), np.int32).reshape(-1, 3),
        mean_map_m=p_tile @ R_map_tile.T + T_map_tile[:3, 3],
        cov_m2=six_entries(R_map_tile @ full_matrices(gaussians.cov_m2) @ R_map_tile.T),
    )
