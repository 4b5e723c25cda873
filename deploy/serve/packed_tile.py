"""A version of a tile as the page draws it: columns of little-endian numbers.

    0   4 bytes   "GND1"
    4   u32       N, the number of Gaussians
    8   u32       version of the tile
    12  u32       level of detail: 0 every voxel, 1 blocks of 2 x 2 x 2 voxels, 2 of 4 x 4 x 4
    16  f32[3N]   means, m, in the tile's frame (ENU at its centre on the ellipsoid)
        i32[N]    voxel ids; of a block the first of its voxels
        u32[N]    when the voxel became what it is, POSIX seconds; 0 = not known
        i16[4N]   turn of the axes, a unit quaternion x, y, z, w times 32767
        u16[4N]   standard deviations along the axes, longest first, in 0.1 mm; then points, at most 65535
        u16[N]    how many reports say so; 0 = it comes from a survey
        u16[N]    occupied cells of 10 cm
        u8[N]     0 as in the survey, 1 new since, 2 modified since

It is the same for ever: a version is never changed.
"""

import struct
from typing import Final

import numpy as np

from gnd.deploy.serve.tile_states import PageTile
from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.grid import VoxelGrid

MAGIC: Final = b"GND1"
HEAD: Final = struct.Struct("<4sIII")
BLOCKS: Final = (1, 2, 4)
"""Voxels along each side of a block, by level."""
LEVELS: Final = len(BLOCKS)
METRES_PER_STEP: Final = 1e-4
_FULL: Final = 65_535


def packed(state: PageTile, level: int) -> bytes:
    """The bytes of a version at a level of detail."""
    columns = _voxels(state) if level == 0 else _blocks(state, BLOCKS[level])
    voxel_id, mean_m, cov_m2, count, since_s, reports, cells, kind = columns
    turn, sd_m = axes_of(cov_m2)
    shape = np.empty((len(voxel_id), 4), "<u2")
    shape[:, :3] = np.clip(np.rint(sd_m / METRES_PER_STEP), 0, _FULL)
    shape[:, 3] = np.minimum(count, _FULL)
    parts = (
        HEAD.pack(MAGIC, len(voxel_id), state.version, level),
        mean_m.astype("<f4").tobytes(),
        voxel_id.astype("<i4").tobytes(),
        since_s.astype("<u4").tobytes(),
        np.rint(turn * 32767).astype("<i2").tobytes(),
        shape.tobytes(),
        np.minimum(reports, _FULL).astype("<u2").tobytes(),
        np.minimum(cells, _FULL).astype("<u2").tobytes(),
        kind.astype("u1").tobytes(),
    )
    return b"".join(parts)


_Columns = tuple[I32 | I64, F64, F64, I64, I64, I64, I64, I64]


def _voxels(state: PageTile) -> _Columns:
    g = state.gaussians
    mean_m = VoxelGrid.of(state.tile).centre_m(g.voxel_id) + g.mean_m
    told = (np.asarray(one, np.int64) for one in (g.count, state.since_s, state.reports, g.cells, state.kind))
    return (g.voxel_id, mean_m, g.full_cov(), *told)  # type: ignore[return-value]  # a generator of four


def _blocks(state: PageTile, side: int) -> _Columns:
    """Blocks of voxels as one Gaussian each: moments add. Of when, by whom and what the latest counts."""
    voxel_id, mean_m, cov_m2, count, since_s, reports, cells, kind = _voxels(state)
    if not len(voxel_id):
        return voxel_id, mean_m, cov_m2, count, since_s, reports, cells, kind
    ix, iy, floor = VoxelGrid.of(state.tile).unravel(voxel_id)
    block = (floor // side * 1024 + iy // side) * 1024 + ix // side
    _, first, inverse = np.unique(block, return_index=True, return_inverse=True)
    n = len(first)
    points = np.zeros(n, np.int64)
    np.add.at(points, inverse, count)
    mean = _summed(mean_m * count[:, None], inverse, n) / points[:, None]
    off = mean_m - mean[inverse]
    spread = cov_m2 + off[:, :, None] * off[:, None, :]
    cov = _summed((spread * count[:, None, None]).reshape(-1, 9), inverse, n).reshape(n, 3, 3) / points[:, None, None]
    latest = [np.zeros(n, np.int64) for _ in range(4)]
    for into, column in zip(latest, (since_s, reports, cells, kind), strict=True):
        np.maximum.at(into, inverse, column)
    return voxel_id[first], mean, cov, points, latest[0], latest[1], latest[2], latest[3]


def _summed(rows: F64, inverse: I64, n: int) -> F64:
    total = np.zeros((n, rows.shape[1]))
    np.add.at(total, inverse, rows)
    return total


def axes_of(cov_m2: F64) -> tuple[F64, F64]:
    """(N, 4) unit quaternions x, y, z, w and (N, 3) standard deviations, m, longest first, of (N, 3, 3) covariances:
    cov = R diag(sd²) Rᵀ, with the columns of R right-handed.
    """
    variance, vectors = np.linalg.eigh(cov_m2)
    R = vectors[:, :, ::-1].copy()
    R[np.linalg.det(R) < 0, :, 2] *= -1.0
    return _quaternions(R), np.sqrt(np.maximum(variance[:, ::-1], 0.0))


def _quaternions(R: F64) -> F64:
    """(N, 4) unit quaternions x, y, z, w of (N, 3, 3) rotations (Shepperd 1978: by the largest component)."""
    m = R.reshape(-1, 9).T
    trace = m[0] + m[4] + m[8]
    largest = np.argmax(np.stack([m[0], m[4], m[8], trace]), axis=0)
    xyzw = np.stack(
        [
            np.stack([1 + 2 * m[0] - trace, m[1] + m[3], m[2] + m[6], m[7] - m[5]]),
            np.stack([m[1] + m[3], 1 + 2 * m[4] - trace, m[5] + m[7], m[2] - m[6]]),
            np.stack([m[2] + m[6], m[5] + m[7], 1 + 2 * m[8] - trace, m[3] - m[1]]),
            np.stack([m[7] - m[5], m[2] - m[6], m[3] - m[1], 1 + trace]),
        ]
    )
    q = xyzw[largest, :, np.arange(R.shape[0])]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))
