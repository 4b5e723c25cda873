"""Gaussians of voxels as columns (struct of arrays), and the raw moments that they are made from.

A voxel's Gaussian: number of raw points, number of occupied 10 cm sub-cells, mean relative to the voxel's centre and
population covariance along the axes of the tile's ENU frame (GND, 4.1: n, μ, Σ of voxel q,i). Moments add in any order;
Gaussians are what is published.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F32, F64, I32, I64, Array, check_array
from gnd.gnd_map.errors import ShapeError

MAX_MEAN_M = 2.0
_DIAGONAL = (0, 3, 5)  # xx, yy, zz among xx, xy, xz, yy, yz, zz
_ROWS = np.array([0, 0, 0, 1, 1, 2])
_COLUMNS = np.array([0, 1, 2, 1, 2, 2])
_FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


def full_matrices(six: npt.NDArray[np.floating]) -> F64:
    """(..., 3, 3) float64 symmetric matrices of (..., 6) entries xx, xy, xz, yy, yz, zz."""
    return np.asarray(six, dtype=np.float64)[..., _FULL].reshape(*six.shape[:-1], 3, 3)


def six_entries(matrices: npt.NDArray[np.floating]) -> F64:
    """(..., 6) float64 entries xx, xy, xz, yy, yz, zz of (..., 3, 3) symmetric matrices."""
    return np.asarray(matrices, dtype=np.float64)[..., _ROWS, _COLUMNS]


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """N voxels of one tile, sorted by id, each once. A count of 0 says "no Gaussian here" (change reports only)."""

    voxel_id: I32
    """(N,) strictly increasing."""
    count: I32
    """(N,) raw points."""
    cells: I32
    """(N,) occupied 10 cm sub-cells."""
    mean_m: F32
    """(N, 3) relative to the voxel's centre, tile ENU axes, |component| <= 2 m."""
    cov_m2: F32
    """(N, 6) xx, xy, xz, yy, yz, zz, tile ENU axes, diagonal >= 0."""

    def __post_init__(self) -> None:
        if _are_plain(self.columns) and _is_sound(*self.columns):
            return
        n = len(self.voxel_id) if isinstance(self.voxel_id, np.ndarray) and self.voxel_id.ndim == 1 else None
        check_array("voxel_id", self.voxel_id, np.int32, (n,))
        check_array("count", self.count, np.int32, (n,))
        check_array("cells", self.cells, np.int32, (n,))
        check_array("mean_m", self.mean_m, np.float32, (n, 3))
        check_array("cov_m2", self.cov_m2, np.float32, (n, 6))
        self._check_values()

    def _check_values(self) -> None:
        _refuse(
            "voxel ids are not strictly increasing",
            self.voxel_id,
            np.flatnonzero(self.voxel_id[1:] <= self.voxel_id[:-1]) + 1,
        )
        _refuse("negative counts or cells", self.voxel_id, np.flatnonzero((self.count < 0) | (self.cells < 0)))
        _refuse(
            f"means beyond {MAX_MEAN_M} m",
            self.voxel_id,
            np.flatnonzero((np.abs(self.mean_m) > MAX_MEAN_M).any(axis=1)),
        )
        _refuse("negative variances", self.voxel_id, np.flatnonzero((self.cov_m2[:, _DIAGONAL] < 0).any(axis=1)))
        filled = (self.cells != 0) | self.mean_m.any(axis=1) | self.cov_m2.any(axis=1)
        _refuse("count 0 but other values", self.voxel_id, np.flatnonzero((self.count == 0) & filled))

    def __len__(self) -> int:
        return len(self.voxel_id)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Gaussians):
            return NotImplemented
        return all(np.array_equal(a, b) for a, b in zip(self.columns, other.columns, strict=True))

    __hash__ = None  # type: ignore[assignment]

    @property
    def columns(self) -> tuple[I32, I32, I32, F32, F32]:
        """voxel_id, count, cells, mean_m, cov_m2."""
        return self.voxel_id, self.count, self.cells, self.mean_m, self.cov_m2

    @property
    def exists(self) -> npt.NDArray[np.bool_]:
        """(N,) whether the voxel holds a Gaussian (count > 0)."""
        return np.asarray(self.count > 0)

    @classmethod
    def empty(cls) -> "Gaussians":
        """No voxels."""
        return _EMPTY

    @classmethod
    def nothing_at(cls, voxel_id: npt.ArrayLike) -> "Gaussians":
        """Voxels (any order) that hold no Gaussian: count 0."""
        ids = np.unique(np.asarray(voxel_id, dtype=np.int32))
        n = len(ids)
        return cls(
            ids,
            np.zeros(n, np.int32),
            np.zeros(n, np.int32),
            np.zeros((n, 3), np.float32),
            np.zeros((n, 6), np.float32),
        )

    def take(self, index: npt.ArrayLike) -> "Gaussians":
        """The rows at `index`: increasing positions, a slice's indices or a mask (N,)."""
        chosen = np.asarray(index)
        chosen = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen.astype(np.int64)
        ids, count, cells, mean, cov = self.columns
        return Gaussians(ids[chosen], count[chosen], cells[chosen], mean[chosen], cov[chosen])

    def select(self, voxel_ids: npt.ArrayLike) -> "Gaussians":
        """The rows whose voxel id is among `voxel_ids` (any order, ids that are not here are passed over)."""
        return self.take(np.isin(self.voxel_id, np.asarray(voxel_ids, dtype=np.int32)))

    def full_cov(self) -> F64:
        """(N, 3, 3) float64 covariances."""
        return full_matrices(self.cov_m2)


