"""What vehicles met and did not decide upon, added up: a new voxel that no single vehicle may call new.

Each vehicle tells of such a voxel how many sub-cells half of its points would have met. Where the sum over vehicles is
large enough, what they met becomes one Gaussian, and each of them votes for it. The vote then goes as any other: who
saw the voxel empty votes against it, and what one vehicle alone changes waits.

Nobody counts for more than all others together, so a vehicle that lies with large numbers needs others that met as
much.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.accumulate import N_MIN_CELLS
from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.gaussian import Gaussians, six_entries
from gnd.schemas.limits import MAX_UNSURE_CELLS

TOGETHER_CELLS: Final = 12
"""So many sub-cells make a Gaussian of what several met. A single vehicle needs 18: that so many met something in the
same voxel and a majority of those who looked did not find it empty is evidence of its own."""

LEAST_AREA_M2: Final = N_MIN_CELLS * 0.01
"""All that was met in a voxel must spread as far as a Gaussian's least number of sub-cells: the corner of a thing,
which fewer fill, is met again and again, however little there is of it."""


@dataclass(frozen=True, slots=True, eq=False)
class MetTogether:
    """Which reports vote for a voxel that they are unsure of, and for what; by voxel, then by report.

    Attributes:
        voxel_id: (M,).
        report: (M,) which of the reports.
        mean_m: (M, 3) float32 of all that was met in the voxel, relative to its centre.
        cov_m2: (M, 6) float32.
    """

    voxel_id: I32
    report: I64
    mean_m: NDArray[np.float32]
    cov_m2: NDArray[np.float32]


def met_together(
    epoch: Gaussians, unsure: Sequence[Gaussians], new: Sequence[I32], voter: I64, turn: I64
) -> MetTogether:
    """Add up what reports are unsure of.

    Args:
        epoch: the tile that they are merged into: of what it holds nothing is added up.
        unsure: of each of R reports, see `TileChange.unsure`.
        new: of each the voxels that it calls new by itself, sorted; that counts as much as a voxel may.
        voter: (R,) number of its vehicle: of a vehicle's words about a voxel the newest counts.
        turn: (R,) order of the reports in time.
    """
    own = [len(one) for one in unsure]
    ids = np.concatenate([np.zeros(0, np.int32), *(one.voxel_id for one in unsure), *new])
    report = np.concatenate([np.repeat(np.arange(len(own)), own), np.repeat(np.arange(len(own)), [*map(len, new)])])
    cells = np.full(len(ids), MAX_UNSURE_CELLS, np.int64)
    cells[: sum(own)] = np.concatenate([np.zeros(0, np.int32), *(one.cells for one in unsure)])
    at = np.flatnonzero(np.isin(ids, ids[: sum(own)]) & ~np.isin(ids, epoch.voxel_id))
    at = at[np.lexsort((turn[report[at]], voter[report[at]], ids[at]))]
    newest = np.append((ids[at][1:] != ids[at][:-1]) | (np.diff(voter[report[at]]) != 0), True)[: len(at)]
    at = at[newest]
    voxels, seat = np.unique(ids[at], return_inverse=True)
    enough = _sums(seat, cells[at], len(voxels)) >= TOGETHER_CELLS
    at = at[enough[seat] & (at < sum(own))]
    at = at[np.lexsort((report[at], ids[at]))]
    mean_m = np.concatenate([np.zeros((0, 3), np.float32), *(one.mean_m for one in unsure)])[at].astype(np.float64)
    cov_m2 = np.concatenate([np.zeros((0, 6), np.float32), *(one.cov_m2 for one in unsure)])[at].astype(np.float64)
    mean_m, cov_m2 = _pooled(ids[at], cells[at], mean_m, cov_m2)
    large = _is_large(cov_m2)
    return MetTogether(
        ids[at][large], report[at][large], mean_m[large].astype(np.float32), cov_m2[large].astype(np.float32)
    )


def _is_large(cov_m2: F64) -> NDArray[np.bool_]:
    """(M,) whether a rectangle of such a spread is as large as the sub-cells that make a Gaussian. By the sum of the
    products of two eigenvalues, which takes no more than the four operations: the same on any machine.
    """
    xx, xy, xz, yy, yz, zz = cov_m2.T
    spread_m4 = (xx * yy - xy * xy) + (xx * zz - xz * xz) + (yy * zz - yz * yz)
    return np.asarray(spread_m4 >= (LEAST_AREA_M2 / 12.0) ** 2)


def _sums(seat: I64, cells: I64, n: int) -> I64:
    """(n,) the sums of `cells` by seat, in which none counts for more than all others of its seat."""
    total, most = np.zeros(n, np.int64), np.zeros(n, np.int64)
    np.add.at(total, seat, cells)
    np.maximum.at(most, seat, cells)
    return np.asarray(np.minimum(total, 2 * (total - most)))


def _pooled(ids: I32, cells: I64, mean_m: F64, cov_m2: F64) -> tuple[F64, F64]:
    """Moments of all rows of a voxel, weighted by `cells`, at each of its rows; one row at a time, so that the same
    reports give the same bits.
    """
    voxels, seat = np.unique(ids, return_inverse=True)
    total, first, second = np.zeros(len(voxels)), np.zeros((len(voxels), 3)), np.zeros((len(voxels), 6))
    np.add.at(total, seat, cells.astype(np.float64))
    np.add.at(first, seat, cells[:, None] * mean_m)
    np.add.at(second, seat, cells[:, None] * (cov_m2 + _outer(mean_m)))
    mean = first / total[:, None]
    cov = second / total[:, None] - _outer(mean)
    return mean[seat], cov[seat]


def _outer(v: F64) -> F64:
    """V v^T of (N, 3) as (N, 6)."""
    return six_entries(v[:, :, None] * v[:, None, :])
