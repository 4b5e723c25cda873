"""What turns one set of Gaussians into another."""

from dataclasses import dataclass

import numpy as np

from gnd_map.arrays import I32, I64, check_array
from gnd_map.errors import DeltaError
from gnd_map.gaussian import Gaussians, concat


@dataclass(frozen=True, slots=True)
class TileDelta:
    """What turns one set of Gaussians into another."""

    removed: I32
    """(K,) voxel ids that go, strictly increasing."""
    put: Gaussians
    """Voxels that come or are replaced, every count > 0."""

    def __post_init__(self) -> None:
        check_array("removed", self.removed, np.int32, (None,))
        if (self.removed[1:] <= self.removed[:-1]).any():
            raise DeltaError(f"delta: the {len(self.removed)} removed voxel ids are not strictly increasing")
        if np.isin(self.removed, self.put.voxel_id).any():
            raise DeltaError(
                f"delta: {int(np.isin(self.removed, self.put.voxel_id).sum())} voxels are both removed and put"
            )
        if not self.put.exists.all():
            raise DeltaError(f"delta: {int((~self.put.exists).sum())} voxels are put with count 0")

    def __len__(self) -> int:
        return len(self.removed) + len(self.put)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TileDelta):
            return NotImplemented
        return np.array_equal(self.removed, other.removed) and self.put == other.put

    __hash__ = None  # type: ignore[assignment]


def diff(old: Gaussians, new: Gaussians) -> TileDelta:
    """The smallest delta with apply(old, delta) == new, bit for bit."""
    removed = np.setdiff1d(old.voxel_id, new.voxel_id, assume_unique=True)
    return TileDelta(removed, new.take(~_same_rows(old, new)))


def apply(old: Gaussians, delta: TileDelta) -> Gaussians:
    """The Gaussians after the delta.

    Raises:
        DeltaError: a voxel to remove is not there.
    """
    absent = np.setdiff1d(delta.removed, old.voxel_id)
    if len(absent):
        raise DeltaError(f"delta: {len(absent)} of {len(delta.removed)} voxels to remove are absent, first {absent[0]}")
    gone = np.isin(old.voxel_id, delta.removed) | np.isin(old.voxel_id, delta.put.voxel_id)
    return concat([old.take(~gone), delta.put])


def _same_rows(old: Gaussians, new: Gaussians) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    """(len(new),) whether `old` holds the voxel with the same bits."""
    same = np.zeros(len(new), dtype=np.bool_)
    _, at_old, at_new = np.intersect1d(old.voxel_id, new.voxel_id, assume_unique=True, return_indices=True)
    same[at_new] = (_bits(old)[at_old] == _bits(new)[at_new]).all(axis=1)
    return same


def _bits(gaussians: Gaussians) -> I64:
    """(N, 11) the values of each row but its id, as integers: exact comparison."""
    floats = np.hstack([gaussians.mean_m, gaussians.cov_m2]) + np.float32(0.0)  # -0.0 and 0.0 are one value
    return np.column_stack([gaussians.count, gaussians.cells, floats.view(np.int32)]).astype(np.int64)
