"""The points that new Gaussians are made of: the map's own accumulator, able to let finished tiles go."""

from collections.abc import Collection

import numpy as np

from gnd_map.accumulate import VoxelAccumulator, gaussians_by_tile
from gnd_map.arrays import I64, Array
from gnd_map.gaussian import Gaussians
from gnd_map.tile_id import TileId

_LEAST_ROOM = 1 << 11


class NewPoints(VoxelAccumulator):
    """Points of blocked rays by voxel; what is popped is forgotten, so that a long drive needs bounded memory."""

    def pop(self, tiles: Collection[TileId]) -> dict[TileId, Gaussians]:
        """Every voxel of `tiles` with at least one point, as Gaussians by tile; the accumulator forgets them."""
        g, moments = self.moments()
        morton, _ = self.grid_frame.tile_voxel_of(g)
        chosen = np.isin(morton, [tile.morton for tile in tiles])
        self._keep(np.sort(np.argsort(self._key[: self._used])[~chosen]))
        return gaussians_by_tile(self.grid_frame, g[chosen], moments.take(chosen))

    def _keep(self, rows: I64) -> None:
        """Forget all rows but these; `_grow` fills the hash table again."""
        room = max(_LEAST_ROOM, 1 << len(rows).bit_length())
        self._used = len(rows)
        self._table = np.empty(4 * room, np.int32)
        self._key = _padded(self._key[rows], room)
        self._count = _padded(self._count[rows], room)
        self._cells = _padded(self._cells[rows], room)
        self._bits = _padded(self._bits[rows], room)
        self._sums = _padded(self._sums[rows], room)
        self._grow()


def _padded(array: Array, room: int) -> Array:
    """`array` with zeros behind it up to `room` rows."""
    return np.concatenate([array, np.zeros((room - len(array), *array.shape[1:]), array.dtype)])