_KINDS = tuple(np.dtype(kind) for kind in (np.int32, np.int32, np.int32, np.float32, np.float32))


def _are_plain(columns: Sequence[object]) -> bool:
    """Whether the columns are of the right kinds, with as many rows each."""
    if not all(isinstance(one, np.ndarray) for one in columns):
        return False
    arrays = cast("Sequence[Array]", columns)
    rows = arrays[0].shape
    return (
        tuple(one.dtype for one in arrays) == _KINDS
        and len(rows) == 1
        and rows == arrays[1].shape == arrays[2].shape
        and (*rows, 3) == arrays[3].shape
        and (*rows, 6) == arrays[4].shape
    )


def _is_sound(voxel_id: I32, count: I32, cells: I32, mean_m: F32, cov_m2: F32) -> bool:
    """Whether all values are as they must be: the quick answer, without saying which are not. No kernel: who only reads
    a map need not load the compiler.
    """
    if not len(voxel_id):
        return True
    if not (voxel_id[1:] > voxel_id[:-1]).all():
        return False
    with np.errstate(invalid="ignore"):  # some NaN warn where they are looked at
        if not count.any():
            return not (cells.any() or mean_m.any() or cov_m2.any())
        return bool(
            count.min() > 0
            and cells.min() >= 0
            and np.abs(mean_m).max() <= MAX_MEAN_M  # nor is NaN
            and np.isfinite(cov_m2).all()
            and min(cov_m2[:, 0].min(), cov_m2[:, 3].min(), cov_m2[:, 5].min()) >= 0
        )


def concat(parts: Sequence[Gaussians]) -> Gaussians:
    """The voxels of all parts, sorted by id.

    Raises:
        ShapeError: a voxel occurs twice.
    """
    if not parts:
        return Gaussians.empty()
    order = np.argsort(np.concatenate([part.voxel_id for part in parts]), kind="stable")
    stacked = (np.concatenate(column)[order] for column in zip(*(part.columns for part in parts), strict=True))
    ids, count, cells, mean, cov = stacked
    return Gaussians(ids, count, cells, mean, cov)


