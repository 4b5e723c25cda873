"""Small maps to export."""

import numpy as np

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId

TILE = TileId.from_geodetic(np.radians(49.01), np.radians(8.43))


def some_tile(seed: int, tile: TileId = TILE, floor: int = 115) -> Tile:
    """Gaussians of all shapes: patches, lines, points, blobs."""
    rng = np.random.default_rng(seed)
    n, grid = 200, VoxelGrid.of(tile)
    ids = np.unique(
        grid.voxel_id(rng.integers(0, grid.nx, n), rng.integers(0, grid.ny, n), rng.integers(floor, floor + 6, n))
    )
    sd = rng.choice([0.0, 0.004, 0.03, 0.15, 0.29], (len(ids), 3))
    R = np.linalg.qr(rng.normal(size=(len(ids), 3, 3)))[0]
    cov = np.einsum("nij,nj,nkj->nik", R, sd**2, R)
    six = np.stack([cov[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], axis=1)
    mean = rng.uniform(-0.4, 0.4, (len(ids), 3)).astype(np.float32)
    counts = np.full(len(ids), 40, np.int32)
    return Tile(tile, 1, Gaussians(ids, counts, counts // 2, mean, six.astype(np.float32)))
