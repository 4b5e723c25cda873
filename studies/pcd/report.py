"""What a vehicle uploads in the point-cloud framework: new points, deleted points, and the blocks it observed.

Three codecs of the same statement. "points", as in the paper: 12 bytes for each new and each deleted point.
"indexed": a deleted point is named by its index in the map, 4 bytes. "compact": new points as leaf cells with positions
rounded to a sixteenth of a leaf (6 mm), columns of differences, indices as differences, all through zstd. Each carries
the blocks that were observed, which the votes in the cloud need.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import zstandard

from gnd.gnd_map.accumulate import CELLS_A_SIDE
from gnd.gnd_map.arrays import F32, F64, I32
from gnd.gnd_map.near_grid import grid_near
from studies.pcd.points import PcdError, PcdMap

_HEAD_BYTES: Final = 37
"""What kind of report, sizes, and the lowest cell of new points."""
_FRACTIONS: Final = 16


@dataclass(frozen=True, slots=True, eq=False)
class PcdReport:
    """What one drive found out about a point-cloud map."""

    new_points: F32
    """(K, 3) float32 metres, map frame: one a leaf cell."""
    deleted_index: I32
    """(D,) int32, increasing: points of the map that are gone."""
    observed: I32
    """(B,) int32, increasing: blocks of half a voxel that the drive can speak about."""
    map_size: int
    """Points of the map that the report refers to."""

    def __post_init__(self) -> None:
        p = self.new_points
        if p.dtype != np.float32 or p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all():
            raise PcdError(f"new points must be finite float32 (K, 3), got {p.dtype} {p.shape}")
        _check_increasing("deleted points", self.deleted_index, self.map_size)
        _check_increasing("observed blocks", self.observed, 2**31)

    def sizes(self, base: PcdMap) -> dict[str, int]:
        """Return the bytes of the upload in each codec of the module's head.

        Args:
            base: the map that the report refers to.

        Raises:
            PcdError: another map.
        """
        if len(base) != self.map_size:
            raise PcdError(f"a report about a map of {self.map_size} points, and one of {len(base)}")
        head = _HEAD_BYTES + len(_packed(_differences(self.observed)))
        new, deleted = len(self.new_points), len(self.deleted_index)
        compact = len(_packed_points(self.new_points, base)) + len(_packed(_differences(self.deleted_index)))
        return {
            "points": head + 12 * (new + deleted),
            "indexed": head + 12 * new + 4 * deleted,
            "compact": head + 4 + compact,
        }


def _check_increasing(name: str, index: I32, limit: int) -> None:
    if index.dtype != np.int32 or index.ndim != 1:
        raise PcdError(f"{name}: expected int32 (N,), got {index.dtype} {index.shape}")
    steps = np.diff(index.astype(np.int64), prepend=-1, append=limit)
    if (steps <= 0).any():
        raise PcdError(f"{name}: {len(index)} numbers must increase within 0 ... {limit - 1}")


def _packed_points(points: F32, base: PcdMap) -> bytes:
    """Sorted leaf cells as differences by column, with their fractions."""
    fine = np.floor(_grid(points, base) * _FRACTIONS).astype(np.int64)
    fine = fine[np.lexsort((fine // _FRACTIONS).T[::-1])]
    cells = fine // _FRACTIONS
    low = cells.min(axis=0) if len(cells) else np.zeros(3, np.int64)
    columns = [np.diff(cells[:, a], prepend=low[a]).astype("<i2").tobytes() for a in range(3)]
    if len(cells) and int(np.ptp(cells, axis=0).max()) > np.iinfo(np.int16).max:
        raise PcdError(f"new points span {np.ptp(cells, axis=0).max()} leaf cells; the codec holds 32767")
    columns.append((fine - cells * _FRACTIONS).astype(np.uint8).T.tobytes())
    return _packed(b"".join(columns))


def _grid(points: F32, base: PcdMap) -> F64:
    """(K, 3) leaf cell coordinates from the frame's origin."""
    return np.asarray((grid_near(base.grid_frame, points.astype(np.float64)) - _origin_g(base)) * CELLS_A_SIDE)


def _origin_g(base: PcdMap) -> F64:
    return np.asarray(np.floor(base.grid_frame.grid_of(np.zeros((1, 3)))[0]))


def _differences(index: I32) -> bytes:
    return np.diff(index.astype(np.int64), prepend=0).astype("<u4").tobytes()


def _packed(data: bytes) -> bytes:
    return bytes(zstandard.ZstdCompressor(level=12).compress(data))