def _refuse(what: str, voxel_id: I32, rows: I64) -> None:
    if len(rows):
        raise ShapeError(f"Gaussians: {what} in {len(rows)} of {len(voxel_id)} voxels, first voxel {voxel_id[rows[0]]}")


_EMPTY = Gaussians.nothing_at(np.empty(0, np.int32))


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Raw moments of the points of N voxels about the voxels' centres, tile ENU axes. They add in any order."""

    count: I64
    """(N,) points."""
    cells: I32
    """(N,) occupied 10 cm sub-cells."""
    sum_m: F64
    """(N, 3) Σ d, d = point - voxel centre."""
    outer_m2: F64
    """(N, 6) Σ d dᵀ as xx, xy, xz, yy, yz, zz."""

    def __post_init__(self) -> None:
        n = len(self.count) if isinstance(self.count, np.ndarray) and self.count.ndim == 1 else None
        check_array("count", self.count, np.int64, (n,))
        check_array("cells", self.cells, np.int32, (n,))
        check_array("sum_m", self.sum_m, np.float64, (n, 3))
        check_array("outer_m2", self.outer_m2, np.float64, (n, 6))

    def __len__(self) -> int:
        return len(self.count)

    @classmethod
    def zeros(cls, n: int) -> "Moments":
        """N voxels without points."""
        return cls(np.zeros(n, np.int64), np.zeros(n, np.int32), np.zeros((n, 3)), np.zeros((n, 6)))

    @classmethod
    def of(cls, gaussians: Gaussians) -> "Moments":
        """The moments that a published Gaussian stands for (exact up to float32 of the columns)."""
        n = gaussians.count.astype(np.int64)
        mean = gaussians.mean_m.astype(np.float64)
        outer = gaussians.cov_m2.astype(np.float64) + mean[:, _ROWS] * mean[:, _COLUMNS]
        return cls(n, gaussians.cells.copy(), mean * n[:, None], outer * n[:, None])

    def __add__(self, other: "Moments") -> "Moments":
        """The same voxels seen by both, row by row. Occupied cells cannot be added: the larger number stays, a lower
        bound.
        """
        if len(self) != len(other):
            raise ShapeError(f"moments of {len(self)} and {len(other)} voxels do not add")
        cells = np.maximum(self.cells, other.cells)
        return Moments(self.count + other.count, cells, self.sum_m + other.sum_m, self.outer_m2 + other.outer_m2)

    def take(self, index: npt.ArrayLike) -> "Moments":
        """The rows at `index` (positions or a mask)."""
        chosen = np.asarray(index)
        return Moments(self.count[chosen], self.cells[chosen], self.sum_m[chosen], self.outer_m2[chosen])

    def mean_m(self) -> F64:
        """(N, 3) means; 0 where there are no points."""
        return self.sum_m / np.maximum(self.count, 1)[:, None]

    def cov_m2(self) -> F64:
        """(N, 6) population covariances, diagonal >= 0; 0 where there are no points."""
        mean = self.mean_m()
        cov = self.outer_m2 / np.maximum(self.count, 1)[:, None] - mean[:, _ROWS] * mean[:, _COLUMNS]
        cov[:, _DIAGONAL] = np.maximum(cov[:, _DIAGONAL], 0.0)
        return cov

    def to_gaussians(self, voxel_id: npt.ArrayLike) -> Gaussians:
        """The Gaussians of voxels `voxel_id` (N,), any order, each once.

        Raises:
            ShapeError: ids and moments differ in number, or a voxel occurs twice.
        """
        ids = np.asarray(voxel_id, dtype=np.int32)
        check_array("voxel_id", ids, np.int32, (len(self),))
        order = np.argsort(ids, kind="stable")
        count = np.minimum(self.count, np.iinfo(np.int32).max).astype(np.int32)
        mean, cov = self.mean_m().astype(np.float32), self.cov_m2().astype(np.float32)
        return Gaussians(ids[order], count[order], self.cells[order], mean[order], cov[order])
